"""Armed coverage of a cell: every interlock is made to trip, and every moved arm and every sensor has to be guarded.

See docs/explanation/armed-coverage.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.interlocks.coverage import ArmFacts, CellFacts, SensorFacts
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.control.interlocks.readings import ReadingConfig
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Severity
from touchcell.control.proof import Proof, prove
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.protocols import (
    ExternalTorqueSource,
    HealthSource,
    ReadingSource,
    TwistSink,
    WrenchSource,
)
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.interface import Task, TaskContext

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan
    from touchcell.perception.models.model_file import Header
    from touchcell.perception.runtime.network_estimator import NetworkEstimator

REQUIRED_OF_ARMS: Final = ("workspace", "tcp_speed", "arm_state_age")
"""Kinds that must guard every arm that a task moves."""
REQUIRED_OF_SENSORS: Final = ("depth", "frame_age")
"""Kinds that must guard every sensor of such a task."""
REQUIRED_OF_NETWORKS: Final = ("out_of_range",)
"""Kinds that must guard every sensor of such a task whose estimator is a network."""
ADVISED_OF_NETWORKS: Final = {"frame_frozen": "freeze", "exposure": "turn dark or bright"}
"""Kinds of interlocks that tell, of a network's images, what their age does not."""
REQUIRED_OF_READINGS: Final = frozenset({"reading_age"})
"""Kinds that a task which moves an arm must have if it uses the readings of another device."""

_NETWORKS: Final = ("network", "edge_network")
_COLUMNS = ("interlock", "kind", "subject", "limit", "trips at", "after", "stops within", "margin left")
_ABILITIES: Final = {"true_contact": False, "known_surface": True}
"""Estimators of this package that are no networks, and whether their images can be checked."""
_TIP_M = 0.02
"""No tip is pressed in or sheared further than its own radius."""
_LONGEST_REACH_M = 3.0
"""Reach of an arm whose chain is not known."""
_SUREST = 0.75
"""Part of its mean error on the validation images that a network states as deviation at its best."""
_DEPTH_LABEL: Final = {True: "z_mm", False: "v_z"}
_DRIFTS_S = 60.0
"""A filter that is not corrected for this long has lost its contact."""


@dataclass(frozen=True, slots=True)
class NotArmed:
    """Why a cell is refused.

    Attributes:
        path: of the key in the cell file.
        reason: for people.
        hint: remedy.
    """

    path: tuple[str, ...]
    reason: str
    hint: str


def cell_facts(plan: CellPlan, scene: PlanningScene | None = None) -> CellFacts:
    """Return what a planned cell can show its interlocks.

    Args:
        plan: a checked cell file.
        scene: where the arms stand and what they look like; None to derive it from the plan.

    Raises:
        ConfigError: a chain file cannot be read, or an arm has no shape that a ``clearance`` needs.
    """
    from touchcell.cell.config.planning_scene import planned_scene

    role_of = arm_roles(plan)
    moved = {role for role, protocols in plan.task.arms.items() if TwistSink in protocols}
    sensors = {role: _sensor_facts(plan, name, role_of) for role, name in plan.sensor_roles.items()}
    task = built_task(plan)
    return CellFacts(
        1.0 / plan.cell.rate_hz,
        tuple(getattr(task, "states", ())),
        {role: _arm_facts(plan, name, moved=role in moved) for name, role in role_of.items()},
        sensors,
        planned_scene(plan, role_of) if scene is None else scene,
        plan.cell.enabling_device is not None,
        tuple(
            role
            for role, name in plan.auxiliary_roles.items()
            if ReadingSource in plan.auxiliaries[name].spec.capabilities.provides
        ),
        _health_facts(plan),
    )


def built_task(plan: CellPlan) -> Task:
    """Return the task of a planned cell, for what it declares of itself: nothing runs."""
    role_of = arm_roles(plan)
    sections = {role: plan.cell.sensors[name] for role, name in plan.sensor_roles.items()}
    carriers = {role: role_of[each.mounted_on] for role, each in sections.items() if each.mounted_on is not None}
    poses = {role: each.T_tcp_sensor for role, each in sections.items()}
    return plan.task.build(plan.task_config, TaskContext(plan.cell.rate_hz, poses, carriers=carriers))


