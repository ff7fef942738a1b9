"""Contact servo: one arm with the tactile sensor that it carries, controlled to hold a reference contact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from touchcell.control.pid import PidGains
from touchcell.control.resting_depth import ReadDepth, RestingDepth
from touchcell.control.servo import TactileServo
from touchcell.control.touch_zero import LAST_CHANGE, TouchZero
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import TouchedFeature
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.free_motion import Goal
from touchcell.tasks.interface import Observation, TaskConfig, TaskContext


class Behavior(Protocol):
    """Motion on top of a held contact, active once that has settled."""

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        ...

    @property
    def timeout_s(self) -> float:
        """Longest time that it may take."""
        ...

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Process one cycle and return True when the behavior has finished.

        Args:
            dt_s: duration of the cycle.
            before: T_base_sensor (4, 4) one cycle ago.
            now: T_base_sensor (4, 4).
            T_s_f: valid contact pose (4, 4), or None.
        """
        ...

    def shortfall(self) -> str:
        """Return by how much a behavior that has finished missed its goal; empty if it reached it."""
        ...

    def telemetry(self) -> Mapping[str, float]:
        """Return named numbers for recording and plots, units in the names."""
        ...


@runtime_checkable
class Sidestepping(Protocol):
    """Behavior that may ask for its contact to be made anew beside the present one."""

    @property
    def may_sidestep(self) -> bool:
        """True if it may ever ask."""
        ...

    @property
    def wants_sidestep(self) -> bool:
        """True if it asks now."""
        ...

    @property
    def only_touches(self) -> bool:
        """True if the contact shall not be pressed, as it is to be given up."""
        ...

    def begin_sidestep(self, T_base_sensor: Array) -> None:
        """Take note that the contact is given up for another, with the sensor at a pose (4, 4)."""
        ...

    def next_goal(self, T_base_sensor: Array, T_s_f: Array | None) -> Goal | None:
        """Return where the sensor shall go next; None where it shall make contact again.

        Args:
            T_base_sensor: (4, 4) pose of the sensor at the last goal.
            T_s_f: (4, 4) contact made on the way there; None if there was none, or none that could be measured.
        """
        ...

    def begin_approach(self, T_base_sensor: Array) -> None:
        """Take note of the pose (4, 4) from which the sensor approaches along its axis."""
        ...


@runtime_checkable
class NeedsFeature(Protocol):
    """Behavior that continues only along what it is made for, such as an edge."""

    def astray(self, dt_s: float, touched: TouchedFeature | None) -> str:
        """Return why the behavior cannot continue; empty where it can.

        Args:
            dt_s: duration of the cycle.
            touched: what a classifier says of the newest frame, or None without one.
        """
        ...


@runtime_checkable
class Easing(Protocol):
    """Behavior that may press less than its reference."""

    @property
    def ease_m(self) -> float:
        """Depth by which it presses less now."""
        ...


@runtime_checkable
class Assuming(Protocol):
    """Behavior whose success is true only as far as something holds that it has no means to measure."""

    @property
    def rests_on(self) -> Sequence[str]:
        """What that is, each in a phrase that continues "done, as far as"."""
        ...


@runtime_checkable
class DepthAware(Protocol):
    """Behavior that needs the depth of its contact better than a model reads it."""

    def correct_depth(self, error_m: float) -> None:
        """Take note that a model reads a depth which is larger by ``error_m`` than the arm's own motion says."""
        ...


Six = tuple[float, float, float, float, float, float]
"""One number for each of x, y, z, alpha, beta, gamma."""

_Gain = Annotated[float, Field(ge=0.0)]

SixGains = Annotated[
    tuple[_Gain, _Gain, _Gain, _Gain, _Gain, _Gain],
    Field(description="x, y, z, alpha, beta, gamma of the sensor's twist; zeros: not controlled"),
]


