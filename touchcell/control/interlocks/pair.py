"""Interlocks on a pushed or held object: synchronised contacts, object not lost, object not toppling.

Roles are those of the tasks with two arms: ``leader`` pushes, ``follower`` holds against it, each with its sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from touchcell.control.interlocks.coverage import (
    HELD_S,
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    just_beyond,
    mount_problem,
    role_problem,
    states_of,
    with_motion,
    with_sensor,
)
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.planning_scene import PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.settings import LEAVE
from touchcell.control.interlocks.snapshot import CellView, SensorView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import (
    AnyOf,
    InterlockState,
    Judgement,
    Reading,
    Sustained,
    TimedInterlock,
    TimerState,
    number_state,
    overdue,
    select_state,
    waited,
)
from touchcell.control.interlocks.violation import Severity
from touchcell.drivers.core.samples import TcpState
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_REFERENCE_DEPTH_M = 1e-3
"""Shallower contacts determine the surface normal too poorly to be a reference."""
_FALLEN_DEG = 45.0
_FALLING_DEG_S = 90.0
"""An object that leans this far, or this fast, must trip."""
_RATE_S = 0.2
"""Time over which the tilt rate is taken; a single frame's tilt is too noisy."""


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A sensor and the base of its arm: what is needed to express its contact in the world frame.

    Attributes:
        role: of the sensor.
        T_world_base: (4, 4) of its arm's base.
        T_tcp_sensor: (4, 4) pose of the sensor in the tool frame.
    """

    role: str
    T_world_base: Array
    T_tcp_sensor: Array

    def contact(self, view: CellView) -> SensorView | None:
        """Return its contact, or None without contact or without an arm that carries it."""
        sensor = view.sensors.get(self.role)
        return sensor if sensor is not None and sensor.T_s_f is not None and sensor.arm in view.arms else None

    def pose(self, view: CellView, sensor: SensorView) -> Array:
        """Return the measured pose (4, 4) of the sensor in the world."""
        placed: Array = self.T_world_base @ _state(view, sensor).T_base_tcp @ self.T_tcp_sensor
        return placed

    def velocity(self, view: CellView, sensor: SensorView) -> Array:
        """Return the measured velocity (3,) of its tip in the world, m/s."""
        state = _state(view, sensor)
        x, y, z = (state.T_base_tcp[:3, :3] @ self.T_tcp_sensor[:3, 3]).tolist()
        wx, wy, wz = state.twist[3:].tolist()
        # np.cross is ten times slower.
        velocity = state.twist[:3] + np.array([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x])
        turned: Array = self.T_world_base[:3, :3] @ velocity
        return turned


def _state(view: CellView, sensor: SensorView) -> TcpState:
    assert sensor.arm is not None
    return view.arms[sensor.arm].state.value


@dataclass(frozen=True, slots=True)
class _Pair:
    """Leader and follower, while the task works in one of ``states``, or in any if none are named."""

    leader: Carried
    follower: Carried
    states: frozenset[str]

    def contacts(self, view: CellView) -> tuple[SensorView, SensorView] | None:
        """Return both contacts, or None unless both are made."""
        if not view.works_in(self.states):
            return None
        leading, following = self.leader.contact(view), self.follower.contact(view)
        return None if leading is None or following is None else (leading, following)

    def closing(self, view: CellView) -> Iterator[Reading]:
        """Yield the rate in mm/s at which the distance of the two tips changes. A rigid object keeps it at zero."""
        if (contacts := self.contacts(view)) is not None:
            way = self.leader.pose(view, contacts[0])[:3, 3] - self.follower.pose(view, contacts[1])[:3, 3]
            distance_m = math.sqrt(float(way @ way))
            if distance_m > 0.0:
                apart_m_s = self.leader.velocity(view, contacts[0]) - self.follower.velocity(view, contacts[1])
                closing_m_s = abs(float(way @ apart_m_s)) / distance_m
                yield Reading(self.follower.role, 1e3 * closing_m_s, contacts[1].seq)

    def uneven(self, view: CellView) -> Iterator[Reading]:
        """Yield the difference of the two indentations in mm."""
        if (contacts := self.contacts(view)) is not None:
            leading, following = contacts[0].depth_m, contacts[1].depth_m
            if leading is not None and following is not None:
                yield Reading(self.follower.role, 1e3 * abs(leading - following), contacts[1].seq)


@dataclass(frozen=True, slots=True)
class ObjectLost:
    """Limit the time without contact at either sensor once both have touched the object."""

    name: str
    severity: Severity
    sensors: tuple[str, str]
    limit_s: float
    states: frozenset[str]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the sensor whose contact has been missing longest, if too long."""
        if not view.works_in(self.states):
            return None, {}
        touching = {role: role in view.sensors and view.sensors[role].in_contact for role in self.sensors}
        if not past and not all(touching.values()):
            return None, {}
        marks = {role: TimerState(view.now_ns) if touching[role] else past[role] for role in self.sensors}

        def words(role: str) -> str:
            other = self.sensors[1 - self.sensors.index(role)]
            return f"no contact, and {other} still pushes" if touching[other] else "neither sensor has contact"

        return overdue(self.name, self.severity, view, marks, self.limit_s, words), marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield for how long contacts have been missing."""
        yield from waited(view, past, self.limit_s)


@dataclass(frozen=True, slots=True)
class Toppling:
    """Limit the tilt and tilt rate of the touched object, and its sliding up or down along the sensors.

    The tilt is how far the surface under each sensor has turned from the horizontal direction that it had when the
    contact was made, in the world, independent of the sensor's own motion. Surfaces that face opposite ways turn
    opposite ways, so with two sensors it is the mean of both. Sliding is the vertical part of the shear in the world:
    it precedes any measurable tilt.

    Attributes:
        sensors: the pushing one first.
        lean, rate, slide: limits, as interlocks over readings taken here.
    """

    name: str
    severity: Severity
    sensors: tuple[Carried, ...]
    lean: Sustained
    rate: Sustained
    slide: Sustained
    states: frozenset[str]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return the first violation of the limits of tilt, tilt rate and slide."""
        if not view.works_in(self.states):
            return None, {}
        marks: dict[str, TimerState] = {}
        turned, slides, seq = [], [], None
        for k, carried in enumerate(self.sensors):
            if (sensor := carried.contact(view)) is None:
                continue
            assert sensor.T_s_f is not None
            R = carried.pose(view, sensor)[:3, :3] @ sensor.T_s_f[:3, :3]
            elevation = math.asin(max(-1.0, min(1.0, float(R[2, 2]))))
            # Displacement of the sensor in the surface's frame.
            shear = -sensor.T_s_f[:3, :3].T @ sensor.T_s_f[:3, 3]
            slides.append(Reading(carried.role, 1e3 * abs(float(R[2, :2] @ shear[:2])), sensor.seq))
            mark = past.get(carried.role)
            if mark is None and (sensor.depth_m or 0.0) >= _REFERENCE_DEPTH_M:
                mark = TimerState(view.now_ns, values=(elevation,))
            if mark is not None:
                marks[carried.role] = mark
                turned.append((-1.0 if k else 1.0) * (elevation - mark.values[0]))
                seq = sensor.seq
        readings: tuple[list[Reading], list[Reading], list[Reading]] = ([], [], slides)
        if turned:
            subject, lean_deg = self.sensors[0].role, math.degrees(sum(turned) / len(turned))
            rate_deg_s, marks["smoothed"] = _rate(lean_deg, view.now_ns, past.get("smoothed"))
            readings[0].append(Reading(subject, abs(lean_deg), seq))
            readings[1].append(Reading(subject, abs(rate_deg_s), seq))
        found = None
        for k, rule in enumerate((self.lean, self.rate, self.slide)):
            violation, left = rule.over(view, readings[k], select_state(past, k))
            marks.update(number_state(left, k))
            found = found or violation
        return found, marks


