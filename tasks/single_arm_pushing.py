"""Push an object to a target with one arm: press, steer by moving the contact sideways, stop there (paper 3.3.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from control.alignment import Bearing, TargetAlignment, bearing
from geometry.types import Array
from tasks.hand import Hand, HandConfig, Six, SixGains
from tasks.interface import TaskContext, TaskSpec
from tasks.servoing import ARM, SENSOR, ServoConfig, ServoTask


class PushConfig(HandConfig):
    """Parameters of whoever pushes. The servo keeps the sensor normal to the object; how deep it is pressed is left to
    the object's friction, and where it touches, to target alignment.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
        target_mm: x and y of the target in the arm's base frame, whose z axis is upright.
        push_speed_mm_s: speed along the sensor's axis.
        arrive_mm: done when the target is no further ahead of the middle of the tip: the tip's radius and half of the
            object bring the object's middle to the target.
        align_kp_mm_s_per_deg: sideways speed per degree of the target's bearing.
        align_ki_mm_s2_per_deg: its integral gain.
        align_kd_mm_per_deg: its derivative gain.
        align_max_mm_s: largest sideways speed.
        align_off_mm: no alignment when the target is nearer to the middle of the tip.
        push_timeout_s: give up when it has not arrived by then.
    """

    reference_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    kp_per_s: SixGains = (0.0, 0.0, 0.0, 4.0, 0.0, 0.0)
    ki_per_s2: SixGains = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    target_mm: tuple[float, float]
    push_speed_mm_s: PositiveFloat = 20.0
    arrive_mm: NonNegativeFloat = 60.0
    align_kp_mm_s_per_deg: NonNegativeFloat = 1.0
    align_ki_mm_s2_per_deg: NonNegativeFloat = 0.2
    align_kd_mm_per_deg: NonNegativeFloat = 0.0
    align_max_mm_s: PositiveFloat = 20.0
    align_off_mm: NonNegativeFloat = 65.0
    push_timeout_s: PositiveFloat = 120.0


class SingleArmPushingConfig(PushConfig, ServoConfig):
    """Parameters of single-arm pushing."""


class Push:
    """The run of pushing: forward along the contact normal, sideways by target alignment, until the target is near."""

    def __init__(self, config: PushConfig) -> None:
        self._target = 1e-3 * np.array(config.target_mm)
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._arrive_m = 1e-3 * config.arrive_mm
        self._timeout_s = config.push_timeout_s
        per_rad = 1e-3 * np.degrees(1.0)
        self._alignment = TargetAlignment(
            config.align_kp_mm_s_per_deg * per_rad,
            config.align_ki_mm_s2_per_deg * per_rad,
            config.align_kd_mm_per_deg * per_rad,
            1e-3 * config.align_max_mm_s,
            1e-3 * config.align_off_mm,
        )
        self._seen: Bearing | None = None
        self._sideways_m_s = 0.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return np.array([0.0, self._sideways_m_s, self._speed_m_s, 0.0, 0.0, 0.0])

    @property
    def timeout_s(self) -> float:
        """As the parameters say."""
        return self._timeout_s

    def advance(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Look where the target is."""
        if T_s_f is None:
            self._alignment.reset()
            self._sideways_m_s = 0.0
            return False
        self._seen = bearing(now, T_s_f, self._target)
        self._sideways_m_s = self._alignment.step(self._seen, dt_s)
        return self._seen.ahead_m <= self._arrive_m

    def telemetry(self) -> Mapping[str, float]:
        """The target's bearing, its distances along the contact normal and from it, and what alignment asks for."""
        if self._seen is None:
            return {}
        return {
            "target_bearing_deg": float(np.degrees(self._seen.theta_rad)),
            "target_ahead_mm": 1e3 * self._seen.ahead_m,
            "target_aside_mm": 1e3 * self._seen.aside_m,
            "align_mm_s": 1e3 * self._sideways_m_s,
        }


def build(config: SingleArmPushingConfig, context: TaskContext) -> ServoTask:
    """The task in a cell that has ``arm`` and ``sensor``."""
    hand = Hand(ARM, SENSOR, config, config.reference_mm_deg, Push(config), context)
    return ServoTask("single_arm_pushing", config, context, hand)


SPEC = TaskSpec(
    name="single_arm_pushing",
    summary="push an object over a table to a target, steering it by touch",
    config=SingleArmPushingConfig,
    arms={ARM: frozenset({"TcpSource", "TwistSink", "Stoppable"})},
    sensors=frozenset({SENSOR}),
    build=build,
)
