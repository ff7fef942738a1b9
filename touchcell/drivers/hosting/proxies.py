"""Proxies of devices in another process, with the same interface: a run loop sees no difference."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.command_checks import checked_twist_command
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame, read_only
from touchcell.drivers.core.device import DeactivatePolicy, Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    CommandRejected,
    DeviceError,
    DeviceFault,
    FaultClass,
    LifecycleError,
    Rejection,
    StaleData,
    TransportError,
    TransportTimeout,
)
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import Frame, JointState, Quality, Stamped, TcpState
from touchcell.drivers.hosting.host import LIFECYCLES
from touchcell.drivers.hosting.layouts import ANSWER, ARM, COMMAND, FRAME, RecordReader, RecordWriter
from touchcell.drivers.hosting.link import HostLink
from touchcell.drivers.hosting.wire import decode_adjustments, decode_note
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain, Tool
from touchcell.drivers.kinematics.joint_limits import IkSettings

_FRAME_POLL_NS: Final = 1_000_000
_FIRST_FRAME_S: Final = 5.0
_LONGEST_TTL_S: Final = 1.0
_REFUSAL_S: Final = 0.25
"""Within this the host says why a command with an impossible time-to-live is refused."""


class RemoteDevice(Device):
    """Lifecycle of a device in another process.

    Args:
        name: the device's name in the cell.
        clock: CLOCK_MONOTONIC, which all processes share.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        super().__init__(name, clock)
        self._link: HostLink | None = None

    def attach(self, link: HostLink, fds: dict[str, int]) -> None:
        """Connect to the started host and map the blocks of this device."""
        self._link = link
        self._map(fds)

    def detach(self) -> None:
        """Unmap the blocks."""
        self._link = None
        self._unmap()

    def health(self) -> dict[str, float | int | str | bool]:
        """Return the device's health; a round trip to the host."""
        health: dict[str, float | int | str | bool] = self._call("health")["health"]
        return health

    def _call(self, call: str, **arguments: Any) -> dict[str, Any]:
        if self._link is None:
            raise LifecycleError(self.name, call, "without a process", ["its host runs"])
        if self._link.hangs():
            raise self._to_faulted(DeviceFault(self.name, "its process hangs", fault_class=FaultClass.COMMUNICATION))
        try:
            return self._link.call(call, device=self.name, **arguments)
        except TransportError as error:
            # An unreachable host is not a reply of the device.
            if error.device == self._link.name:
                raise self._to_faulted(DeviceFault(self.name, error.message)) from error
            raise

    def _check_host(self) -> HostLink:
        if self._link is None:
            raise LifecycleError(self.name, "be read", self._state.value, ["its host runs"])
        try:
            self._link.check(self.name)
        except DeviceFault as fault:
            raise self._to_faulted(fault) from None
        return self._link

    def _open(self) -> None:
        self._call("connect")

    def _configure(self) -> None:
        self._call("configure")

    def _activate(self) -> None:
        self._call("activate")

    def _deactivate(self, policy: DeactivatePolicy) -> None:
        self._call("deactivate", policy=policy.value)

    def _recover(self, token: OperatorToken) -> None:
        self._call("recover", operator=token.operator, t_ns=token.t_ns)

    def _close(self) -> None:
        # A host that has ended has disconnected; the chain kills one that hangs.
        if self._link is not None and not self._link.describe_end() and not self._link.hangs():
            try:
                self._link.call("disconnect", device=self.name)
            except DeviceError:
                return

    def _map(self, fds: dict[str, int]) -> None:
        raise NotImplementedError

    def _unmap(self) -> None:
        raise NotImplementedError


