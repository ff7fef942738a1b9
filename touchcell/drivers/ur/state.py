"""Validated state of a UR controller, from a real-time connection of our own.

Every packet is one control period. The reader maps it to host time by the controller's own clock, and drops values that
are not finite, out of range, or older than the newest. RTDE has no checksum: a wrong value within the ranges below
cannot be detected. No threads: a call for the state reads what has arrived.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import ConnectError, CorruptMessage, DeviceGone
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.codec import Packet, PacketType, Recipe, Value
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode
from touchcell.drivers.ur.registers import RtdeWire
from touchcell.geometry.types import Array
from touchcell.logs import OncePerCause

_logger = logging.getLogger(__name__)

RATE_HZ = 500.0
VARIABLES = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "target_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "robot_mode",
    "safety_mode",
    "safety_status_bits",
    "runtime_state",
    "target_speed_fraction",
    "joint_temperatures",
)
OPTIONAL = ("actual_robot_voltage", "tcp_offset")
"""Variables that older controllers do not have (Universal_Robots_ROS_Driver issues 605 and 749)."""

_MAX_JOINT_SPEED_RAD_S = 2.0 * math.pi
# Largest plausible magnitudes, in the order in which StateReader reads: far beyond what the arm can reach.
_BOUNDS = np.array(
    [
        1e9,  # timestamp, s
        *[3.0] * 3,  # position, m
        *[2.0 * math.pi] * 3,  # rotation vector, rad
        *[20.0] * 6,  # speed of the tool, m/s and rad/s
        *[2000.0] * 6,  # wrench, N and N m
        1.0,  # speed slider
        *[math.inf] * 6,  # joints: those of the model, see StateReader
        *[_MAX_JOINT_SPEED_RAD_S] * 12,  # actual and target joint speeds
        *[200.0] * 6,  # temperatures, Celsius
    ]
)
_VECTORS = ("actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force")
_JOINT_VECTORS = ("actual_q", "actual_qd", "target_qd", "joint_temperatures")
_MODES = ("robot_mode", "safety_mode", "runtime_state")
_JOINTS = slice(20, 26)
_ONE_TURN_RAD = 2.0 * math.pi + 0.1
_JUMP_SLACK_RAD = 0.02
_MOST_READS = 16
# Two quartz clocks differ by less; see _place.
_MAX_CLOCK_DRIFT = 200e-6
_BUDGET_WINDOW = 50
_BUDGET_MISSES = 10


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One packet of state: SI units, base axes.

    Attributes:
        t_ns: time of the sample on the host's clock.
        t_device_ns: the controller's clock.
        seq: number of its control period.
        q, qd, qd_target: joint angles and speeds (6,).
        tcp_pose: [x y z rx ry rz] of the active tool centre point, a rotation vector.
        tcp_speed: [v, w] of it along base axes.
        tcp_force: [f, t] on it along base axes.
        temperatures: of the joints, Celsius.
        speed_fraction: position of the speed slider.
        voltage_v: of the robot's supply; NaN where the controller does not report it.
        tcp_offset: [x y z rx ry rz] of the active tool centre point in the flange frame; None likewise.
    """

    t_ns: int
    t_device_ns: int
    seq: int
    q: Array
    qd: Array
    qd_target: Array
    tcp_pose: Array
    tcp_speed: Array
    tcp_force: Array
    temperatures: Array
    robot_mode: RobotMode
    safety_mode: SafetyMode
    safety_bits: int
    runtime_state: RuntimeState
    speed_fraction: float
    voltage_v: float = math.nan
    tcp_offset: Array | None = None

    def age_s(self, now_ns: int) -> float:
        """Return the seconds since the sample."""
        return (now_ns - self.t_ns) * 1e-9


class PacketSource(Protocol):
    """Delivers the packets of a state stream."""

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        ...

    def receive(self) -> list[Mapping[str, Value]]:
        """Return the packets that have arrived since the last call, oldest first; never blocks."""
        ...


