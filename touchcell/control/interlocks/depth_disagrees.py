"""A second depth channel that does not know the network: travel of the arm, and force where it is measured.

Beyond the depth that a network was trained on, its estimate falls again and looks healthy. The arm's own poses give how
far it has travelled into a surface that stands still, and its wrench how hard it presses. Either has to agree with the
estimate (two channels compared, ISO 13849-1:2023, 6.1.3.2.5; not safety-rated).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from touchcell.control.interlocks.coverage import (
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    SensorFacts,
    of_each_sensor,
    states_of,
    with_arm,
    with_motion,
    with_sensor,
)
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import (
    InterlockState,
    Judgement,
    Reading,
    Sustained,
    TimedInterlock,
    TimerState,
    number_state,
    select_state,
)
from touchcell.control.interlocks.violation import Severity
from touchcell.drivers.core.samples import Stamped
from touchcell.geometry import se3
from touchcell.geometry.types import Array

TOO_DEEP_M: Final = 0.025
"""A sensor pressed in this far while its estimate stays in range must trip."""
_RECONTACT_NS = 500_000_000
"""A contact that is missing for less is the same contact: its reference stays."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthDisagrees:
    """Require the estimated depth to agree with the travel since first contact, and with the force.

    The reference is the pose of the sensor at first contact, where the depth is zero. After sliding sideways by more
    than ``slide_m`` it is taken anew, at the estimated depth: then changes are compared. It is dropped outside
    ``states``, as a surface that moves away makes travel that is no depth.

    Attributes:
        T_tcp_sensor: (4, 4) mount of each sensor, by role.
        travel: limit on the difference to the travel; its readings are taken here.
        force: limit on the difference to the depth that the force stands for; likewise.
        slide_m: sideways travel after which the reference is taken anew.
        stiffness_n_m: force per depth; None where no force is compared.
        states: task states in which the surface stands still.
    """

    name: str
    severity: Severity
    T_tcp_sensor: Mapping[str, Array]
    travel: Sustained
    force: Sustained
    slide_m: float
    stiffness_n_m: float | None
    states: frozenset[str]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return the first disagreement that lasts too long. Raises ValueError without the wrench that it needs."""
        marks: dict[str, TimerState] = {}
        by_travel: list[Reading] = []
        by_force: list[Reading] = []
        for role, sensor in view.sensors.items():
            if sensor.arm is None or sensor.arm not in view.arms or role not in self.T_tcp_sensor:
                continue
            arm, estimate_m = view.arms[sensor.arm], _depth(sensor)
            T_base_sensor = arm.state.value.T_base_tcp @ self.T_tcp_sensor[role]
            if self.stiffness_n_m is not None and sensor.in_contact:
                pressed_m = _push(arm, T_base_sensor, view.now_ns) / self.stiffness_n_m
                by_force.append(Reading(role, 1e3 * abs(pressed_m - estimate_m), sensor.seq))
            if not view.works_in(self.states):
                continue
            mark = past.get(role)
            if mark is not None and view.now_ns - mark.since_ns > _RECONTACT_NS:
                mark = None
            if not sensor.in_contact:
                if mark is not None:
                    marks[role] = mark
                continue
            # A reference taken in the middle of a contact can only be the estimate.
            if mark is None:
                began = role in past or past.get(f"free {role}") is not None
                mark = _reference(view.now_ns, T_base_sensor, 0.0 if began else estimate_m)
            travel_m, slid_m = _travel(T_base_sensor, mark.values)
            if slid_m > self.slide_m:
                mark = _reference(view.now_ns, T_base_sensor, estimate_m)
                travel_m = estimate_m
            marks[role] = replace(mark, since_ns=view.now_ns)
            by_travel.append(Reading(role, 1e3 * abs(travel_m - estimate_m), sensor.seq))
        # Whether a contact has just begun is known only of a sensor that was seen without one.
        for role, sensor in view.sensors.items():
            if not sensor.in_contact:
                marks[f"free {role}"] = TimerState(view.now_ns)
        found = None
        for k, (rule, readings) in enumerate(((self.travel, by_travel), (self.force, by_force))):
            violation, left = rule.over(view, readings, select_state(past, k))
            marks.update(number_state(left, k))
            found = found or violation
        return found, marks


def _depth(sensor: SensorView) -> float:
    return 0.0 if sensor.depth_m is None else sensor.depth_m


def _reference(now_ns: int, T_base_sensor: Array, depth_m: float) -> TimerState:
    """Return the reference: position (3,) and axis (3,) of the sensor, and its depth there."""
    place, axis = T_base_sensor[:3, 3].tolist(), T_base_sensor[:3, 2].tolist()
    return TimerState(now_ns, values=(*place, *axis, depth_m))


def _travel(T_base_sensor: Array, reference: tuple[float, ...]) -> tuple[float, float]:
    """Return the depth by travel since the reference, along its axis, and the travel sideways, m."""
    x, y, z, a, b, c, depth_m = reference
    px, py, pz = T_base_sensor[:3, 3].tolist()
    dx, dy, dz = px - x, py - y, pz - z
    along = a * dx + b * dy + c * dz
    return depth_m + along, math.sqrt(max(dx * dx + dy * dy + dz * dz - along * along, 0.0))


def _push(arm: ArmView, T_base_sensor: Array, now_ns: int) -> float:
    """Return the force along the sensor's axis into the surface, N. Raises ValueError without a fresh wrench."""
    if arm.wrench is None or not 0 <= now_ns - arm.wrench.t_ns <= _RECONTACT_NS:
        raise ValueError("there is no fresh wrench to compare the depth with")
    return -float(T_base_sensor[:3, 2] @ arm.wrench.value[:3])