class RemoteArm(RemoteDevice):
    """Proxy of an arm in another process. Gate, lease and time-to-live are checked there."""

    def __init__(self, name: str, clock: Clock) -> None:
        super().__init__(name, clock)
        self._limits: TwistLimits | None = None
        self._categories: frozenset[StopCategory] = frozenset()
        self._lease: Lease | None = None
        self._number = 0
        self._written_ns = 0

    def _map(self, fds: dict[str, int]) -> None:
        self._commands = RecordWriter(fds["command"], COMMAND)
        self._answers = RecordReader(fds["answer"], ANSWER)
        self._arm = RecordReader(fds["state"], ARM)

    def _unmap(self) -> None:
        for block in (self._commands, self._answers, self._arm):
            block.close()

    @property
    def limits(self) -> TwistLimits:
        """Limits of the gate in the host; known from ``connect`` on."""
        assert self._limits is not None, "connect first"
        return self._limits

    @property
    def stop_categories(self) -> frozenset[StopCategory]:
        """Stop categories supported in software; known from ``connect`` on."""
        return self._categories

    @property
    def owner(self) -> str | None:
        """Holder of the command lease within this process."""
        return self._lease.owner if self._lease else None

    def acquire(self, owner: str) -> Lease:
        """Take the command lease. Raises CommandRejected(LEASE) while another holds it."""
        self._lease = Lease(self.name, owner, self._call("acquire", owner=owner)["epoch"])
        return self._lease

    def release(self, lease: Lease) -> None:
        """Release the lease and stop. Does nothing for a lease that is no longer held."""
        if lease is self._lease:
            self._lease = None
            self._call("release", epoch=lease.epoch)

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the newest state published by the host.

        Raises:
            StaleData: it is older than ``max_age_s``.
            DeviceFault: the host has died or is silent; the arm is FAULTED.
            DeviceError: error raised by the driver in the host.
        """
        record, note = self._poll()
        if record["failed"]:
            raise decode_note(note, self.name)
        state = TcpState(record["T_base_tcp"].copy(), record["twist"].copy())
        quality = Quality.SUSPECT if record["suspect"] else Quality.GOOD
        sample = Stamped(state, int(record["t_ns"]), int(record["seq"]), quality=quality)
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return sample

    def at_rest(self) -> bool:
        """Return whether the host saw it at rest after the last command or stop."""
        record, _ = self._poll()
        return bool(record["at_rest"]) and int(record["read_ns"]) > self._written_ns

    def rested_ns(self) -> int | None:
        """Time at which its host saw it at rest after the latest stop by the chain; None before."""
        record, _ = self._poll()
        return int(record["rest_ns"]) or None

    def kinematics(self) -> DifferentialIk | None:
        """Return None: it publishes no joint angles."""
        return None

    def send_twist(self, command: TwistCommand, lease: Lease) -> Sent[TwistCommand]:
        """Have the host follow ``command`` until it expires; return the command that its gate let pass.

        Waits for the reply at most until the command expires.

        Raises:
            CommandRejected: nothing was sent; see ``reason``.
            TransportTimeout: the host has not replied in time; it drops the expired command.
            DeviceFault: the host has died or is silent; the arm is FAULTED.
        """
        link = self._check_host()
        # Same check as in the gate, because the block has no room for anything else.
        command = checked_twist_command(self.name, command)
        if abs(command.t_ns) >= 2**62:
            raise CommandRejected(
                self.name, Rejection.EXPIRED, "its timestamp is not an integer in nanoseconds", value=command.t_ns
            )
        value = self._commands.value
        value["number"] = self._next()
        value["lease"] = lease.epoch if self._lease is not None and lease is self._lease else 0
        value["twist"], value["tcp_frame"] = command.twist, command.frame is TwistFrame.TCP
        value["t_ns"], value["ttl_s"] = command.t_ns, command.ttl_s
        value["has_cause"], value["t_cause_ns"] = command.t_cause_ns is not None, command.t_cause_ns or 0
        self._write(link)
        answer, note = self._await_answer(link, command.ttl_s)
        if answer["refused"]:
            raise decode_note(note, self.name)
        sent = replace(command, twist=read_only(answer["twist"]), frame=TwistFrame.BASE)
        return Sent(sent, int(answer["t_ns"]), decode_adjustments(note))

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        """Order the host to stop at once. Does not wait, so that a hanging host does not delay the stop of other arms.

        Raises:
            LifecycleError: the driver does not support ``category``.
        """
        if category not in self._categories:
            offered = [f"category {offer}" for offer in sorted(self._categories)]
            raise LifecycleError(self.name, f"stop by category {int(category)}", self._state.value, offered)
        if self._link is None:
            return
        value = self._commands.value
        value["stop"], value["category"] = self._next(), int(category)
        self._write(self._link)

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _write(self, link: HostLink) -> None:
        self._written_ns = self._clock.now_ns()
        self._commands.publish()
        link.wake()

    def _await_answer(self, link: HostLink, ttl_s: float) -> tuple[Any, bytes]:
        seconds = ttl_s if 0.0 < ttl_s <= _LONGEST_TTL_S else _REFUSAL_S
        deadline_ns = self._clock.now_ns() + round(1e9 * seconds)
        while True:
            _, answer, note = self._answers.read_all()
            if int(answer["number"]) == self._number:
                return answer, note
            left_s = (deadline_ns - self._clock.now_ns()) * 1e-9
            if left_s <= 0.0:
                self._check_host()
                raise TransportTimeout(self.name, "reply of its host", seconds)
            link.await_answer(left_s)

    def _poll(self) -> tuple[Any, bytes]:
        self._check_host()
        _, record, note = self._arm.read_all()
        if self._state is Lifecycle.DISCONNECTED:
            raise LifecycleError(self.name, "read its pose", self._state.value, ["passive"])
        # A stop that removes power ends in READY, and a driver may fault on its own.
        found = LIFECYCLES[int(record["lifecycle"])]
        with self._state_lock:
            if found is Lifecycle.FAULTED and self._state is not Lifecycle.FAULTED and note:
                self._fault_error = _device_error(note, self.name)
            if found in (Lifecycle.READY, Lifecycle.FAULTED):
                self._change_state(Lifecycle.ACTIVE, found)
        return record, note

    def _open(self) -> None:
        answer = self._call("connect")
        self._limits = TwistLimits(**answer["limits"])
        self._categories = frozenset(StopCategory(each) for each in answer["stop_categories"])


class RemoteJointArm(RemoteArm):
    """Proxy of an arm in another process that also publishes its joints.

    Args:
        name: the device's name in the cell.
        clock: CLOCK_MONOTONIC.
        ik: kinematics known to the driver before it is connected.
    """

    def __init__(self, name: str, clock: Clock, ik: DifferentialIk | None) -> None:
        super().__init__(name, clock)
        self._ik = ik

    def kinematics(self) -> DifferentialIk | None:
        """Return the differential inverse kinematics; from ``configure`` on with the tool of the device."""
        return self._ik

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the newest joint state published by the host. Raises as ``tcp``."""
        record, note = self._poll()
        if record["failed"]:
            raise decode_note(note, self.name)
        count = int(record["joint_count"])
        tau = record["tau"][:count].copy() if record["has_torque"] else None
        state = JointState(record["q"][:count].copy(), record["dq"][:count].copy(), tau)
        sample = Stamped(state, int(record["joints_t_ns"]), int(record["joints_seq"]))
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return sample

    def _configure(self) -> None:
        reported = self._call("configure").get("kinematics")
        if reported is not None:
            chain = SerialChain(
                ChainDescription.model_validate(reported["chain"]), Tool.model_validate(reported["tool"])
            )
            self._ik = DifferentialIk(chain, IkSettings(**reported["settings"]))


