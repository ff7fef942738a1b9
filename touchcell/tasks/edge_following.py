"""Follow an edge: glide along it with the tip half over it, turning with it (docs/explanation/edges.md).

The paper names edges as what its method does not cover (section 6.1). The contact is that of the edge frame {e}: depth
and tilt against the face, lateral offset across the edge, turn about the normal. Along the edge nothing is controlled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from touchcell.control.curvature import CurvatureEstimator
from touchcell.control.pid import PidGains
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import TouchedFeature
from touchcell.perception.runtime.feature_spec import EDGE
from touchcell.tasks.contact_servo import ContactServo, SixGains
from touchcell.tasks.felt_curvature import slower_by_tilt
from touchcell.tasks.interface import DEPTH, SPEED, TaskContext, TaskSpec
from touchcell.tasks.planned_motions import PlannedMotion, PlannedRim
from touchcell.tasks.servoing import ARM, SENSOR, ServoConfig, ServoTask, servo_motions

_AXES: Final = {
    2: (True, True, False, False, False, True),
    3: (True, True, True, False, False, True),
    5: (True, True, True, True, True, True),
}
"""Components of the sensor's twist that a task of so many dimensions commands."""


_BEND_SHARE: Final = 0.4
"""Of the largest turn that a bend may take, so that corrections have the rest."""
_HALF_SPEED_RAD: Final = math.radians(2.5)
"""The tilt at which the speed is halved. Estimates of an edge scatter more than those of a surface."""
_TILT_WINDOW: Final = 1.6
"""Over which the bend of the face is felt, as a multiple of that of the edge."""
_NO_EDGE_S: Final = 0.1
"""Without an edge before anything is followed: three frames, before the controller goes where it seems to be."""
_STILL_RAD: Final = math.radians(45.0)
"""The turn still to make at which the tip turns on the spot."""


class EdgeFollowingConfig(ServoConfig):
    """Parameters of edge following.

    Attributes:
        depth_mm: indentation to hold, normal to the face beside the edge.
        offset_mm: distance of the tip beyond the edge; negative on the face.
        dimensions: 2 steers across the edge and turns with it, in the plane in which the contact settled; 3 holds the
            depth too, over a curved sheet; 5 also stays normal to the face.
        direction: forward keeps the face to the left of the travel, seen from above it.
        speed_mm_s: speed along the edge.
        distance_mm: length of the edge to follow, at most.
        close_loop: end where the edge leads back to where it began, and fail where it does not.
        bend_window_mm: the turn of the edge over this last stretch is fed forward.
        closing_mm: distance from there at which the loop is closed.
        least_edge_percent: probability of an edge, corners included, below which the task does not begin, and fails;
            judged only where the sensor's estimator has a classifier (``features:``).
        edge_lost_ms: time for which it has to stay below.
    """

    depth_mm: Annotated[PositiveFloat, DEPTH] = 3.0
    offset_mm: float = Field(default=0.0, ge=-10.0, le=10.0)
    dimensions: Literal[2, 3, 5] = 5
    direction: Literal["forward", "backward"] = "forward"
    # Past a corner a turn has to be made within a third of a second; an integral across the edge overshoots there.
    kp_per_s: SixGains = (8.0, 0.0, 8.0, 8.0, 8.0, 11.0)
    ki_per_s2: SixGains = (6.0, 0.0, 16.0, 16.0, 16.0, 16.0)
    max_turn_deg_s: PositiveFloat = 180.0
    max_integral_turn_deg_s: PositiveFloat = 60.0
    max_accel_mm_s2: PositiveFloat = 550.0
    max_turn_accel_deg_s2: PositiveFloat = 1100.0
    # An edge that is sharper or blunter than a right angle is told to 0.2 mm and 1.3 deg from frame to frame.
    settle_tolerance_mm: PositiveFloat = 0.5
    settle_tolerance_deg: PositiveFloat = 3.0
    bend_window_mm: PositiveFloat = 5.0
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 30.0
    distance_mm: PositiveFloat = 100.0
    close_loop: bool = False
    closing_mm: PositiveFloat = 3.0
    least_edge_percent: float = Field(default=50.0, ge=0.0, le=100.0)
    edge_lost_ms: PositiveFloat = 300.0
    return_lift_mm: PositiveFloat | None = 3.0

    def gains(self) -> PidGains:
        """Return gains and limits in SI units; tilt is controlled in five dimensions only."""
        gains = super().gains()
        if self.dimensions == 5:
            return gains
        used = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 1.0])
        return PidGains(
            used * self.kp_per_s,
            used * self.ki_per_s2,
            used * self.kd,
            gains.integral_limit,
            gains.integral_zone,
            gains.output_limit,
        )