class StateStream:
    """A connection that streams ``VARIABLES``, and those of ``OPTIONAL`` that the controller has, at ``RATE_HZ``.

    Args:
        device: name for errors.
        host: address of the controller.
        timeout_s: timeout of the connection and of each reply of its setup.
        clock: the host's clock.

    Raises on construction:
        ConnectError: the controller does not have one of ``VARIABLES``.
        OSError, TransportError: it cannot be reached or does not reply.
    """

    def __init__(self, device: str, host: str, timeout_s: float, clock: Clock) -> None:
        self._wire = RtdeWire(device, host, timeout_s, clock)
        self._connected = True
        try:
            self._wire.ask(ur_codec.version_request())
            self._recipe = self._granted(device, host)
            self._wire.ask(Packet(PacketType.START))
        except BaseException:
            self._wire.close()
            raise

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        return self._connected

    def receive(self) -> list[Mapping[str, Value]]:
        """Return the packets that have arrived since the last call, oldest first; never blocks."""
        found: list[Mapping[str, Value]] = []
        try:
            for _ in range(_MOST_READS):
                packets = self._wire.receive(0.0)
                if not packets:
                    break
                found += [self._recipe.unpack(packet.payload) for packet in packets if packet.kind is PacketType.DATA]
        except (DeviceGone, CorruptMessage):
            # A stream of packets of the wrong size cannot be resynchronised.
            self._connected = False
        return found

    def close(self) -> None:
        """Close the connection; idempotent."""
        self._connected = False
        self._wire.close()

    def _granted(self, device: str, host: str) -> Recipe:
        names: tuple[str, ...] = (*VARIABLES, *OPTIONAL)
        types = self._types(names)
        missing = [name for name, kind in zip(names, types, strict=True) if kind == ur_codec.NOT_FOUND]
        if needed := sorted(set(missing) - set(OPTIONAL)):
            raise ConnectError(
                device,
                f"the controller at {host} does not stream {', '.join(needed)}",
                hint="update PolyScope to 5.6 or later of version 5",
            )
        if missing:
            names = tuple(name for name in names if name not in missing)
            types = self._types(names)
        return Recipe(self._number, names, types)

    def _types(self, names: tuple[str, ...]) -> tuple[str, ...]:
        payload = self._wire.ask(ur_codec.setup_outputs(RATE_HZ, names)).payload
        types = ur_codec.parse_names(payload[1:])
        if len(types) != len(names):
            raise CorruptMessage("rtde", f"{len(types)} types for {len(names)} variables")
        self._number = payload[0]
        return types