class RemoteCamera(RemoteDevice):
    """Proxy of a camera in another process: the newest of its frames."""

    def _map(self, fds: dict[str, int]) -> None:
        self._frames = RecordReader(fds["frame"], FRAME)
        self._newest: Stamped[Frame] | None = None

    def _unmap(self) -> None:
        self._frames.close()
        self._newest = None

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest frame; waits for the very first. Raises StaleData, DeviceFault."""
        frame = self._read() or self.next(-1, _FIRST_FRAME_S)
        age_s = frame.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, frame.seq)
        return frame

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the first available frame with ``seq > after_seq``. Raises TransportTimeout, DeviceFault."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (frame := self._read()) is None or frame.seq <= after_seq:
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                raise TransportTimeout(self.name, f"frame after {after_seq}", timeout_s)
            self._clock.sleep_until_ns(now_ns + _FRAME_POLL_NS)
        return frame

    def _read(self) -> Stamped[Frame] | None:
        self._check_host()
        number, record, tail = self._frames.read_all()
        if number == 0:
            return None
        seq = int(record["seq"])
        if self._newest is None or self._newest.seq != seq:
            height, width, channels = int(record["height"]), int(record["width"]), int(record["channels"])
            image = np.frombuffer(tail, np.uint8).reshape((height, width, channels) if channels else (height, width))
            exposure, gain = float(record["exposure"]), float(record["gain"])
            self._newest = Stamped(
                Frame(image, None if math.isnan(exposure) else exposure, None if math.isnan(gain) else gain),
                int(record["t_ns"]),
                seq,
                int(record["t_device_ns"]) if record["has_device_time"] else None,
                Quality.SUSPECT if record["suspect"] else Quality.GOOD,
            )
        return self._newest


def _device_error(note: bytes, device: str) -> DeviceError:
    error = decode_note(note, device)
    return error if isinstance(error, DeviceError) else DeviceError(device, str(error))