def _health_facts(plan: CellPlan) -> dict[str, dict[str, float]]:
    """Return the devices that report about themselves, each with a value within the limits of each limited reading."""
    devices = {**plan.arms, **plan.sensors, **plan.auxiliaries}
    sources = {HealthSource, ReadingSource}
    found: dict[str, dict[str, float]] = {
        name: {} for name, device in devices.items() if sources & device.spec.capabilities.provides
    }
    bounds: dict[tuple[str, str], list[tuple[float | None, float | None]]] = {}
    for entry in plan.cell.interlocks.values():
        if isinstance(entry, ReadingConfig):
            bounds.setdefault((entry.device, entry.name), []).append(entry.bounds)
    for (device, name), limits in bounds.items():
        least = max((low for low, _ in limits if low is not None), default=None)
        most = min((high for _, high in limits if high is not None), default=None)
        if device in found:
            within = [bound for bound in (least, most) if bound is not None]
            found[device][name] = sum(within) / len(within)
    return found


def arm_roles(plan: CellPlan) -> dict[str, str]:
    """Return the role of each arm by its name; an arm that only carries a sensor has its name as role."""
    role_of = {name: role for role, name in plan.arm_roles.items()}
    return role_of | {name: name for name in plan.arms if name not in role_of}


def prove_cell(
    plan: CellPlan, facts: CellFacts, interlocks: Sequence[Interlock | TimedInterlock] | None = None
) -> tuple[Proof, ...]:
    """Make every interlock of a cell trip.

    Args:
        plan: a checked cell file.
        facts: of the cell.
        interlocks: as they are used, in the order of the file; None to build them from the plan.
    """
    settings = plan.cell.interlocks
    if interlocks is None:
        poses = {role: sensor.T_tcp_sensor for role, sensor in facts.sensors.items()}
        interlocks = build_interlocks(settings, poses, facts.scene)
    return tuple(
        proof
        for (name, entry), interlock in zip(settings.items(), interlocks, strict=True)
        for proof in prove(name, entry, interlock, facts)
    )


def not_armed(plan: CellPlan, facts: CellFacts, proofs: Sequence[Proof]) -> Iterator[NotArmed]:
    """Return every reason to refuse the cell: interlocks that cannot trip, arms and sensors that nothing guards."""
    seen = set()
    for proof in proofs:
        if not proof.problem or not proof.fatal or (proof.interlock, proof.key) in seen:
            continue
        seen.add((proof.interlock, proof.key))
        whom = f" for {proof.subject}" if proof.subject else ""
        path = tuple(part for part in ("interlocks", proof.interlock, proof.key) if part)
        yield NotArmed(path, f"cannot trip{whom}: {proof.problem}", proof.hint)
    stopping = {name for name, entry in plan.cell.interlocks.items() if entry.level is not Severity.LIMIT}
    covered = {
        (proof.kind, role)
        for proof in proofs
        if proof.tripped_s is not None and proof.interlock in stopping
        for role in proof.covers
    }
    refused = {(proof.kind, proof.subject) for proof in proofs if proof.problem and proof.fatal}
    reads = any(ReadingSource in protocols for protocols in plan.task.devices.values())
    if reads and any(arm.moved for arm in facts.arms.values()):
        kinds = {plan.cell.interlocks[name].kind for name in stopping}
        for kind in sorted(REQUIRED_OF_READINGS - kinds):
            reason = f"no interlock of kind {kind!r} that stops, which a task that moves an arm by readings must have"
            yield NotArmed(("interlocks",), reason, "add one")
    for kind, role, whose in _required(plan, facts):
        # What has a rule of that kind that cannot trip has been reported.
        if (kind, role) in covered | refused or (kind, "") in refused:
            continue
        entry = next((name for name, each in plan.cell.interlocks.items() if each.kind == kind), None)
        reason = f"no interlock of kind {kind!r} that stops guards {whose} {role!r}"
        hint = f"add one for {role}" if entry is None else f"{entry} does not: add one, or put it right"
        yield NotArmed(("interlocks",), reason, hint)