class DepthDisagreesConfig(GradedSettings):
    """Largest difference between the estimated depth and the depth by travel since first contact, or by force.

    Attributes:
        limit_mm: largest difference.
        hold_ms: time for which it may be exceeded.
        slide_mm: sideways travel after which the reference is taken anew, at the estimated depth.
        stiffness_n_mm: of skin and surface; adds the comparison with the force, in every state, for arms that report a
            wrench.
        states: task states in which the surface stands still.
    """

    kind: Literal["depth_disagrees"]
    limit_mm: PositiveFloat
    hold_ms: NonNegativeFloat = 0.0
    slide_mm: PositiveFloat = 5.0
    stiffness_n_mm: PositiveFloat | None = None
    states: tuple[str, ...] = Field(min_length=1)

    @property
    def measures(self) -> frozenset[str]:
        """The wrench, where it is compared."""
        return frozenset() if self.stiffness_n_mm is None else frozenset({"wrench"})

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each sensor pressed in far beyond its range while its estimate stays healthy."""
        states, wrong = states_of(self.states, facts)
        yield from wrong
        if wrong:
            return

        def by_travel(role: str, sensor: SensorFacts) -> Fault:
            assert sensor.arm is not None
            estimate_m = min(0.5 * sensor.depth_m, 0.2 * TOO_DEEP_M)
            return Fault(
                role,
                f"travels {1e3 * TOO_DEEP_M:g} mm in, reads {1e3 * estimate_m:.1f} mm",
                f"{self.limit_mm:g} mm",
                _pressed(role, sensor, facts, estimate_m, 1e3 * (self.stiffness_n_mm or 0.0)),
                states=states,
                key="limit_mm",
                hint=f"lower it below {1e3 * (TOO_DEEP_M - estimate_m):.1f}",
            )

        yield from of_each_sensor(
            facts, lambda sensor: sensor.arm is not None and sensor.depth_m > 0.0, "is not carried by an arm", by_travel
        )
        if self.stiffness_n_mm is None:
            return
        stiffness_n_m = 1e3 * self.stiffness_n_mm
        for role, sensor in facts.sensors.items():
            if sensor.arm is None or not facts.arms[sensor.arm].wrench:
                yield CannotTrip(role, "its arm reports no wrench", "stiffness_n_mm", "leave it out")
                continue
            yield Fault(
                role,
                f"presses with {TOO_DEEP_M * stiffness_n_m:.0f} N, reads no depth",
                f"{self.limit_mm:g} mm",
                _pushed(role, sensor, TOO_DEEP_M * stiffness_n_m),
                _pushed(role, sensor, 0.0),
                key="limit_mm",
                hint=f"lower it below {1e3 * TOO_DEEP_M:g}",
            )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``DepthDisagrees`` interlock."""

        def limit(what: str) -> Sustained:
            hold_s = 1e-3 * self.hold_ms
            return Sustained(name, self.level, lambda _: (), what, self.limit_mm, LEAVE * self.limit_mm, "mm", hold_s)

        return DepthDisagrees(
            name,
            self.level,
            T_tcp_sensor,
            limit("estimated depth is off the arm's travel by"),
            limit("estimated depth is off the arm's force by"),
            1e-3 * self.slide_mm,
            None if self.stiffness_n_mm is None else 1e3 * self.stiffness_n_mm,
            frozenset(self.states),
        )


def _pressed(role: str, sensor: SensorFacts, facts: CellFacts, estimate_m: float, stiffness_n_m: float) -> Change:
    """Return the change that presses a sensor in at the speed of its gate, with estimate and force that stay low."""
    assert sensor.arm is not None
    arm, limits = sensor.arm, facts.arms[sensor.arm].limits
    speed_m_s = 0.1 if limits is None else limits.speed_m_s
    axis = sensor.T_tcp_sensor[:3, 2]

    def change(view: CellView, t_s: float) -> CellView:
        travel_m = min(speed_m_s * t_s, TOO_DEEP_M)
        T = se3.exp(np.concatenate([travel_m * axis, np.zeros(3)]))
        read_m = min(travel_m, estimate_m)
        if stiffness_n_m > 0.0:
            view = _pushed(role, sensor, stiffness_n_m * read_m)(view, t_s)
        return with_sensor(with_motion(view, arm, T), role, in_contact=True, depth_m=read_m)

    return change


def _pushed(role: str, sensor: SensorFacts, force_n: float) -> Change:
    assert sensor.arm is not None
    arm, wrench = sensor.arm, np.concatenate([-force_n * sensor.T_tcp_sensor[:3, 2], np.zeros(3)])

    def change(view: CellView, t_s: float) -> CellView:
        view = with_arm(view, arm, wrench=Stamped(wrench, view.now_ns, 0))
        return with_sensor(view, role, in_contact=True, depth_m=0.0)

    return change


DEPTH_DISAGREES = InterlockSpec(
    "depth_disagrees", "the estimated depth agrees with the arm's travel, and with its force", DepthDisagreesConfig
)