class StateReader:
    """Turn a stream of packets into validated snapshots. Any thread may poll.

    Args:
        stream: connection that streams ``VARIABLES``.
        clock: the host's clock.
        max_joint_rad: largest plausible angles, of all joints or each (6,).

    Attributes:
        last_corrupt: why the newest dropped packet was implausible, or "".
        corrupt: packets dropped because of implausible values.
        out_of_order: packets dropped because a newer one had been received.
    """

    def __init__(self, stream: PacketSource, clock: Clock, max_joint_rad: Array | float = _ONE_TURN_RAD) -> None:
        self._stream = stream
        self._clock = clock
        self._bounds = _BOUNDS.copy()
        self._bounds[_JOINTS] = max_joint_rad
        self._lock = threading.Lock()
        self._newest: Snapshot | None = None
        self._offset_ns: float | None = None
        self._offset_at_ns = 0
        self._misses: deque[bool] = deque(maxlen=_BUDGET_WINDOW)
        self._losses = OncePerCause(_logger)
        self.last_corrupt = ""
        self.corrupt = 0
        self.out_of_order = 0

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        return self._stream.connected

    @property
    def drops_too_many(self) -> bool:
        """Return whether more packets are dropped than on a healthy link: over 10 of the last 50."""
        return sum(self._misses) > _BUDGET_MISSES

    def reset_statistics(self) -> None:
        """Reset the drop counter and the clock offset, after an operator has acknowledged the fault."""
        with self._lock:
            self._misses.clear()
            self._losses.forget()
            self._offset_ns = None

    def poll(self) -> Snapshot | None:
        """Return the newest good snapshot, or None before the first."""
        with self._lock:
            for packet in self._stream.receive():
                self._take(packet)
            return self._newest

    def _take(self, packet: Mapping[str, Value]) -> None:
        timestamp_s = _number(packet["timestamp"])
        numbers = np.array(
            [
                timestamp_s,
                *(value for name in _VECTORS for value in _vector(packet[name])),
                _number(packet["target_speed_fraction"]),
                *(value for name in _JOINT_VECTORS for value in _vector(packet[name])),
            ]
        )
        # Written so that NaN fails.
        plausible = np.abs(numbers) <= self._bounds
        if not plausible.all() or timestamp_s < 0.0:
            return self._miss_corrupt(self._implausible(numbers, plausible))
        t_device_ns = round(timestamp_s * 1e9)
        q = numbers[_JOINTS]
        newest = self._newest
        if newest is not None:
            passed_ns = t_device_ns - newest.t_device_ns
            if passed_ns <= 0:
                self.out_of_order += 1
                self._losses.warning("out of order", "dropped a packet that is older than the one before")
                self._misses.append(True)
                return None
            reach = _MAX_JOINT_SPEED_RAD_S * passed_ns * 1e-9 + _JUMP_SLACK_RAD
            if not (np.abs(q - newest.q) <= reach).all():
                return self._miss_corrupt("joints jump")
        robot_mode, safety_mode, runtime_state = (int(_number(packet[name])) for name in _MODES)
        try:
            modes = RobotMode(robot_mode), SafetyMode(safety_mode), RuntimeState(runtime_state)
        except ValueError:
            return self._miss_corrupt(f"unknown mode among {robot_mode}, {safety_mode}, {runtime_state}")
        self._misses.append(False)
        self._newest = Snapshot(
            t_ns=self._place(t_device_ns),
            t_device_ns=t_device_ns,
            seq=round(timestamp_s * RATE_HZ),
            q=q,
            qd=numbers[26:32],
            qd_target=numbers[32:38],
            tcp_pose=numbers[1:7],
            tcp_speed=numbers[7:13],
            tcp_force=numbers[13:19],
            temperatures=numbers[38:44],
            robot_mode=modes[0],
            safety_mode=modes[1],
            safety_bits=int(_number(packet["safety_status_bits"])),
            runtime_state=modes[2],
            speed_fraction=float(numbers[19]),
            voltage_v=_number(packet.get("actual_robot_voltage", math.nan)),
            tcp_offset=np.array(_vector(packet["tcp_offset"])) if "tcp_offset" in packet else None,
        )
        return None

    def _implausible(self, numbers: Array, plausible: Array) -> str:
        outside = np.flatnonzero(np.logical_not(plausible[_JOINTS]))
        if outside.size:
            joint = int(outside[0])
            angle, limit = np.rad2deg([numbers[_JOINTS][joint], self._bounds[_JOINTS][joint]])
            return f"joint {joint + 1} is at {angle:.0f} deg, its model ends at {limit:.0f} deg"
        return "a value is out of any range"

    def _miss_corrupt(self, why: str) -> None:
        self.last_corrupt = why
        self.corrupt += 1
        self._losses.warning("corrupt", "dropped a packet whose values cannot be true")
        self._misses.append(True)

    def _place(self, t_device_ns: int) -> int:
        # The smallest delay seen so far is the best estimate of the clocks' offset. Letting it grow as fast as clocks
        # may drift apart keeps it valid for days, and a packet that was read late never looks fresh.
        now_ns = self._clock.now_ns()
        offset_ns = float(now_ns - t_device_ns)
        if self._offset_ns is not None:
            offset_ns = min(offset_ns, self._offset_ns + _MAX_CLOCK_DRIFT * (now_ns - self._offset_at_ns))
        self._offset_ns, self._offset_at_ns = offset_ns, now_ns
        return t_device_ns + round(offset_ns)


def _number(value: Value) -> float:
    assert not isinstance(value, tuple), "the recipe gives one number"
    return value


def _vector(value: Value) -> tuple[float, ...]:
    assert isinstance(value, tuple), "the recipe gives a vector"
    return value
