"""Validated state of a UR controller.

ur-rtde's receive thread keeps only the newest packet: no reception time, no queue, and values of different packets
where it overtakes the reader. So the reader accepts only whole packets (same timestamp before and after), maps them to
host time by the controller's own clock, and drops values that are not finite, out of range, or older than the newest.
RTDE has no checksum: a wrong value within the ranges below cannot be detected.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode
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
_JOINTS = slice(20, 26)
_ONE_TURN_RAD = 2.0 * math.pi + 0.1
_JUMP_SLACK_RAD = 0.02
_ATTEMPTS = 3
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

    def age_s(self, now_ns: int) -> float:
        """Return the seconds since the sample."""
        return (now_ns - self.t_ns) * 1e-9


class StateReader:
    """Turn ur-rtde's receive interface into validated snapshots. Any thread may poll.

    Args:
        receive: ``RTDEReceiveInterface`` that streams ``VARIABLES``.
        clock: the host's clock.
        max_joint_rad: largest plausible angles, of all joints or each (6,).

    Attributes:
        last_corrupt: why the newest dropped packet was implausible, or "".
        corrupt: packets dropped because of implausible values.
        out_of_order: packets dropped because a newer one had been received.
    """

    def __init__(self, receive: Any, clock: Clock, max_joint_rad: Array | float = _ONE_TURN_RAD) -> None:
        self._receive = receive
        self._clock = clock
        self._bounds = _BOUNDS.copy()
        self._bounds[_JOINTS] = max_joint_rad
        self._lock = threading.Lock()
        self._newest: Snapshot | None = None
        self._seen_s = math.nan
        self._offset_ns: float | None = None
        self._offset_at_ns = 0
        self._misses: deque[bool] = deque(maxlen=_BUDGET_WINDOW)
        self._losses = OncePerCause(_logger)
        self.last_corrupt = ""
        self.corrupt = 0
        self.out_of_order = 0

    @property
    def connected(self) -> bool:
        """Return whether the connection is up."""
        return bool(self._receive.isConnected())

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
            for _ in range(_ATTEMPTS):
                timestamp_s = self._receive.getTimestamp()
                if timestamp_s == self._seen_s:
                    break
                if not math.isfinite(timestamp_s):
                    self._miss_corrupt("time is not finite")
                    break
                values = self._values()
                if self._receive.getTimestamp() == timestamp_s:
                    self._seen_s = timestamp_s
                    self._take(timestamp_s, values)
                    break
            return self._newest

    def _values(self) -> tuple[list[float], list[float], tuple[int, ...]]:
        receive = self._receive
        tool = [*receive.getActualTCPPose(), *receive.getActualTCPSpeed(), *receive.getActualTCPForce()]
        joints = [
            *receive.getActualQ(),
            *receive.getActualQd(),
            *receive.getTargetQd(),
            *receive.getJointTemperatures(),
        ]
        modes = (
            receive.getRobotMode(),
            receive.getSafetyMode(),
            receive.getSafetyStatusBits(),
            receive.getRuntimeState(),
        )
        return [*tool, receive.getTargetSpeedFraction()], joints, modes

    def _take(self, timestamp_s: float, values: tuple[list[float], list[float], tuple[int, ...]]) -> None:
        tool, joints, (robot_mode, safety_mode, safety_bits, runtime_state) = values
        numbers = np.array([timestamp_s, *tool, *joints])
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
            safety_bits=safety_bits,
            runtime_state=modes[2],
            speed_fraction=float(numbers[19]),
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
