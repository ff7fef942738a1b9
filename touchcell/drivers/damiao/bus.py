"""Requests to Damiao motors and their replies, over any python-can bus.

A motor replies only when addressed, so one thread that sends a cycle's requests and collects the replies owns the bus:
no receive thread is needed, no queue overflows unnoticed, and no reply is awaited twice.

Replies carry no timestamp. Each is stamped with the time at which its request was sent, so its age is never
understated: a motor's requests are queued and its replies arrive in order (CAN keeps the order of one sender). After a
loss the queue would stay one entry too long; then a register is read as well, whose reply identifies itself and so
marks the position. Such a read is called a fence; it is also sent now and then to see that no other host has changed
the motor's timeout or scales. Each motor has at most one fence pending, and fences cycle through four registers, so a
reply that arrives after its fence timed out is not mistaken for the next one's.
"""

from __future__ import annotations

import errno
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from touchcell.drivers.core import can_errors
from touchcell.drivers.core.bus_reply import BusCounters, Reply
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import (
    CodecError,
    ConnectError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    Remedy,
    TransportTimeout,
)
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.codec import Feedback, Ranges, Register

TRIES = 5
_SETTLE_NS = 20_000_000
# The adapter or its interface no longer exists. Any other failure may pass, such as a full transmit queue, which
# python-can's adapters report by various errors, with and without a code (python-can issues 1495, 2004).
_GONE = frozenset(
    (errno.ENODEV, errno.ENXIO, errno.EBADF, errno.ESHUTDOWN, errno.ENOTCONN, errno.EPIPE, errno.ECONNRESET)
)
# What another host may change unnoticed: a timeout that no longer protects, scales by which frames mean something else.
_WATCHED = (Register.TIMEOUT, Register.PMAX, Register.VMAX, Register.TMAX)
_CHECK_NS = 250_000_000
_FENCES = (Register.TIMEOUT, Register.CTRL_MODE, Register.MST_ID, Register.ESC_ID)


@dataclass(frozen=True, slots=True)
class Address:
    """CAN ids of one motor: commands go to ``esc_id``, replies come on ``mst_id``."""

    esc_id: int
    mst_id: int


@dataclass(slots=True)
class Counters(BusCounters):
    """Message statistics, with failed reads of the adapter, error frames, and the error counters they last carried."""

    error_frames: int = 0
    not_received: int = 0
    transmit_errors: int = 0
    receive_errors: int = 0


@dataclass(slots=True, eq=False)
class _Pending:
    """Pending request; ``fence``: the register that it reads, or None if the reply is the motor's state."""

    t_ns: int
    fence: Register | None = None


