"""Armed coverage: the faults that must trip an interlock, described by the interlock's own settings.

Settings that have a method ``faults`` take part in the proof (``touchcell.control.proof``), also those of another
package. It returns, for each arm or sensor that the interlock guards, a change to a healthy snapshot that must make it
trip, or the reason why no snapshot of this cell ever could. See docs/explanation/armed-coverage.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView, DeviceView, SensorView
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.samples import Health, Stamped, TcpState
from touchcell.errors import suggest
from touchcell.geometry.types import Array

SILENCE_S: Final = 1.0
"""Silence of a sensor or an arm that must trip."""
HELD_S: Final = 2.0
"""Any other lasting fault must trip within this time."""
RUNAWAY: Final = 3.0
"""A tool at this multiple of the speeds of its gate must trip."""
_JUST_BEYOND = 1.02


@dataclass(frozen=True, slots=True, eq=False)
class ArmFacts:
    """What an arm of the cell can do and report.

    Attributes:
        limits: of its gate; None for an arm that is never commanded, such as a replay.
        reach_m: distance from its base that no point of its tool exceeds.
        moved: True if the task commands it.
        wrench: True if it reports the wrench on its tool.
        torque_joints: number of joints whose external torque it reports.
    """

    limits: TwistLimits | None
    reach_m: float
    moved: bool = True
    wrench: bool = False
    torque_joints: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class SensorFacts:
    """What a tactile sensor of the cell can report.

    Attributes:
        estimator: its name, for messages.
        arm: role of the arm that carries it; None for a fixed sensor.
        T_tcp_sensor: (4, 4) its mount.
        depth_m, shear_m, torsion_rad: the largest values that its estimator can report.
        sigma_m: the largest standard deviation of the depth that it can report; 0 if it reports none.
        least_sigma_m: the smallest standard deviation of the depth that one of its frames has; 0 if that is not known.
        frame_rate_hz: rate of its frames.
        leaves_range: True if it can report to be outside its training range.
        innovations: True if a filter reports normalised innovations.
        images: True if its images can be checked.
        markers: True if it reports the fraction of markers that it detects.
    """

    estimator: str
    arm: str | None
    T_tcp_sensor: Array
    depth_m: float
    shear_m: float
    torsion_rad: float
    sigma_m: float = 0.0
    frame_rate_hz: float = 30.0
    leaves_range: bool = False
    innovations: bool = False
    images: bool = False
    markers: bool = False
    least_sigma_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CellFacts:
    """What a cell can show its interlocks.

    Attributes:
        period_s: of the control cycle.
        states: names of the task's states in which it works; empty if the task does not name them.
        arms, sensors: by role.
        scene: where the arms stand and what they look like.
        enabling_device: True if an operator input holds the cell enabled.
        devices: roles of other devices that are read.
        health: devices that report about themselves, by name, with healthy values of the readings that are limited.
    """

    period_s: float
    states: Sequence[str]
    arms: Mapping[str, ArmFacts]
    sensors: Mapping[str, SensorFacts]
    scene: PlanningScene = field(default_factory=PlanningScene)
    enabling_device: bool = False
    devices: Sequence[str] = ()
    health: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def healthy(self, now_ns: int, task_state: str) -> CellView:
        """Return a snapshot with fresh data in which every arm is at rest and no sensor in contact."""
        still = TcpState(np.eye(4), np.zeros(6))
        arms = {role: ArmView(Stamped(still, now_ns, now_ns)) for role in self.arms}
        sensors = {}
        for role, sensor in self.sensors.items():
            seq = int(now_ns * 1e-9 * sensor.frame_rate_hz)
            sensors[role] = SensorView(
                now_ns,
                seq,
                False,
                content=seq if sensor.images else None,
                brightness=100.0 if sensor.images else None,
                markers=1.0 if sensor.markers else None,
                arm=sensor.arm,
            )
        devices = {role: DeviceView(Stamped({}, now_ns, now_ns)) for role in self.devices}
        health: dict[str, Stamped[Health]] = {
            name: Stamped(readings, now_ns, now_ns) for name, readings in self.health.items()
        }
        return CellView(now_ns, arms, sensors, task_state, devices=devices, health=health)

    def base(self, arm: str) -> Array:
        """Return the pose (4, 4) of an arm's base in the world."""
        return self.scene.T_world_base.get(arm, np.eye(4))


Change = Callable[[CellView, float], CellView]
"""Put a fault into a healthy snapshot, given the seconds since the fault began."""


def unchanged(view: CellView, t_s: float) -> CellView:
    """Return ``view`` as it is."""
    return view


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """A fault that must trip an interlock.

    Attributes:
        subject: role of the arm or sensor concerned.
        what: description, for the operator.
        limit: the limit that it exceeds, with its unit.
        change: puts it into a snapshot; whatever the state of the task, where no states are named.
        before: what the snapshots before it show, in place of a healthy cell.
        before_s: how long they last.
        within_s: time within which the interlock must have tripped.
        states: task states in which it counts; empty for all.
        covers: roles that are guarded if it trips; the subject if empty.
        key: of the cell file, below the interlock, that decides about it.
        hint: remedy if it does not trip.
        by_error: True where a measurement that the interlock needs is missing, so that it raises, which is a trip too.
            Anywhere else an exception would hide that its limit is never compared.
    """

    subject: str
    what: str
    limit: str
    change: Change
    before: Change = unchanged
    before_s: float = 0.0
    within_s: float = HELD_S
    states: tuple[str, ...] = ()
    covers: tuple[str, ...] = ()
    key: str = ""
    hint: str = ""
    by_error: bool = False