def require_armed(plan: CellPlan, interlocks: Sequence[Interlock | TimedInterlock], scene: PlanningScene) -> None:
    """Make every interlock trip, as it will be used. Raises ConfigError for the first that does not."""
    facts = cell_facts(plan, scene)
    for problem in not_armed(plan, facts, prove_cell(plan, facts, interlocks)):
        raise ConfigError(problem.reason, file=str(plan.file), key=".".join(problem.path), hint=problem.hint)


def advised(plan: CellPlan) -> Iterator[str]:
    """Return what the cell may run without and should not, one sentence each."""
    if not any(TwistSink in protocols for protocols in plan.task.arms.values()):
        return
    present = {entry.kind for entry in plan.cell.interlocks.values()}
    missing = [kind for kind in ADVISED_OF_NETWORKS if kind not in present]
    felt = [name for name in plan.sensor_roles.values() if plan.cell.sensors[name].estimator.kind in _NETWORKS]
    if missing and felt:
        names, what = ", ".join(felt), " or ".join(ADVISED_OF_NETWORKS[kind] for kind in missing)
        yield f"advice   {names}: nothing trips when its images {what}: add {' and '.join(missing)}"


def _required(plan: CellPlan, facts: CellFacts) -> Iterator[tuple[str, str, str]]:
    """Return (kind, role, "arm" or "sensor") of what must be guarded."""
    moved = [role for role, arm in facts.arms.items() if arm.moved]
    if not moved:
        return
    for role in moved:
        for kind in REQUIRED_OF_ARMS:
            yield kind, role, "arm"
    for role, sensor in facts.sensors.items():
        for kind in REQUIRED_OF_SENSORS:
            yield kind, role, "sensor"
        if sensor.arm in moved:
            yield "workspace", role, "sensor"
        if plan.cell.sensors[plan.sensor_roles[role]].estimator.kind in _NETWORKS:
            for kind in REQUIRED_OF_NETWORKS:
                yield kind, role, "sensor"


def _arm_facts(plan: CellPlan, name: str, *, moved: bool) -> ArmFacts:
    device = plan.arms[name]
    limits = getattr(device.config, "limits", None)
    chain = device.config.described_chain()
    # Proxies of arms in other processes pass neither wrench nor torque on.
    provides = device.spec.capabilities.provides if plan.cell.processes == "one" else frozenset()
    return ArmFacts(
        limits.build() if isinstance(limits, LimitsConfig) else None,
        _LONGEST_REACH_M if chain is None else chain.reach_m,
        moved,
        WrenchSource in provides,
        0 if chain is None or ExternalTorqueSource not in provides else chain.joint_count,
    )


def _sensor_facts(plan: CellPlan, name: str, role_of: Mapping[str, str]) -> SensorFacts:
    section = plan.cell.sensors[name]
    arm = None if section.mounted_on is None else role_of[section.mounted_on]
    device = plan.sensors[name]
    rate_hz = getattr(device.config, "rate_hz", None) or device.spec.capabilities.state_rate_hz or 30.0
    from touchcell.perception.runtime.network_estimator import NetworkEstimator

    estimator = section.estimator
    if isinstance(estimator, NetworkEstimator):
        return _network_facts(estimator, arm, section.T_tcp_sensor, float(rate_hz))
    kind = estimator.kind.replace("_", " ")
    if estimator.kind not in _ABILITIES:
        # What an estimator of another package reports is not known: all of it, until it says less.
        return _unknown(kind, arm, section.T_tcp_sensor, float(rate_hz))
    images = _ABILITIES[estimator.kind]
    return SensorFacts(
        kind, arm, section.T_tcp_sensor, _TIP_M, _TIP_M, math.pi, frame_rate_hz=float(rate_hz), images=images
    )


