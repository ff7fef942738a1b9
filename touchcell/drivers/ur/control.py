"""Send commands to ur-rtde's control program, which runs on the controller, through its registers.

Facts about ur-rtde 1.6.5 that shape this module (its program and client, read and run against the emulator):

- A command is written to ``input_int_register_0``, its arguments to the double registers. Streamed ones (speedL) are
  executed in every cycle; the others once, answered by 2 in ``output_int_register_0``, and by 1 when the command is
  cleared.
- speedL does not expire: the program calls ``speedl(xd, a, t=time)`` again and again until another command arrives.
  ``time`` only sets how soon it reads a newer twist, so it is one control period here.
- setWatchdog stops the whole program when ``input_int_register_0`` is not written often enough. It is therefore always
  set, and tested once per activation by staying silent until the program has stopped.
- Two threads of the program may not drive the arm: its speed thread has to be ended by speedStop before a move.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import (
    CommandRejected,
    CorruptMessage,
    DeviceError,
    DeviceFault,
    FaultClass,
    Rejection,
    Remedy,
    TransportTimeout,
)
from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.dashboard import dashboard
from touchcell.drivers.ur.modes import RuntimeState
from touchcell.drivers.ur.registers import Registers
from touchcell.drivers.ur.sdk import Upload, upload_control_program
from touchcell.geometry.types import Array

PERIOD_S = 0.002
MOVEJ, SPEEDL, SPEED_STOP, SET_TCP, STOPJ, SET_WATCHDOG, GET_TCP_OFFSET = 1, 10, 15, 29, 34, 35, 40
READY, DONE = 1, 2

_ANSWER_S = 1.0
_START_S = 5.0
_TRIP_SLACK_S = 0.5
_READ_S = 0.01
_POLL_NS = 5_000_000
_KICKS_PER_WATCHDOG_PERIOD = 4
_TOOL_TOLERANCE = 1e-6
_OPERATION_RUNNING = 0x8000


class ControlLink:
    """One run of the control program on one controller; ``open`` starts it, ``close`` ends it. Not reusable.

    Args:
        device: name for errors.
        host: address of the controller.
        clock: the host's clock.
        watchdog_hz: lowest rate of register writes that the controller tolerates.
        upload: uploads the control program.

    Attributes:
        ttl_stops: motions that ended because their time-to-live had expired.
        trip_s: time the watchdog took to stop the silent program in its test.
    """

    def __init__(
        self,
        device: str,
        host: str,
        clock: Clock,
        watchdog_hz: float,
        upload: Upload = upload_control_program,
    ) -> None:
        self._device = device
        self._host = host
        self._clock = clock
        self._watchdog_hz = watchdog_hz
        self._upload = upload
        self._kick_ns = round(1e9 / (watchdog_hz * _KICKS_PER_WATCHDOG_PERIOD))
        self._lock = threading.RLock()
        self._registers: Registers | None = None
        self._armed = False
        self._speeding = False
        self._expires_ns: int | None = None
        self._stop_accel = 0.0
        self._operation_before: int | None = None
        self._written_ns = 0
        self.ttl_stops = 0
        self.trip_s = 0.0

    def open(self, flange_to_tcp: Array) -> None:
        """Upload the program, test its watchdog, set the tool and read it back.

        Args:
            flange_to_tcp: pose [x y z rx ry rz], m and rotation vector.

        Raises:
            TransportError: the controller does not reply, or another client owns its registers.
            DeviceFault: it does not start the program, stop it by its watchdog, or apply the tool.
        """
        with self._lock:
            registers = self._start_program()
            self._test_watchdog(registers)
            registers.close()
            registers = self._start_program()
            wanted = flange_to_tcp.tolist()
            self._execute(registers, "setTcp", SET_TCP, wanted)
            tool = self._execute(registers, "getTCPOffset", GET_TCP_OFFSET, [])
            if not np.allclose(tool, wanted, rtol=0.0, atol=_TOOL_TOLERANCE):
                raise DeviceFault(
                    self._device,
                    f"tool offset reads back as {tool}, not {wanted}",
                    fault_class=FaultClass.CONFIGURATION,
                    needs=Remedy.SERVICE,
                    hint="another client may be setting it too",
                )
            self._execute(registers, "setWatchdog", SET_WATCHDOG, [self._watchdog_hz])
            self._armed = True

    def speed(self, twist_base: Array, accel: float, stop_accel: float, expires_ns: int) -> None:
        """Follow a twist until ``expires_ns``, then decelerate with ``stop_accel``.

        Raises:
            CommandRejected: a joint goal is still running, or the link is closed.
            DeviceGone: sending failed.
        """
        with self._lock:
            registers = self._usable()
            if self.goal_running():
                raise CommandRejected(
                    self._device, Rejection.MODE, "a joint goal is running", hint="stop, or wait until it is at rest"
                )
            self._stop_accel = stop_accel
            self._expires_ns = expires_ns
            self._speeding = True
            self._stream_speed(registers, twist_base.tolist(), accel)

    def halt(self, stop_accel: float) -> None:
        """Begin to decelerate with ``stop_accel``, whatever motion is running."""
        with self._lock:
            registers = self._registers
            if not self._armed or registers is None:
                return
            self._expires_ns = None
            if self.goal_running():
                self._operation_before = self._operation(registers)[0]
                self._execute(registers, "stopJ", STOPJ, [stop_accel], asynchronous=True)
            elif self._speeding:
                self._stream_speed(registers, [0.0] * 6, stop_accel)

    def move_joints(self, q: Array, speed: float, accel: float, stop_accel: float) -> None:
        """Start towards joint angles (6,) at ``speed`` rad/s and ``accel`` rad/s2; the arm must be at rest."""
        with self._lock:
            registers = self._usable()
            if self._speeding:
                self._execute(registers, "speedStop", SPEED_STOP, [stop_accel])
                self._speeding = False
            self._operation_before = self._operation(registers)[0]
            self._execute(registers, "moveJ", MOVEJ, [*q.tolist(), speed, accel], asynchronous=True)

    def goal_running(self) -> bool:
        """Return whether a joint goal, or the stop of one, is still running."""
        with self._lock:
            if self._operation_before is None or self._registers is None:
                return False
            number, running = self._operation(self._registers)
            if number != self._operation_before and not running:
                self._operation_before = None
            return self._operation_before is not None

    def tick(self) -> None:
        """Stop expired motions and feed the watchdog; call every few milliseconds."""
        # A thread that holds the lock is writing, which feeds the watchdog too.
        if not self._lock.acquire(blocking=False):
            return
        try:
            if not self._armed or self._registers is None:
                return
            now_ns = self._clock.now_ns()
            if self._expires_ns is not None and now_ns >= self._expires_ns:
                self.ttl_stops += 1
                self.halt(self._stop_accel)
            elif now_ns - self._written_ns >= self._kick_ns:
                self._registers.feed_watchdog()
                self._written_ns = now_ns
            self._registers.read()
        finally:
            self._lock.release()

    def close(self) -> None:
        """End the program, so that it cannot be resumed, and the connection. Never raises."""
        with self._lock:
            registers, self._registers = self._registers, None
            self._armed = False
            if registers is None:
                return
            registers.close()
            with suppress(DeviceError), dashboard(self._device, self._host, self._clock) as client:
                client.ask("stop")

    def _start_program(self) -> Registers:
        self._upload(self._device, self._host)
        deadline_ns = self._clock.now_ns() + round(_ANSWER_S * 1e9)
        while True:
            try:
                registers = self._registers = Registers(self._device, self._host, _ANSWER_S, self._clock)
                break
            except CorruptMessage:
                # The uploader's connection may hold the registers for a moment after it has been closed.
                if self._clock.now_ns() > deadline_ns:
                    raise
                self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)
        self._await(
            registers,
            lambda state: state.get("runtime_state") == RuntimeState.PLAYING,
            _START_S,
            "the control program does not start",
            "see the log on the pendant; only one program can run at a time",
        )
        registers.feed_watchdog()
        return registers

    def _test_watchdog(self, registers: Registers) -> None:
        self._execute(registers, "setWatchdog", SET_WATCHDOG, [self._watchdog_hz])
        silent_ns = self._written_ns
        self._await(
            registers,
            lambda state: state.get("runtime_state") == RuntimeState.STOPPED,
            1.0 / self._watchdog_hz + _TRIP_SLACK_S,
            f"the watchdog of {self._watchdog_hz:g} Hz does not stop a silent program",
            "do not use this controller: the arm would keep moving if the host died",
        )
        self.trip_s = (self._clock.now_ns() - silent_ns) * 1e-9

    def _execute(
        self, registers: Registers, what: str, command: int, doubles: list[float], *, asynchronous: bool = False
    ) -> list[float]:
        """Execute a command once; return the first six output doubles."""
        self._await_answer(registers, READY, what)
        registers.command(command, doubles, asynchronous)
        state = self._await_answer(registers, DONE, what)
        registers.feed_watchdog()
        self._written_ns = self._clock.now_ns()
        # Only then is the next streamed command sure to be executed, and no older DONE mistaken for its reply.
        self._await_answer(registers, READY, what)
        return [float(_scalar(state, f"output_double_register_{i}")) for i in range(6)]

    def _await_answer(self, registers: Registers, word: int, what: str) -> dict[str, Value]:
        deadline_ns = self._clock.now_ns() + round(_ANSWER_S * 1e9)
        state = registers.read()
        while state.get("output_int_register_0") != word:
            if state and state["runtime_state"] != RuntimeState.PLAYING:
                raise DeviceFault(
                    self._device,
                    f"{what} was not executed",
                    vendor_code=f"runtime_state {state['runtime_state']}",
                    fault_class=FaultClass.MOTION,
                    needs=Remedy.RECOVER,
                    hint="the control program is not playing; see the pendant",
                )
            if self._clock.now_ns() > deadline_ns:
                raise TransportTimeout(self._device, f"reply to {what}", _ANSWER_S)
            state = registers.read(_READ_S)
        return state

    def _await(
        self,
        registers: Registers,
        condition: Callable[[dict[str, Value]], bool],
        timeout_s: float,
        trouble: str,
        hint: str,
    ) -> None:
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not condition(registers.read(_READ_S)):
            if self._clock.now_ns() > deadline_ns:
                raise DeviceFault(
                    self._device, trouble, fault_class=FaultClass.CONFIGURATION, needs=Remedy.OPERATOR, hint=hint
                )

    def _stream_speed(self, registers: Registers, twist_base: list[float], accel: float) -> None:
        registers.command(SPEEDL, [*twist_base, accel, PERIOD_S])
        self._written_ns = self._clock.now_ns()

    def _operation(self, registers: Registers) -> tuple[int, bool]:
        """Return the number of the newest asynchronous operation (wraps at 127), and whether it is running."""
        word = int(_scalar(registers.read(), "output_int_register_2"))
        return word >> 24 & 0x7F, bool(word & _OPERATION_RUNNING)

    def _usable(self) -> Registers:
        if not self._armed or self._registers is None:
            raise CommandRejected(self._device, Rejection.MODE, "the control program has been closed")
        return self._registers


def _scalar(state: dict[str, Value], name: str) -> float:
    value = state[name]
    assert not isinstance(value, tuple), "registers hold one number each"
    return value