class ContactServoConfig(TaskConfig):
    """Parameters of one contact servo.

    Attributes:
        kp_per_s: proportional gain of each axis.
        ki_per_s2: integral gain of each axis.
        kd: derivative gain of each axis.
        max_integral_speed_mm_s: largest speed that integral action may contribute.
        max_integral_turn_deg_s: largest angular rate that integral action may contribute.
        integral_zone_mm: larger errors are not integrated, so that pressing in does not overshoot ...
        integral_zone_deg: ... nor does turning.
        max_speed_mm_s: largest speed of the sensor along each axis.
        max_turn_deg_s: largest angular rate of the sensor about each axis.
        max_accel_mm_s2: largest change of the sensor's velocity per second, below what the arm's gate allows ...
        max_turn_accel_deg_s2: ... and of its angular velocity: noise of single frames is smoothed by them.
        settle_tolerance_mm: the contact is steady when the controlled errors are below these ...
        settle_tolerance_deg: ... two.
        max_frame_age_ms: the arm stops when the newest frame is older.
        max_state_age_ms: the arm stops when its newest state is older.
    """

    kp_per_s: SixGains
    ki_per_s2: SixGains
    kd: SixGains = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    max_integral_speed_mm_s: NonNegativeFloat = 40.0
    max_integral_turn_deg_s: NonNegativeFloat = 20.0
    integral_zone_mm: PositiveFloat = 1.5
    integral_zone_deg: PositiveFloat = 5.0
    max_speed_mm_s: PositiveFloat = 60.0
    max_turn_deg_s: PositiveFloat = 20.0
    max_accel_mm_s2: PositiveFloat = 450.0
    max_turn_accel_deg_s2: PositiveFloat = 120.0
    settle_tolerance_mm: PositiveFloat = 0.3
    settle_tolerance_deg: PositiveFloat = 2.0
    max_frame_age_ms: PositiveFloat = 150.0
    max_state_age_ms: PositiveFloat = 50.0

    def gains(self) -> PidGains:
        """Return gains and limits in SI units."""
        return PidGains(
            np.array(self.kp_per_s),
            np.array(self.ki_per_s2),
            np.array(self.kd),
            _six(self.max_integral_speed_mm_s, self.max_integral_turn_deg_s),
            _six(self.integral_zone_mm, self.integral_zone_deg),
            _six(self.max_speed_mm_s, self.max_turn_deg_s),
        )


_BACK_M = 0.5e-3
_BACK_RAD = math.radians(1.0)
_BACK_PER_S = 5.0