def _network_facts(estimator: NetworkEstimator, arm: str | None, T_tcp_sensor: Array, rate_hz: float) -> SensorFacts:
    from touchcell.perception.errors import ModelError
    from touchcell.perception.models.model_file import load_header
    from touchcell.perception.runtime.network_estimator import model_path

    try:
        header = load_header(model_path(estimator.model))
    except ModelError:
        # Without its model the cell cannot be composed; until then its ranges are not known.
        return _unknown(f"network {estimator.model}", arm, T_tcp_sensor, rate_hz)
    labels = header.labels
    # Largest values along one component alone, at the corners of what was taught.
    if labels.are_contacts:
        x, y, _, _, _, turn = (max(abs(low), abs(high)) for low, high in zip(labels.low, labels.high, strict=True))
        depth_m, shear_m, torsion_rad = 1e-3 * labels.high[2], 1e-3 * math.hypot(x, y), math.radians(turn)
        unit_m = 1e-3
    else:
        x, y, _, _, _, torsion_rad = (
            max(abs(low), abs(high)) for low, high in zip(labels.low, labels.high, strict=True)
        )
        pressed = se3.inverse(se3.exp(np.array([0.0, 0.0, labels.low[2], 0.0, 0.0, 0.0])))
        depth_m, shear_m = float(pressed[2, 3]), math.hypot(x, y)
        unit_m = 1.0
    sigma_m = unit_m * float(header.calibrated(np.full(6, header.architecture.widest_sigma))[2] * labels.sigma_unit[2])
    drift_mm = getattr(estimator.filter, "drift_mm_per_sqrt_s", 0.0)
    sigma_m = max(sigma_m, 1e-3 * drift_mm * math.sqrt(_DRIFTS_S))
    return SensorFacts(
        f"network {estimator.model}",
        arm,
        T_tcp_sensor,
        depth_m,
        shear_m,
        torsion_rad,
        sigma_m,
        rate_hz,
        leaves_range=True,
        innovations=estimator.filter is not None,
        images=True,
        markers=header.architecture.reports_markers,
        least_sigma_m=_least_sigma_m(header),
    )


def _least_sigma_m(header: Header) -> float:
    """Return the smallest standard deviation of the depth that a calibrated network reports; 0 if it is not known.

    It cannot be surer than a share of the error that it had on its own validation images.
    """
    errors = header.training.get("validation_mae")
    if not isinstance(errors, list) or len(errors) != len(header.labels.names):
        return 0.0
    return 1e-3 * _SUREST * float(errors[header.labels.names.index(_DEPTH_LABEL[header.labels.are_contacts])])


def _unknown(name: str, arm: str | None, T_tcp_sensor: Array, rate_hz: float) -> SensorFacts:
    """Return the facts of an estimator that may report whatever a tip can meet."""
    return SensorFacts(name, arm, T_tcp_sensor, _TIP_M, _TIP_M, math.pi, _TIP_M, rate_hz, True, True, True, True)


def proof_table(plan: CellPlan) -> list[str]:
    """Return the lines of a table of what trips each interlock, one for each interlock, subject and limit."""
    if not plan.proofs:
        return []
    rows: list[tuple[str, ...]] = [_COLUMNS]
    rows += [_row(plan, proof) for proof in _worst(plan.proofs)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _worst(proofs: Sequence[Proof]) -> list[Proof]:
    """Return one proof of each interlock, subject and limit: the one that failed, or took the longest."""
    found: dict[tuple[str, str, str], Proof] = {}
    for proof in proofs:
        key = (proof.interlock, proof.subject, proof.limit)
        before = found.get(key)
        if before is None or _badness(proof) > _badness(before):
            found[key] = proof
    return list(found.values())


def _badness(proof: Proof) -> float:
    return math.inf if proof.tripped_s is None else proof.tripped_s


def _row(plan: CellPlan, proof: Proof) -> tuple[str, ...]:
    first = (proof.interlock, proof.kind, proof.subject or "-", proof.limit or "-")
    if proof.tripped_s is None:
        return (*first, f"{'CANNOT' if proof.fatal else 'not'}: {proof.problem}", "", "", "")
    distance = plan.stopping_distances.get(proof.interlock)
    entry = plan.cell.interlocks[proof.interlock]
    margin_mm = getattr(entry, "margin_mm", None)
    if margin_mm is None and distance is not None:
        margin_mm = getattr(entry, "limit_mm", None)
    after = f"{1e3 * proof.tripped_s:.0f} ms"
    if distance is None:
        return (*first, proof.fault, after, "-", "-")
    left = "-" if margin_mm is None else f"{margin_mm - 1e3 * distance.total_m:.1f} mm"
    return (*first, proof.fault, after, f"{1e3 * distance.total_m:.1f} mm", left)