def _rate(value: float, now_ns: int, mark: TimerState | None) -> tuple[float, TimerState]:
    """Return the rate of ``value`` per second over about ``_RATE_S``, and the timer state for the next cycle."""
    if mark is None:
        return 0.0, TimerState(now_ns, values=(value,))
    slow = mark.values[0]
    rate = (value - slow) / _RATE_S
    slow += (value - slow) * -math.expm1(-(now_ns - mark.since_ns) * 1e-9 / _RATE_S)
    return rate, TimerState(now_ns, values=(slow,))


def _taken_elsewhere(view: CellView) -> tuple[Reading, ...]:
    return ()


class _PairSettings(SpatialInterlockConfig):
    """Settings of an interlock on a pair of arms.

    Attributes:
        severity: as of every interlock.
        leader_sensor: role of the leader's sensor.
        follower_sensor: role of the follower's sensor.
        states: states of the task in which it is judged; none for all.
    """

    severity: Literal["limit", "trip", "fault"] = "trip"  # type: ignore[assignment]
    leader_sensor: str = "leader_sensor"
    follower_sensor: str = "follower_sensor"
    states: tuple[str, ...] = ()


class OutOfStepConfig(_PairSettings):
    """Largest rate at which the tips of leader and follower close or part, and largest difference of their depths.

    Attributes:
        leader: role of the arm that carries the leader's sensor.
        follower: role of the arm that carries the follower's sensor.
        limit_mm_s: largest rate at which the tips close or part.
        limit_mm: largest difference of the depths.
        hold_ms: how long either may be exceeded.
    """

    kind: Literal["out_of_step"]
    leader: str = "leader"
    follower: str = "follower"
    limit_mm_s: PositiveFloat
    limit_mm: PositiveFloat
    hold_ms: NonNegativeFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return tips that part, and tips pressed in unevenly."""
        states, wrong = _pair_states(self, facts)
        yield from wrong
        places = ((self.leader_sensor, self.leader), (self.follower_sensor, self.follower))
        for key, (sensor, arm) in zip(("leader", "follower"), places, strict=True):
            if (problem := mount_problem(sensor, arm, facts, key)) is not None:
                wrong = (*wrong, problem)
                yield problem
        if wrong:
            return
        fastest_m_s = sum(limits.speed_m_s for _, arm in places if (limits := facts.arms[arm].limits) is not None)
        speed_m_s = just_beyond(1e-3 * self.limit_mm_s, fastest_m_s)
        deepest_m = min(facts.sensors[sensor].depth_m for sensor, _ in places)
        uneven_m = just_beyond(1e-3 * self.limit_mm, 0.99 * deepest_m)

        def step(parting_m_s: float, deeper_m: float) -> Change:
            def change(view: CellView, t_s: float) -> CellView:
                view = _facing(view, facts, *places[0], -1.0, 0.01 * deepest_m + deeper_m)
                view = _facing(view, facts, *places[1], 1.0, 0.01 * deepest_m)
                twist = np.zeros(6)
                twist[:3] = facts.base(self.follower)[:3, :3].T @ np.array([parting_m_s, 0.0, 0.0])
                return with_motion(view, self.follower, twist=twist)

            return change

        for what, limit, key, change in (
            (f"tips part at {1e3 * speed_m_s:.3g} mm/s", f"{self.limit_mm_s:g} mm/s", "limit_mm_s", step(speed_m_s, 0)),
            (f"depths differ by {1e3 * uneven_m:.2f} mm", f"{self.limit_mm:g} mm", "limit_mm", step(0, uneven_m)),
        ):
            yield Fault(self.follower_sensor, what, limit, change, step(0, 0), states=states, key=key, hint="lower it")

    def build_in_scene(
        self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene
    ) -> TimedInterlock:
        """Return the interlock on synchronised contacts. Raises ConfigError for a sensor that the cell lacks."""
        leader = _carried(name, "leader_sensor", self.leader_sensor, self.leader, T_tcp_sensor, planning_scene)
        follower = _carried(name, "follower_sensor", self.follower_sensor, self.follower, T_tcp_sensor, planning_scene)
        pair, hold_s = _Pair(leader, follower, frozenset(self.states)), 1e-3 * self.hold_ms
        speed, depth = self.limit_mm_s, self.limit_mm
        return AnyOf(
            name,
            self.level,
            (
                Sustained(
                    name, self.level, pair.closing, "tips close or part at", speed, LEAVE * speed, "mm/s", hold_s
                ),
                Sustained(name, self.level, pair.uneven, "depths differ by", depth, LEAVE * depth, "mm", hold_s),
            ),
        )


class ObjectLostConfig(_PairSettings):
    """Longest time without contact at either sensor once both have touched the object.

    Attributes:
        limit_ms: longest time without contact.
    """

    kind: Literal["object_lost"]
    severity: Literal["trip", "fault"] = "trip"
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each of the two contacts lost."""
        states, wrong = _pair_states(self, facts)
        yield from wrong
        for key, role in (("leader_sensor", self.leader_sensor), ("follower_sensor", self.follower_sensor)):
            if (problem := role_problem(role, facts.sensors, "sensor", key)) is not None:
                wrong = (*wrong, problem)
                yield problem
        if wrong:
            return

        def held(view: CellView, t_s: float) -> CellView:
            view = with_sensor(view, self.leader_sensor, in_contact=True)
            return with_sensor(view, self.follower_sensor, in_contact=True)

        def without(role: str) -> Change:
            return lambda view, t_s: with_sensor(held(view, t_s), role, in_contact=False)

        for role in (self.leader_sensor, self.follower_sensor):
            yield Fault(
                role,
                "contact lost",
                f"{self.limit_ms:g} ms",
                without(role),
                held,
                states=states,
                key="limit_ms",
                hint=f"lower it below {1e3 * HELD_S:g} ms",
            )

    def build_in_scene(
        self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene
    ) -> TimedInterlock:
        """Return the ``ObjectLost`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        for key, role in (("leader_sensor", self.leader_sensor), ("follower_sensor", self.follower_sensor)):
            _require_sensor(name, key, role, T_tcp_sensor)
        sensors = (self.leader_sensor, self.follower_sensor)
        return ObjectLost(name, self.level, sensors, 1e-3 * self.limit_ms, frozenset(self.states))


class TopplingConfig(SpatialInterlockConfig):
    """Largest tilt and tilt rate of the touched object, and largest vertical shear; how long each may be exceeded.

    ``sensors`` are the pushing one, or the pushing and the counter-pushing one, with the ``arms`` that carry them.

    Attributes:
        sensors: roles of the pushing sensor, and of the counter-pushing one.
        arms: roles of the arms that carry them.
        limit_deg: largest tilt of the object.
        limit_deg_s: largest tilt rate.
        limit_mm: largest vertical shear.
        hold_ms: how long each may be exceeded.
        states: states of the task in which it is judged; none for all.
    """

    kind: Literal["toppling"]
    severity: Literal["limit", "trip", "fault"] = "trip"  # type: ignore[assignment]
    sensors: tuple[str, ...] = Field(default=("leader_sensor", "follower_sensor"), min_length=1, max_length=2)
    arms: tuple[str, ...] = Field(default=("leader", "follower"), min_length=1, max_length=2)
    limit_deg: PositiveFloat
    limit_deg_s: PositiveFloat
    limit_mm: PositiveFloat
    hold_ms: NonNegativeFloat
    states: tuple[str, ...] = ()

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return an object that topples slowly, and one that slides down."""
        states, wrong = states_of(self.states, facts)
        yield from wrong
        if len(set(self.sensors)) < len(self.sensors):
            wrong = (*wrong, CannotTrip(self.sensors[0], "names one sensor twice", "sensors"))
            yield wrong[-1]
        places = tuple(zip(self.sensors, self.arms, strict=False))
        for sensor, arm in places:
            if (problem := mount_problem(sensor, arm, facts, "arms")) is not None:
                wrong = (*wrong, problem)
                yield problem
        for key, limit, most, unit in (
            ("limit_deg", self.limit_deg, _FALLEN_DEG, "deg"),
            ("limit_deg_s", self.limit_deg_s, _FALLING_DEG_S, "deg/s"),
        ):
            if limit >= most:
                wrong = (
                    *wrong,
                    CannotTrip(self.sensors[0], f"{limit:g} {unit} is not below {most:g}", key, "lower it"),
                )
                yield wrong[-1]
        if wrong:
            return
        depth_m = min(2.0 * _REFERENCE_DEPTH_M, *(facts.sensors[sensor].depth_m for sensor, _ in places))
        slide_m = just_beyond(1e-3 * self.limit_mm, min(facts.sensors[sensor].shear_m for sensor, _ in places))
        lean_s = self.limit_deg / (0.5 * self.limit_deg_s)

        def topple(rate_deg_s: float, slides_m: float) -> Change:
            def change(view: CellView, t_s: float) -> CellView:
                lean_rad = math.radians(min(rate_deg_s * max(t_s, 0.0), _FALLEN_DEG))
                for k, (sensor, arm) in enumerate(places):
                    side = 1.0 if k else -1.0
                    view = _facing(view, facts, sensor, arm, side, depth_m, lean_rad=lean_rad, slides_m=slides_m)
                return view

            return change

        lean, slide = topple(0.5 * self.limit_deg_s, 0.0), topple(0.0, slide_m)
        first = self.sensors[0]
        leans = f"leans by up to {_FALLEN_DEG:g} deg, at {0.5 * self.limit_deg_s:g} deg/s"
        within_s, covers = 1.1 * lean_s + HELD_S, self.sensors
        still = topple(0.0, 0.0)
        yield Fault(
            first, leans, f"{self.limit_deg:g} deg", lean, still, 0.0, within_s, states, covers, "limit_deg", "lower it"
        )
        yield Fault(
            first,
            f"slides down by {1e3 * slide_m:.2f} mm",
            f"{self.limit_mm:g} mm",
            slide,
            still,
            states=states,
            covers=covers,
            key="limit_mm",
            hint="lower it below the shear that the estimators report",
        )

    def build_in_scene(
        self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene
    ) -> TimedInterlock:
        """Return the ``Toppling`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        if len(self.arms) < len(self.sensors):
            raise ConfigError("names fewer arms than sensors", key=f"interlocks.{name}.arms", value=self.arms)
        carried = tuple(
            _carried(name, "sensors", sensor, arm, T_tcp_sensor, planning_scene)
            for sensor, arm in zip(self.sensors, self.arms, strict=False)
        )

        def rule(what: str, limit: float, unit: str) -> Sustained:
            hold_s = 1e-3 * self.hold_ms
            return Sustained(name, self.level, _taken_elsewhere, what, limit, LEAVE * limit, unit, hold_s)

        return Toppling(
            name,
            self.level,
            carried,
            rule("leans by", self.limit_deg, "deg"),
            rule("leans at", self.limit_deg_s, "deg/s"),
            rule("slides up or down by", self.limit_mm, "mm"),
            frozenset(self.states),
        )


def _pair_states(
    settings: OutOfStepConfig | ObjectLostConfig, facts: CellFacts
) -> tuple[tuple[str, ...], tuple[CannotTrip, ...]]:
    """Return the states in which a rule about a pair counts, and what is wrong with them and with the pair."""
    states, wrong = states_of(settings.states, facts)
    if settings.leader_sensor == settings.follower_sensor:
        reason = f"leader and follower are one sensor, {settings.leader_sensor!r}"
        wrong = (*wrong, CannotTrip(settings.leader_sensor, reason, "follower_sensor", "name two"))
    return states, wrong


def _facing(
    view: CellView,
    facts: CellFacts,
    sensor: str,
    arm: str,
    side: float,
    depth_m: float,
    *,
    lean_rad: float = 0.0,
    slides_m: float = 0.0,
) -> CellView:
    """Return ``view`` with a sensor pressed along the world's x axis from ``side``, its tip leaning and sheared."""
    upright = np.array([0.0, 0.0, 0.0, 0.0, -0.5 * math.pi * side, 0.0])
    leaning = np.array([0.0, 0.0, 0.0, 0.0, -lean_rad, 0.0])
    T_world_sensor = se3.exp(leaning) @ se3.exp(upright)
    T_world_sensor[:3, 3] = [0.1 * side, 0.0, 0.3]
    T_base_tcp = se3.inverse(facts.base(arm)) @ T_world_sensor @ se3.inverse(facts.sensors[sensor].T_tcp_sensor)
    down = T_world_sensor[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    T_s_f = np.eye(4)
    T_s_f[:3, 3] = slides_m * down
    view = with_motion(view, arm, T_base_tcp)
    return with_sensor(view, sensor, in_contact=True, depth_m=depth_m, T_s_f=T_s_f)


def _carried(
    name: str,
    key: str,
    sensor: str,
    arm: str,
    T_tcp_sensor: Mapping[str, Array],
    planning_scene: PlanningScene,
) -> Carried:
    _require_sensor(name, key, sensor, T_tcp_sensor)
    return Carried(sensor, planning_scene.T_world_base.get(arm, np.eye(4)), T_tcp_sensor[sensor])


def _require_sensor(name: str, key: str, sensor: str, T_tcp_sensor: Mapping[str, Array]) -> None:
    if sensor not in T_tcp_sensor:
        raise ConfigError(
            f"the task has no sensor {sensor!r}",
            key=f"interlocks.{name}.{key}",
            value=sensor,
            hint=f"sensors: {', '.join(sorted(T_tcp_sensor)) or 'none'}",
        )


OUT_OF_STEP = InterlockSpec(
    "out_of_step", "leader and follower keep their distance and share the load", OutOfStepConfig
)
OBJECT_LOST = InterlockSpec("object_lost", "the object held by two sensors stays between them", ObjectLostConfig)
TOPPLING = InterlockSpec("toppling", "the pushed or held object does not begin to topple", TopplingConfig)