class FollowEdge:
    """Behavior of edge following: along the edge until its length is covered or its loop closed."""

    def __init__(self, config: EdgeFollowingConfig) -> None:
        self._sign = 1.0 if config.direction == "forward" else -1.0
        self._speed_m_s = 1e-3 * config.speed_mm_s
        self._feedforward = np.zeros(6)
        self._turn_bend = CurvatureEstimator(1e-3 * config.bend_window_mm)
        # A longer one is late where a face bends to and fro, as a wave does within 30 mm.
        self._tilt_bend = CurvatureEstimator(_TILT_WINDOW * 1e-3 * config.bend_window_mm)
        self._fastest_rad_s = math.radians(config.max_turn_deg_s)
        self._tilts = config.dimensions == 5
        self._distance_m = 1e-3 * config.distance_mm
        self._close_loop, self._closing_m = config.close_loop, 1e-3 * config.closing_mm
        self._timeout_s = 3.0 * config.distance_mm / config.speed_mm_s + 5.0
        self._start: Array | None = None
        self._travelled_m = 0.0
        self._away = False
        self._closed = False
        self._least_edge = 1e-2 * config.least_edge_percent
        self._edge_lost_s = 1e-3 * config.edge_lost_ms
        self._off_edge_s = 0.0
        self._edge = math.nan

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return self._feedforward

    @property
    def timeout_s(self) -> float:
        """Three times the nominal duration, for corners, plus five seconds."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Add up the way along the edge; return True once it is long enough, or its loop is closed.

        Where the edge leads far from where the sensor heads, as at a corner, it turns before it goes on; in a bend it
        goes no faster than it can turn, and slower while it is tilted against the face.
        """
        if self._start is None:
            self._start = now[:3, 3].copy()
        step = now[:3, :3].T @ (now[:3, 3] - before[:3, 3])
        self._travelled_m += self._sign * float(step[1])
        self._turn_bend.update(float(step[1]), now, T_s_f)
        self._tilt_bend.update(float(step[1]), now, T_s_f)
        turn = 0.0 if T_s_f is None else math.atan2(T_s_f[1, 0], T_s_f[0, 0])
        bend = np.zeros(6)
        bend[5] = self._turn_bend.per_m()[5]
        if self._tilts:
            # A face that leans over more and more takes the middle of the tip across the edge with it.
            tilting = self._tilt_bend.per_m()
            bend[[0, 3, 4]] = tilting[[0, 3, 4]]
        speed = min(self._speed_m_s, _BEND_SHARE * self._fastest_rad_s / max(float(np.linalg.norm(bend[3:])), 1e-9))
        speed *= max(math.cos(min(abs(turn) / _STILL_RAD, 1.0) * 0.5 * math.pi), 0.0)
        if self._tilts and T_s_f is not None:
            speed *= slower_by_tilt(T_s_f, _HALF_SPEED_RAD)
        self._feedforward = speed * bend
        self._feedforward[1] = self._sign * speed
        if self._close_loop:
            from_start = float(np.linalg.norm(now[:3, 3] - self._start))
            self._away = self._away or from_start > 3.0 * self._closing_m
            self._closed = self._away and from_start <= self._closing_m
        return self._closed or self._travelled_m >= self._distance_m

    def astray(self, dt_s: float, touched: TouchedFeature | None) -> str:
        """Return that there is no edge, or none any more, once it has been missing for a while."""
        if touched is None:
            return ""
        self._edge = touched.along_an_edge
        self._off_edge_s = self._off_edge_s + dt_s if self._edge < self._least_edge else 0.0
        longest_s = min(self._edge_lost_s, _NO_EDGE_S) if self._start is None else self._edge_lost_s
        if self._off_edge_s <= longest_s:
            return ""
        what = f"{touched.likeliest} by {100.0 * getattr(touched, touched.likeliest):.0f} %"
        if self._start is None:
            return f"touches no edge to follow: {what}"
        return f"lost the edge after {1e3 * self._travelled_m:.0f} mm: {what}"

    def shortfall(self) -> str:
        """Return that a loop that was to be closed is not."""
        if self._close_loop and not self._closed:
            return f"the loop is not closed after {1e3 * self._travelled_m:.0f} mm"
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return the way along the edge so far."""
        values = {"along_edge_mm": 1e3 * self._travelled_m}
        return values if math.isnan(self._edge) else {**values, "edge_percent": 100.0 * self._edge}


def _build(config: EdgeFollowingConfig, context: TaskContext) -> ServoTask:
    reference = (config.offset_mm, 0.0, config.depth_mm, 0.0, 0.0, 0.0)
    axes = _AXES[config.dimensions]
    servo = ContactServo(ARM, SENSOR, config, reference, FollowEdge(config), context, axes, decoupled=EDGE.decoupled)
    return ServoTask("edge_following", config, context, servo, shears=False)


def _motions(config: EdgeFollowingConfig) -> Iterator[PlannedMotion]:
    yield from servo_motions(config, shears=False)
    backward = config.direction == "backward"
    yield PlannedRim(
        ("distance_mm",), 1e-3 * config.distance_mm, backward, config.close_loop, tilts=config.dimensions == 5
    )


SPEC = TaskSpec(
    "edge_following",
    "glide along an edge, half over it and turning with it, round corners and loops",
    EdgeFollowingConfig,
    {ARM: SERVO_ARM},
    frozenset({SENSOR}),
    _build,
    starts_free=True,
    glides=True,
    feature=EDGE.name,
    motions=lambda config, start, mount: _motions(config),
)