@dataclass(frozen=True, slots=True)
class CannotTrip:
    """Nothing that this cell can show trips an interlock for one arm or sensor.

    Attributes:
        subject: role of the arm or sensor concerned; empty for all.
        reason: why.
        key: of the cell file, below the interlock.
        hint: remedy.
        fatal: True if the cell must be refused for it; False where only some of several sensors lack an ability.
    """

    subject: str
    reason: str
    key: str = ""
    hint: str = ""
    fatal: bool = True


@runtime_checkable
class Provable(Protocol):
    """Settings of an interlock that take part in the proof."""

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return the faults that must trip the interlock in a cell with these facts, and where none can."""
        ...


def with_arm(view: CellView, role: str, **changes: Any) -> CellView:
    """Return ``view`` with changed attributes of one arm."""
    return replace(view, arms={**view.arms, role: replace(view.arms[role], **changes)})


def with_sensor(view: CellView, role: str, **changes: Any) -> CellView:
    """Return ``view`` with changed attributes of one sensor."""
    return replace(view, sensors={**view.sensors, role: replace(view.sensors[role], **changes)})


def with_reading(view: CellView, role: str, age_s: float = 0.0, **values: float) -> CellView:
    """Return ``view`` with named numbers that another device has read, ``age_s`` ago."""
    reading: Stamped[Mapping[str, float]] = Stamped(values, view.now_ns - round(1e9 * age_s), view.now_ns)
    return replace(view, devices={**view.devices, role: replace(view.devices[role], reading=reading)})


def with_health(view: CellView, device: str, age_s: float = 0.0, **readings: float) -> CellView:
    """Return ``view`` with changed readings of what a device reports about itself, ``age_s`` ago."""
    before = view.health[device]
    sample: Stamped[Health] = Stamped({**before.value, **readings}, view.now_ns - round(1e9 * age_s), before.seq)
    return replace(view, health={**view.health, device: sample})


def with_motion(view: CellView, role: str, T_base_tcp: Array | None = None, twist: Array | None = None) -> CellView:
    """Return ``view`` with another measured pose (4, 4) or twist (6,) of one arm."""
    sample = view.arms[role].state
    T = sample.value.T_base_tcp if T_base_tcp is None else T_base_tcp
    state = TcpState(T, sample.value.twist if twist is None else twist)
    return with_arm(view, role, state=replace(sample, value=state))


def just_beyond(limit: float, most: float) -> float:
    """Return a value just beyond ``limit``, or ``most`` if that is less."""
    return min(_JUST_BEYOND * limit, most)


def of_each_sensor(
    facts: CellFacts, able: Callable[[SensorFacts], bool], lacks: str, fault: Callable[[str, SensorFacts], Fault]
) -> Iterable[Fault | CannotTrip]:
    """Return a fault of each sensor that is ``able`` to show it.

    Args:
        facts: of the cell.
        able: selects sensors that can show the fault.
        lacks: what the others lack, after the name of their estimator.
        fault: makes the fault of a role.
    """
    has_any = any(able(sensor) for sensor in facts.sensors.values())
    if not facts.sensors:
        yield CannotTrip("", "the task has no tactile sensor")
    for role, sensor in facts.sensors.items():
        if able(sensor):
            yield fault(role, sensor)
        else:
            yield CannotTrip(role, f"{sensor.estimator} {lacks}", "kind", fatal=not has_any)


def states_of(
    states: Sequence[str], facts: CellFacts, *, chosen: bool = True
) -> tuple[tuple[str, ...], tuple[CannotTrip, ...]]:
    """Return the task states in which an interlock counts, and what is wrong with them.

    Args:
        states: as the settings name them; empty for all.
        facts: of the cell.
        chosen: False for a default, of which those that the task does not have are left out.
    """
    if not facts.states:
        return tuple(states), ()
    wrong = [state for state in states if state not in facts.states]
    known = tuple(state for state in states if state in facts.states)
    if (wrong and chosen) or (states and not known):
        return known, (
            CannotTrip(
                "",
                f"the task has no working state {wrong[0]!r}",
                "states",
                f"{suggest(wrong[0], sorted(facts.states))}; its states: {', '.join(facts.states)}",
            ),
        )
    return known, ()


def role_problem(role: str, roles: Iterable[str], what: str, key: str) -> CannotTrip | None:
    """Return what is wrong with a role that the task does not have; None if it has it."""
    known = sorted(roles)
    if role in known:
        return None
    return CannotTrip(role, f"the task has no {what} {role!r}", key, suggest(role, known))


def mount_problem(sensor: str, arm: str, facts: CellFacts, key: str) -> CannotTrip | None:
    """Return what is wrong with a sensor that is configured to sit on an arm; None if it does."""
    for role, roles, what in ((arm, facts.arms, "arm"), (sensor, facts.sensors, "sensor")):
        if (problem := role_problem(role, roles, what, key)) is not None:
            return problem
    carrier = facts.sensors[sensor].arm
    if carrier == arm:
        return None
    return CannotTrip(arm, f"{sensor} is mounted on {carrier or 'no arm'}, not on {arm}", key, "name the one that is")