def _rotation(R: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = R
    return T


def _is_at(goal: Goal, distance_m: float, angle_rad: float) -> bool:
    reached_m, reached_rad = (_PASSED_M, _PASSED_RAD) if goal.passes else (_REACHED_M, _BACK_RAD)
    return distance_m < reached_m and angle_rad < reached_rad


def _depth_sigma_m(contact: ContactEstimate) -> float:
    single = contact.belief if contact.measured is None else contact.measured
    return 0.0 if single is None else math.sqrt(float(single.covariance[2, 2]))


def _six(linear_mm: float, angular_deg: float) -> Array:
    return np.repeat([1e-3 * linear_mm, np.radians(angular_deg)], 3)


class ContactServo:
    """An arm and its sensor under servo control.

    Args:
        arm: role of the arm.
        sensor: role of its tactile sensor.
        config: parameters.
        reference_mm_deg: contact to hold, (6,) Euler components of ``T_f_s``.
        run: behavior once settled.
        context: of the cell.
        running_axes: components x, y, z, alpha, beta, gamma of the sensor's twist that the behavior leaves to the
            controller; the others are held at rest once the contact has settled.
        decoupled: see ``TactileServo``.
        surface_rests: what is touched does not give way: the depth is held by the arm's own motion, too.

    Attributes:
        T_base_sensor: (4, 4) pose of the sensor; None where it is unknown or too old.
        contact: newest estimate; None where there is none or its frame is too old.

    Raises:
        KeyError: the context has no such sensor.
    """

    def __init__(
        self,
        arm: str,
        sensor: str,
        config: ContactServoConfig,
        reference_mm_deg: Six,
        run: Behavior,
        context: TaskContext,
        running_axes: tuple[bool, bool, bool, bool, bool, bool] = (True, True, True, True, True, True),
        *,
        decoupled: bool = False,
        surface_rests: bool = False,
    ) -> None:
        self.arm = arm
        self.sensor = sensor
        self.run = run
        # Classified once: isinstance with a Protocol in each cycle costs as much as the control law.
        self.sidestepping_run = run if isinstance(run, Sidestepping) else None
        self.feature_run = run if isinstance(run, NeedsFeature) else None
        self._easing_run = run if isinstance(run, Easing) else None
        self._depth_run = run if isinstance(run, DepthAware) else None
        self._read_depth = ReadDepth() if surface_rests else None
        self._touch_zero: TouchZero | RestingDepth | None = None
        self._change_per_m: float | None = None
        self._config = config
        self._T_tcp_sensor = context.T_tcp_sensor[sensor]
        self._running_axes = None if all(running_axes) else np.array(running_axes, np.float64)
        self._Ad_tcp_sensor = se3.adjoint(self._T_tcp_sensor)
        T_f_sref = se3.from_euler_mm_deg(np.array(reference_mm_deg))
        self.controller = TactileServo(
            se3.inverse(T_f_sref), self._T_tcp_sensor, config.gains(), 1.0 / context.rate_hz, decoupled=decoupled
        )
        self.T_base_sensor: Array | None = None
        self.contact: ContactEstimate | None = None
        self._before: Array | None = None
        self._start: Array | None = None
        self._felt: Array | None = None
        self._back: Array | None = None
        self._period_s = 1.0 / context.rate_hz
        self._V_tcp = np.zeros(6)
        self._touched = False
        self._first_touch: tuple[Array, float] | None = None
        self._letting_go: Array | None = None
        self._lets_go = False
        self._goal: Goal | None = None
        self._felt_s = 0.0
        self._is_clear = False
        self._most_sigma_rad = math.inf
        self.blocked = ""
        """What is in the way of a step aside; empty while nothing is."""

    @property
    def has_fresh_data(self) -> bool:
        """True if both the frame and the arm state are fresh."""
        return self.T_base_sensor is not None and self.contact is not None

    @property
    def in_contact(self) -> bool:
        """True if the newest frame shows a contact."""
        return self.contact is not None and self.contact.in_contact

    @property
    def has_zero(self) -> bool:
        """True if the sensor compares its images with a zero frame."""
        return self.contact is not None and self.contact.change is not None

    @property
    def change_since_zero(self) -> float:
        """Change of the newest image from the zero frame, 0 to 1; 0 where there is none."""
        return 0.0 if self.contact is None or self.contact.change is None else self.contact.change

    @property
    def seq(self) -> int:
        """Number of the newest frame; -1 where there is none."""
        return -1 if self.contact is None else self.contact.seq

    @property
    def max_frame_age_ms(self) -> float:
        """Age of a frame from which the arm stops."""
        return self._config.max_frame_age_ms

    @property
    def touches(self) -> bool:
        """True if the newest frame shows a contact that has changed as the sensor moved on."""
        return self.in_contact and self._touched

    @property
    def contact_is_stuck(self) -> bool:
        """True if a contact has not changed however far the sensor moved on, nor let go as it was withdrawn."""
        return self.in_contact and self._letting_go_m() > 1e-3 * _LONGEST_LETTING_GO_MM

    @property
    def carries(self) -> bool:
        """True if a contact in this approach did not change while the sensor moved on: an object is carried along."""
        return self._letting_go is not None or self._lets_go

    def search(self, speed_m_s: float) -> Array:
        """Return the twist (6,) of the tool that searches along the sensor's z axis for a contact.

        One that does not change while the sensor moves on may be a light object that it carries along, or none at all.
        Withdrawn, the sensor lets go of the object, which rests.
        """
        if self._letting_go is None and self.in_contact and not self._touched:
            if self._pressed_m() > 1e-3 * _LONGEST_UNCHANGED_MM:
                self._letting_go = self.T_base_sensor
        elif self._letting_go is not None and not self.in_contact:
            self._letting_go, self._lets_go = None, True
        return self.along_z(speed_m_s if self._letting_go is None else -speed_m_s)

    def _letting_go_m(self) -> float:
        """Return how far the sensor has been withdrawn since its contact was doubted."""
        if self._letting_go is None or self.T_base_sensor is None:
            return 0.0
        T = self._letting_go
        return float((T[:3, 3] - self.T_base_sensor[:3, 3]) @ T[:3, 2])

    def _pressed_m(self) -> float:
        """Distance by which the sensor has moved along its axis since the contact first showed."""
        if self._first_touch is None or self.T_base_sensor is None:
            return 0.0
        T, _ = self._first_touch
        return float((self.T_base_sensor[:3, 3] - T[:3, 3]) @ T[:3, 2])

    def _watch_touch(self) -> None:
        """A contact is one once its image has changed as the sensor moved; one without images is one at once."""
        if not self.in_contact or self.contact is None:
            self._touched, self._first_touch = False, None
        elif self.contact.change is None or (self._lets_go and self._letting_go is None):
            self._touched = True
        elif self._first_touch is None:
            if self.T_base_sensor is not None:
                self._first_touch = self.T_base_sensor, self.contact.change
        elif not self._touched:
            _, change = self._first_touch
            self._touched = (
                self._pressed_m() >= 1e-3 * _SHORTEST_PRESS_MM and self.contact.change - change >= _LEAST_CHANGE
            )

    @property
    def T_s_f(self) -> Array | None:  # noqa: N802  the field's own name
        """Valid contact pose (4, 4), or None."""
        if self.contact is None or not (self.contact.in_contact and self.contact.in_range):
            return None
        return None if self.contact.belief is None else self.contact.belief.mean

    @property
    def is_estimated(self) -> bool:
        """True if a model measured the newest contact, rather than a simulator or a label."""
        return self.contact is not None and self.contact.measured is not None

    @property
    def T_s_f_measured(self) -> Array | None:  # noqa: N802  the field's own name
        """Valid contact pose (4, 4) of the newest frame by itself, or None."""
        if self.T_s_f is None or self.contact is None or self.contact.measured is None:
            return self.T_s_f
        return self.contact.measured.mean

    def update(self, observation: Observation) -> None:
        """Update sensor pose and contact from an observation, dropping what is stale."""
        now_ns, limits = observation.now_ns, self._config
        arm = observation.arms.get(self.arm)
        self._before, self.T_base_sensor = self.T_base_sensor, None
        if arm is not None and 0.0 <= arm.age_s(now_ns) <= 1e-3 * limits.max_state_age_ms:
            self.T_base_sensor = se3.compose(arm.value.T_base_tcp, self._T_tcp_sensor)
        self.contact = observation.contacts.get(self.sensor)
        if self.contact is not None and not 0.0 <= now_ns - self.contact.t_frame_ns <= 1e6 * limits.max_frame_age_ms:
            self.contact = None
        if self.T_base_sensor is not None and self.in_contact:
            self._felt = self.T_base_sensor
        if self.contact is not None:
            self._watch_touch()
        if self._touch_zero is not None and arm is not None and self.T_base_sensor is not None:
            self._compare_depth(self._touch_zero, arm.t_ns, self.T_base_sensor)

    def _compare_depth(self, zero: TouchZero | RestingDepth, t_ns: int, T_base_sensor: Array) -> None:
        zero.moved(t_ns, T_base_sensor)
        contact = self.contact
        if contact is None or contact.change is None:
            return
        valid = contact.in_contact and contact.in_range and contact.measured is not None
        zero.saw(contact.t_frame_ns, contact.seq, contact.change, self.T_s_f_measured if valid else None)
        if zero.error_m is not None and self._read_depth is not None:
            self._read_depth.correct_depth(zero.error_m, _depth_sigma_m(contact))
        elif zero.error_m is not None and self._depth_run is not None and isinstance(zero, TouchZero):
            self._depth_run.correct_depth(zero.error_m)
            self._change_per_m = zero.change_per_m
        if zero.ended:
            self._touch_zero = None

    def aim_back(self, lift_m: float) -> None:
        """Aim at the pose in which the contact was last felt, withdrawn along the sensor's axis by ``lift_m``."""
        felt = self.T_base_sensor if self._felt is None else self._felt
        self._back = None if felt is None else se3.compose(felt, se3.exp([0.0, 0.0, -lift_m, 0.0, 0.0, 0.0]))

    def is_back(self) -> bool:
        """Return True at the pose that ``aim_back`` has set."""
        if self._back is None or self.T_base_sensor is None:
            return False
        way = se3.log(se3.compose(se3.inverse(self.T_base_sensor), self._back))
        return bool(np.linalg.norm(way[:3]) < _BACK_M and np.linalg.norm(way[3:]) < _BACK_RAD)

    def way_back(self, speed_m_s: float) -> Array:
        """Return the twist (6,) of the tool towards that pose, at most ``speed_m_s`` and the angular rate allowed."""
        if self._back is None or self.T_base_sensor is None:
            return np.zeros(6)
        V = _BACK_PER_S * se3.log(se3.compose(se3.inverse(self.T_base_sensor), self._back))
        rate = np.radians(self._config.max_turn_deg_s)
        fastest = max(float(np.linalg.norm(V[:3])) / speed_m_s, float(np.linalg.norm(V[3:])) / rate, 1.0)
        V_tcp: Array = self._Ad_tcp_sensor @ (V / fastest)
        return V_tcp

    def start_approach(self) -> None:
        """Measure the travelled distance from the current pose, from which the sensor approaches."""
        self.reset_travel()
        self._letting_go, self._lets_go = None, False
        self._touch_zero = self._new_touch_zero()
        if self.sidestepping_run is not None and self.T_base_sensor is not None:
            self.sidestepping_run.begin_approach(self.T_base_sensor)

    def _new_touch_zero(self) -> TouchZero | RestingDepth | None:
        if self._read_depth is not None:
            return RestingDepth()
        return None if self._depth_run is None else TouchZero()

    def reset_travel(self) -> None:
        """Measure the travelled distance from the current pose."""
        self._start = self.T_base_sensor

    def start_sidestep(self) -> None:
        """Let go of the object and go where the behavior says; a behavior that never asks keeps its contact."""
        self._goal, self._felt_s = None, 0.0
        self._is_clear, self.blocked = False, ""
        run = self.sidestepping_run
        if self.T_base_sensor is None or run is None or not run.may_sidestep:
            return
        self._most_sigma_rad = max(_MOST_SIGMA_RAD, _LESS_SURE * self._normal_sigma_rad())
        run.begin_sidestep(self.T_base_sensor)
        self._goal = run.next_goal(self.T_base_sensor, None)

    @property
    def only_touches(self) -> bool:
        """True if the contact shall not be pressed, as it is to be given up."""
        return self.sidestepping_run is not None and self.sidestepping_run.only_touches

    @property
    def sidestepping(self) -> bool:
        """True while a step aside has not ended."""
        return self._goal is not None

    def step_aside(self, speed_m_s: float, feeling_m_s: float) -> Array:
        """Return the twist (6,) of the tool towards the present goal, and ask for the next one where it is reached.

        Args:
            speed_m_s: in free air.
            feeling_m_s: where the goal is to feel for a contact, at most.
        """
        assert self.T_base_sensor is not None
        assert self._goal is not None
        T_base_goal = self._goal.T_base_sensor
        way = T_base_goal[:3, 3] - self.T_base_sensor[:3, 3]
        R = self.T_base_sensor[:3, :3]
        turn = se3.log(_rotation(R.T @ T_base_goal[:3, :3]))[3:]
        distance_m, angle_rad = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
        V_s = np.zeros(6)
        self._watch_way(self._goal)
        if self._goal.feels and self.in_contact:
            # Standing still until several frames have shown it.
            self._felt_s += self._period_s
            if self._felt_s >= _FEEL_S:
                self._next_goal(self._felt_contact())
        elif self._goal.feels and self.change_since_zero > _FELT_CHANGE and self._felt_s < _FEEL_S:
            # A touch is as light as it can be: what is pressed moves.
            self._felt_s += self._period_s
        elif _is_at(self._goal, distance_m, angle_rad):
            self._next_goal(None)
        else:
            fastest = self._free_speed_m_s(self._goal, distance_m, speed_m_s, feeling_m_s)
            V_s[:3] = R.T @ way * (fastest / max(distance_m, 1e-9))
            rate = math.radians(self._config.max_turn_deg_s)
            V_s[3:] = turn * (min(rate, _APPROACH_PER_S * angle_rad) / max(angle_rad, 1e-9))
        return self._accelerated(self._Ad_tcp_sensor @ V_s)

    def _watch_way(self, goal: Goal) -> None:
        """Take note of a contact on a way that was taken for free, once the sensor is clear of the last one."""
        if goal.feels:
            self._is_clear = False
        elif not self.in_contact:
            self._is_clear = True
        elif self._is_clear:
            self.blocked = f"{self.sensor} touched something where its way beside the object was taken for free"

    def _normal_sigma_rad(self) -> float:
        """Return the larger standard deviation of the contact's normal; 0 where there is none."""
        belief = None if self.contact is None else self.contact.belief
        return 0.0 if belief is None else math.sqrt(float(np.diag(belief.covariance)[3:5].max()))

    def _felt_contact(self) -> Array | None:
        """Return the contact (4, 4) that is felt, as deep as the change of the image says; None where none is valid.

        None, too, where the normal is not known: a tip that is touched 40 deg beside its axis may be read as any.
        """
        T_s_f, change = self.T_s_f, self.change_since_zero
        if self._normal_sigma_rad() > self._most_sigma_rad:
            return None
        if T_s_f is None or self._change_per_m is None or change > LAST_CHANGE:
            return T_s_f
        normal, felt = T_s_f[:3, 2], T_s_f.copy()
        felt[:3, 3] -= normal * (change / self._change_per_m + normal @ T_s_f[:3, 3])
        return felt

    def _free_speed_m_s(self, goal: Goal, distance_m: float, speed_m_s: float, feeling_m_s: float) -> float:
        """Return the speed at a distance from a goal: as fast as it can still slow down."""
        accel_m_s2 = _BRAKING * 1e-3 * self._config.max_accel_mm_s2
        if not goal.feels:
            return min(speed_m_s, _APPROACH_PER_S * distance_m, math.sqrt(2.0 * accel_m_s2 * distance_m))
        feeling_m_s *= _LIGHTLY
        free_m = max(distance_m - goal.slow_m, 0.0)
        return min(max(_FREE_M_S, feeling_m_s), math.sqrt(feeling_m_s**2 + 2.0 * accel_m_s2 * free_m))

    def _next_goal(self, T_s_f: Array | None) -> None:
        assert self.T_base_sensor is not None
        assert self.sidestepping_run is not None
        self._goal, self._felt_s = self.sidestepping_run.next_goal(self.T_base_sensor, T_s_f), 0.0

    def travelled_m(self) -> float:
        """Return the distance of the sensor from its pose at ``reset_travel``, m; 0 while it is unknown."""
        if self.T_base_sensor is None:
            return 0.0
        if self._start is None:
            self._start = self.T_base_sensor
        return float(np.linalg.norm(self.T_base_sensor[:3, 3] - self._start[:3, 3]))

    def steady(self) -> bool:
        """Return True if the errors of the latest servo step are within tolerance and its output was not limited."""
        if self.T_s_f is None or not self.controller.active:
            return False
        e = self.controller.latest_error
        small = np.linalg.norm(e[:3]) <= 1e-3 * self._config.settle_tolerance_mm
        return bool(small and np.linalg.norm(e[3:]) <= np.radians(self._config.settle_tolerance_deg))

    def advance(self, dt_s: float) -> bool:
        """Update the behavior if the motion of the cycle is known; return True when it has finished."""
        if self.T_base_sensor is None or self._before is None:
            return False
        return self.run.update(dt_s, self._before, self.T_base_sensor, self.T_s_f)

    def along_z(self, speed_m_s: float) -> Array:
        """Return the twist (6,) of the tool that moves the sensor along its z axis."""
        return self.in_tcp(np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0]))

    def in_tcp(self, V_sensor: Array) -> Array:
        """Return the twist (6,) of the tool, in its frame, that gives the sensor a twist (6,) in its own."""
        V_tcp: Array = self._Ad_tcp_sensor @ V_sensor
        self._V_tcp = V_tcp
        return V_tcp

    def _ease_m(self) -> float:
        """Return the depth by which less is to be read than the reference."""
        if self._read_depth is not None:
            return self._read_depth.ease_m
        return 0.0 if self._easing_run is None else self._easing_run.ease_m

    def servo_step(self, V_ff: Array, *, running: bool = True) -> Array | None:
        """Return the twist (6,) of the tool that holds the contact; None while there is no valid estimate."""
        T_s_f = self.T_s_f
        if T_s_f is not None and (ease_m := self._ease_m()) != 0.0:
            # To the controller it is pressed in by as much more.
            T_s_f = se3.compose(T_s_f, se3.exp([0.0, 0.0, -ease_m, 0.0, 0.0, 0.0]))
        V_tcp = self.controller.step(T_s_f, 0 if self.contact is None else self.contact.t_ns, V_ff)
        if running and self._running_axes is not None:
            V_tcp = self._Ad_tcp_sensor @ (self._running_axes * np.linalg.solve(self._Ad_tcp_sensor, V_tcp))
        if self.T_s_f is None:
            self._V_tcp = np.zeros(6)
            return None
        return self._accelerated(V_tcp)

    def _accelerated(self, V_tcp: Array) -> Array:
        """Return the twist (6,) of the tool nearest to ``V_tcp`` that the largest acceleration allows."""
        # One factor for all axes: without the motion that goes with it, a turn about the contact would slide the tip.
        step = (V_tcp - self._V_tcp) / self._period_s
        excess = max(
            1e3 * float(np.linalg.norm(step[:3])) / self._config.max_accel_mm_s2,
            math.degrees(float(np.linalg.norm(step[3:]))) / self._config.max_turn_accel_deg_s2,
        )
        self._V_tcp = self._V_tcp + self._period_s / max(excess, 1.0) * step
        return self._V_tcp

    def telemetry(self, observation: Observation, *, servoing: bool) -> Mapping[str, float]:
        """Return the age of the newest frame, and while ``servoing`` errors, references and the behavior's values."""
        values: dict[str, float] = {}
        contact = observation.contacts.get(self.sensor)
        if contact is not None:
            values["frame_age_ms"] = 1e-6 * (observation.now_ns - contact.t_frame_ns)
        if not (servoing and self.controller.active):
            return values
        errors, references = (_UNITS * self.controller.latest_error).tolist(), self.controller.reference_mm_deg.tolist()
        for name, error, reference in zip(_COMPONENTS, errors, references, strict=True):
            if math.isfinite(reference):
                values[f"error_{name}"], values[f"reference_{name}"] = error, reference
        values["servo_clipped"] = float(self.controller.clipped)
        return {**values, **self.run.telemetry()}


_SHORTEST_PRESS_MM = 0.3
_LONGEST_UNCHANGED_MM = 2.5
_LONGEST_LETTING_GO_MM = 2.5
# The image changes by about 0.1 per millimetre of depth (``contact_gate``).
_LEAST_CHANGE = 0.01
_REACHED_M = 0.5e-3
_PASSED_M, _PASSED_RAD = 2.5e-3, math.radians(4.0)
_FEEL_S = 0.15
_FELT_CHANGE = 0.02
# Standard deviation of a normal from which it is none: it is 0.5 to 1 deg of touches within the range of a good model,
# 2 to 4.5 deg of those beside it. A model that is less sure of all is measured by its first contact.
_MOST_SIGMA_RAD, _LESS_SURE = math.radians(1.5), 2.5
_LIGHTLY = 0.6
_APPROACH_PER_S = 12.0
# Share of the largest acceleration that slows a motion down: arms lag behind what they are told.
_BRAKING = 0.8
# Speed towards what is not expected to be touched yet: a side that is nearer is not pushed far before it shows.
_FREE_M_S = 0.03


_COMPONENTS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
_UNITS = np.repeat([1e3, np.degrees(1.0)], 3)