class MotorBus:
    """The motors of one arm on one CAN bus. One thread at a time.

    Args:
        device: name for errors.
        addresses: the motors.
        connect: opens the python-can bus.
        clock: injected time.
        max_silence_s: silence after which the caller considers a motor lost; requests twice as old are discarded.
        answer_s: how long to await the reply to a single request before it is repeated.
        fd: send CAN FD frames with bit rate switching.

    Attributes:
        counters: message statistics.
        last_error: text of the newest error frame or failure of the adapter, or "".
        timeout_ticks: the motors' timeout as last read, once a second and after a loss, or None; it reveals a motor
            that lost power.
    """

    def __init__(
        self,
        device: str,
        addresses: Sequence[Address],
        connect: Callable[[], Any],
        clock: Clock,
        *,
        max_silence_s: float,
        answer_s: float = 0.1,
        fd: bool = False,
    ) -> None:
        self._device = device
        self._addresses = tuple(addresses)
        self._by_mst_id = {address.mst_id: index for index, address in enumerate(addresses)}
        self._connect = connect
        self._clock = clock
        self._forget_after_ns = round(2e9 * max_silence_s)
        self._fence_lost_after_ns = round(0.5e9 * max_silence_s)
        self._answer_s = answer_s
        self._fd = fd
        self._bus: Any = None
        self._reset_state()

    def _reset_state(self) -> None:
        """Reset to the state of a bus that was never open."""
        n = len(self._addresses)
        self._ranges: list[Ranges | None] = [None] * n
        self._pending: list[deque[_Pending]] = [deque() for _ in range(n)]
        self._newest: list[Reply[Feedback] | None] = [None] * n
        self._wanted_register: tuple[int, int, bool] | None = None
        self._replies: list[codec.RegisterReply] = []
        self._bus_off = False
        self._passive = False
        self._fences: list[_Pending | None] = [None] * n
        self._fence_turns = [0] * n
        # One motor after the other, so that no cycle has much more to transfer.
        self._checked_ns = [self._clock.now_ns() + index * _CHECK_NS // n for index in range(n)]
        self._rescaled = ""
        self.counters = Counters()
        self.last_error = ""
        self.timeout_ticks: list[int | None] = [None] * n

    @property
    def state(self) -> str:
        """Return the controller state from python-can and error frames: active, passive, error or closed."""
        if self._bus is None:
            return "closed"
        if self._bus_off:
            return "error"
        return "passive" if self._passive else str(self._bus.state.name).lower()

    def open(self) -> None:
        """Open the bus and read the full scales of every motor; changes no settings.

        Raises:
            ConnectError: no bus, or motors that do not reply or not as configured; ``causes`` names each.
        """
        self._reset_state()
        self._bus = self._connect()
        causes: list[Exception] = []
        for index, address in enumerate(self._addresses):
            try:
                self._ranges[index] = self._read_ranges(index)
                if (found := self.read(index, Register.MST_ID)) != address.mst_id:
                    raise ConnectError(self._device, f"motor {address.esc_id} replies on {found}, not {address.mst_id}")
            except (TransportTimeout, CodecError, ConnectError) as error:
                causes.append(error)
        if causes:
            raise ConnectError(
                self._device, "motors are missing", causes, hint="is the arm powered, are ids and bit rates right?"
            )

    def close(self) -> None:
        """Close the bus; does nothing if it was never opened."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def ranges(self, index: int) -> Ranges:
        """Return the full scales that a motor reported."""
        ranges = self._ranges[index]
        assert ranges is not None, "open the bus first"
        return ranges

    def read(self, index: int, register: int) -> float | int:
        """Read a register of a motor. Raises TransportTimeout, DeviceGone, CodecError."""
        return self._ask(index, register, codec.read_register(self._addresses[index].esc_id, register))

    def write(self, index: int, register: int, value: float | int) -> float | int:
        """Set a register until the next power cycle; return the value read back."""
        self._ask(index, register, codec.write_register(self._addresses[index].esc_id, register, value), written=True)
        return self.read(index, register)

    def command(self, index: int, data: bytes) -> Feedback:
        """Send one frame to one motor until it replies, a few times. Raises TransportTimeout, DeviceGone."""
        self._settle()
        for _ in range(TRIES):
            self._send(index, self._addresses[index].esc_id, data)
            until_ns = self._clock.now_ns() + round(self._answer_s * 1e9)
            while (answer := self._newest[index]) is None and self._receive(until_ns):
                pass
            if answer is not None:
                return answer.state
        raise self._no_answer(index)

    def exchange(self, data: Sequence[bytes | None], until_ns: int) -> list[Reply[Feedback] | None]:
        """Send every motor its frame, or a request for its state if None, and collect the replies.

        Returns as soon as all have replied to this very request, and at ``until_ns`` at the latest, with the newest
        reply received from each meanwhile.

        Raises:
            DeviceGone: lost connection to the bus.
            DeviceFault: the controller is bus-off.
        """
        self._newest = [None] * len(self._addresses)
        self._fence()
        start_ns = self._clock.now_ns()
        for index, (address, frame) in enumerate(zip(self._addresses, data, strict=True)):
            if frame is None:
                self._send(index, codec.PARAMETER_ID, codec.request_feedback(address.esc_id))
            else:
                self._send(index, address.esc_id, frame)
        while not self._all_since(start_ns) and self._receive(until_ns):
            pass
        self.counters.missed += sum(answer is None for answer in self._newest)
        if self._bus_off:
            raise DeviceFault(
                self._device,
                "bus-off",
                vendor_code="bus-off",
                fault_class=FaultClass.COMMUNICATION,
                needs=Remedy.OPERATOR,
                hint="check wiring, termination and bit rates, then restart the interface",
            )
        if self._rescaled:
            what, self._rescaled = self._rescaled, ""
            raise DeviceFault(
                self._device,
                what,
                vendor_code="full scale",
                fault_class=FaultClass.CONFIGURATION,
                needs=Remedy.OPERATOR,
                hint="which other program writes to the motors?",
            )
        return list(self._newest)

    def _all_since(self, start_ns: int) -> bool:
        return all(answer is not None and answer.t_ns >= start_ns for answer in self._newest)

    def _read_ranges(self, index: int) -> Ranges:
        return Ranges(
            float(self.read(index, Register.PMAX)),
            float(self.read(index, Register.VMAX)),
            float(self.read(index, Register.TMAX)),
        )

    def _ask(self, index: int, register: int, request: bytes, *, written: bool = False) -> float | int:
        self._settle()
        self._replies.clear()
        self._wanted_register = (index, register, written)
        try:
            for _ in range(TRIES):
                self._put(codec.PARAMETER_ID, request)
                until_ns = self._clock.now_ns() + round(self._answer_s * 1e9)
                while not self._replies and self._receive(until_ns):
                    pass
                if self._replies:
                    return self._replies[0].value
        finally:
            self._wanted_register = None
        raise self._no_answer(index)

    def _no_answer(self, index: int) -> TransportTimeout:
        what = f"reply of motor {self._addresses[index].esc_id}"
        return TransportTimeout(self._device, what, TRIES * self._answer_s)

    def _settle(self) -> None:
        """Receive pending replies, so that the next reply belongs to the next request."""
        until_ns = self._clock.now_ns() + _SETTLE_NS
        while any(self._pending) and self._receive(until_ns):
            pass
        for queue in self._pending:
            queue.clear()
        self._newest = [None] * len(self._addresses)

    def _fence(self) -> None:
        now_ns = self._clock.now_ns()
        for index, queue in enumerate(self._pending):
            while queue and now_ns - queue[0].t_ns > self._forget_after_ns:
                queue.popleft()
            fence = self._fences[index]
            under_way = fence in queue and fence is not None and now_ns - fence.t_ns <= self._fence_lost_after_ns
            is_due = now_ns - self._checked_ns[index] >= _CHECK_NS
            if (queue or is_due) and not under_way:
                self._fence_turns[index] += 1
                registers = _WATCHED if is_due else _FENCES
                register = registers[self._fence_turns[index] % len(registers)]
                if is_due:
                    self._checked_ns[index] = now_ns
                fence = self._fences[index] = _Pending(now_ns, register)
                queue.append(fence)
                self._put(codec.PARAMETER_ID, codec.read_register(self._addresses[index].esc_id, register))

    def _send(self, index: int, arbitration_id: int, data: bytes) -> None:
        now_ns = self._clock.now_ns()
        if self._put(arbitration_id, data):
            self._pending[index].append(_Pending(now_ns))

    def _put(self, arbitration_id: int, data: bytes) -> bool:
        import can

        message = can.Message(
            arbitration_id=arbitration_id,
            is_extended_id=False,
            data=data,
            is_fd=self._fd,
            bitrate_switch=self._fd,
            check=False,
        )
        try:
            self._bus.send(message)
        except Exception as error:
            if _code(error) in _GONE:
                raise self._gone(error) from None
            self.counters.not_sent += 1
            self.last_error = str(error)
            return False
        self.counters.sent += 1
        return True

    def _receive(self, until_ns: int) -> bool:
        """Process one frame; False if none arrived in time."""
        left_s = (until_ns - self._clock.now_ns()) * 1e-9
        try:
            message = self._bus.recv(max(left_s, 0.0))
        except Exception as error:
            if _code(error) in _GONE:
                raise self._gone(error) from None
            self.counters.not_received += 1
            self.last_error = str(error)
            return False
        if message is None:
            return False
        if message.is_error_frame:
            self._note_error(message.arbitration_id, bytes(message.data))
        elif not message.is_extended_id and not message.is_remote_frame:
            self._take(message.arbitration_id, bytes(message.data))
        return True

    def _take(self, arbitration_id: int, data: bytes) -> None:
        index = self._by_mst_id.get(arbitration_id)
        if index is None:
            self.counters.unexpected += 1
            return
        if self._take_wanted(index, data) or self._take_fence(index, data):
            return
        if codec.is_register_reply(data, self._addresses[index].esc_id):
            self.counters.unexpected += 1
        else:
            self._take_feedback(index, data)

    def _take_wanted(self, index: int, data: bytes) -> bool:
        wanted = self._wanted_register
        if wanted is None or wanted[0] != index:
            return False
        reply = codec.decode_register_reply(data, self._addresses[index].esc_id, wanted[1])
        # A second reply to a repeated write must not be mistaken for the read-back.
        if reply is None or reply.written != wanted[2]:
            return False
        self._replies.append(reply)
        return True

    def _take_fence(self, index: int, data: bytes) -> bool:
        queue, fence = self._pending[index], self._fences[index]
        if fence is None or fence.fence is None or fence not in queue:
            return False
        reply = codec.decode_register_reply(data, self._addresses[index].esc_id, fence.fence)
        if reply is None:
            return False
        if fence.fence is Register.TIMEOUT:
            self.timeout_ticks[index] = int(reply.value)
        elif fence.fence in _WATCHED:
            self._check_scale(index, fence.fence, float(reply.value))
        # All earlier requests have been answered or lost.
        while queue.popleft() is not fence:
            pass
        return True

    def _check_scale(self, index: int, register: Register, value: float) -> None:
        """Adopt a full scale that another host has changed, so that holding commands are right, and note the change."""
        ranges = self._ranges[index]
        if ranges is None or not math.isfinite(value) or value <= 0.0:
            return
        names = {Register.PMAX: "position_rad", Register.VMAX: "velocity_rad_s", Register.TMAX: "torque_n_m"}
        before = getattr(ranges, names[register])
        # Registers are single precision.
        if not math.isclose(before, value, rel_tol=1e-6):
            self._ranges[index] = replace(ranges, **{names[register]: value})
            self._rescaled = f"{register.name} of motor {self._addresses[index].esc_id} is {value:g}, was {before:g}"

    def _take_feedback(self, index: int, data: bytes) -> None:
        ranges = self._ranges[index]
        if ranges is None:
            self.counters.unexpected += 1
            return
        try:
            feedback = codec.decode_feedback(data, self._addresses[index].esc_id, ranges)
        except CodecError:
            self.counters.corrupt += 1
            return
        queue = self._pending[index]
        while queue and queue[0].fence is not None:
            queue.popleft()
        if not queue:
            self.counters.unexpected += 1
            return
        self.counters.answered += 1
        self._newest[index] = Reply(feedback, queue.popleft().t_ns)

    def _note_error(self, arbitration_id: int, data: bytes) -> None:
        self.counters.error_frames += 1
        self.counters.transmit_errors, self.counters.receive_errors = can_errors.counters(data)
        if arbitration_id & can_errors.CONTROLLER:
            self._passive = can_errors.is_error_passive(arbitration_id, data)
        self.last_error = can_errors.describe(arbitration_id)
        if arbitration_id & can_errors.BUS_OFF:
            self._bus_off = True
        elif arbitration_id & can_errors.RESTARTED:
            self._bus_off = self._passive = False

    def _gone(self, error: Exception) -> DeviceGone:
        return DeviceGone(
            self._device, f"lost connection to the CAN bus: {error}", hint="check the adapter, then reconnect"
        )


def _code(error: BaseException) -> int | None:
    """Return the error number of an adapter's exception, or of the one that caused it."""
    for found in (error, error.__cause__):
        code = getattr(found, "error_code", None) or getattr(found, "errno", None)
        if isinstance(code, int):
            return code
    return None
