"""Rules that would trip on what the task surely does, shown a run in which nothing is wrong."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from touchcell.cell.config.armed import NotArmed
from touchcell.cell.config.demands import demands
from touchcell.cell.config.starts import start_of_sensor
from touchcell.control.interlocks.basic import DepthConfig, TcpSpeedConfig
from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.interlocks.coverage import CellFacts, SensorFacts, with_arm, with_sensor
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.tactile import InconsistentConfig, ShearConfig, SlipConfig, UncertainConfig
from touchcell.control.interlocks.violation import Violation
from touchcell.control.latch import unlogged_latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected
from touchcell.drivers.core.gate import TwistGate, TwistLimits
from touchcell.drivers.core.lease import LeaseManager
from touchcell.drivers.core.scene import scene_section
from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.runtime.filter_spec import FilterConfig
from touchcell.tasks.planned_motions import PlannedContact, PlannedMotion, PlannedSlide, PlannedStart, PlannedTurn
from touchcell.tasks.servoing import CHECKING

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan

_START_NS: Final = 10**12
_LIFETIME: Final = 3.0
"""Cycles that a command of a task lives."""
_LONGEST_S: Final = 10.0
_FELT_SHARE: Final = 0.7
"""Part of a shear that an estimate shows in any case."""
_LEAST_NIS: Final = 1.64
"""Quantile 0.05 of the chi-squared distribution with six degrees of freedom."""
_DEPTH_M: Final = 2e-3
_TURN_SIGMA_RAD: Final = 0.01


def trips_in_motion(plan: CellPlan, facts: CellFacts) -> Iterator[NotArmed]:
    """Return every interlock that would trip on a motion or a contact that the task surely makes.

    Args:
        plan: a checked cell file.
        facts: of the cell.
    """
    if plan.task.motions is None:
        return
    motions = tuple(dict.fromkeys(plan.task.motions(plan.task_config, *start_of_sensor(plan))))
    poses = {role: sensor.T_tcp_sensor for role, sensor in facts.sensors.items()}
    for name, entry in plan.cell.interlocks.items():
        if isinstance(entry, TcpSpeedConfig):
            yield from _turns(facts, motions, name, entry)
        if isinstance(entry, DepthConfig):
            yield from _depths(plan, facts, name, entry)
        if entry.kind == "limited":
            shown = _starts(plan, facts, motions)
        elif isinstance(entry, UncertainConfig):
            shown = _uncertain(plan, facts, motions, entry)
        elif isinstance(entry, InconsistentConfig):
            shown = _inconsistent(facts, motions, entry)
        elif isinstance(entry, ShearConfig | SlipConfig):
            shown = _sheared(plan, facts, motions, entry)
        else:
            continue
        (interlock,) = build_interlocks({name: entry}, poses, facts.scene)
        for views, what, key, hint in shown:
            if (cause := _tripped(interlock, views)) is not None:
                at = ("interlocks", name, key)
                yield NotArmed(at, f"would trip although nothing is wrong: {cause.reason}, {what}", hint)
                break


def _turns(facts: CellFacts, motions: Iterable[PlannedMotion], name: str, entry: TcpSpeedConfig) -> Iterator[NotArmed]:
    """Hold turns against the limit of a rotational speed."""
    for motion in motions:
        if not isinstance(motion, PlannedTurn) or motion.rate_rad_s <= entry.limit_rad_s:
            continue
        if motion.state != CHECKING or any(sensor.leaves_range for sensor in facts.sensors.values()):
            reason = (
                f"would trip although nothing is wrong: task.{_dotted(motion)} turns at {motion.rate_rad_s:.3g} rad/s"
            )
            yield NotArmed(("interlocks", name, "limit_rad_s"), reason, "raise it, or turn less")
            return


def _depths(plan: CellPlan, facts: CellFacts, name: str, entry: DepthConfig) -> Iterator[NotArmed]:
    """Hold depths against the limit as they are estimated: with the least noise that the network has."""
    sigma_mm = 1e3 * max((sensor.least_sigma_m for sensor in facts.sensors.values()), default=0.0)
    for key, depth_mm in demands(plan.task_config, "depth"):
        if sigma_mm and depth_mm + sigma_mm >= entry.limit_mm:
            reason = f"{depth_mm:g} mm, known to {sigma_mm:.2g} mm at best, would trip interlocks.{name}"
            yield NotArmed(("task", *map(str, key)), reason, f"stay well below its limit of {entry.limit_mm:g} mm")


_Shown = Iterator[tuple[Iterable[CellView], str, str, str]]
"""Views of a healthy run, words for what it does, the key that decides, and the remedy."""


def _tripped(interlock: Any, views: Iterable[CellView]) -> Violation | None:
    """Return the first cause for which an interlock stops a run that looks like ``views``."""
    latch = unlogged_latch()
    supervisor = Supervisor([interlock], latch)
    for view in views:
        supervisor.review(view)
        if latch.first_cause is not None:
            return latch.first_cause
    return None


def _starts(plan: CellPlan, facts: CellFacts, motions: Iterable[PlannedMotion]) -> _Shown:
    """Show the first commands of motions from rest, as the gate of each arm passes them."""
    for role, arm in facts.arms.items():
        if not arm.moved or arm.limits is None:
            continue
        for start in motions:
            if isinstance(start, PlannedStart):
                yield (
                    _accelerated(facts, role, arm.limits, start),
                    f"as the arm accelerates to the {1e3 * start.speed_m_s:g} mm/s of task.{_dotted(start)}",
                    "limit_ms",
                    f"raise it, or the acceleration and jerk in arms.{_name(plan, role)}.limits",
                )


def _accelerated(facts: CellFacts, role: str, limits: TwistLimits, start: PlannedStart) -> Iterator[CellView]:
    """Return the views of an arm that starts, until its gate limits it no more or the way is over."""
    clock, desk = VirtualClock(_START_NS), LeaseManager(role)
    gate, lease = TwistGate(role, limits, desk, clock), desk.acquire("check")
    twist = np.array([min(start.speed_m_s, limits.speed_m_s), 0.0, 0.0, 0.0, 0.0, 0.0])
    state = facts.states[0] if facts.states else ""
    gone_m = t_s = 0.0
    while gone_m < start.distance_m and t_s < _LONGEST_S:
        now_ns = clock.now_ns()
        command = TwistCommand(twist, TwistFrame.BASE, now_ns, min(_LIFETIME * facts.period_s, 1.0))
        try:
            sent = gate.admit(command, lease, Lifecycle.ACTIVE, np.eye(4))
        except CommandRejected:
            # What no gate passes is refused elsewhere.
            return
        clock.advance_s(facts.period_s)
        yield with_arm(facts.healthy(clock.now_ns(), state), role, sent=sent)
        if not sent.limited:
            return
        gone_m += float(sent.command.twist[0]) * facts.period_s
        t_s += facts.period_s


def _uncertain(plan: CellPlan, facts: CellFacts, motions: Iterable[PlannedMotion], entry: UncertainConfig) -> _Shown:
    """Show each contact at the least deviation that the estimator reports."""
    longest = max((each for each in motions if isinstance(each, PlannedContact)), key=_duration, default=None)
    for role, sensor in facts.sensors.items():
        if longest is None or 1e3 * sensor.least_sigma_m <= entry.limit_mm:
            continue
        filter_config = getattr(plan.cell.sensors[plan.sensor_roles[role]].estimator, "filter", None)
        lasts_s = min(longest.lasts_s, 1e-3 * entry.hold_ms + 2.0 / sensor.frame_rate_hz)
        try:
            sigmas_m = _reported(sensor, filter_config, lasts_s)
        except (GeometryError, ValueError, NotImplementedError):
            # A filter of another package that does not take these observations says nothing about them.
            continue
        yield (
            (
                with_sensor(_in_contact(facts, role, t_s, longest.state), role, sigma_depth_m=sigmas_m[frame])
                for t_s in _times(lasts_s, facts.period_s)
                if (frame := int(t_s * sensor.frame_rate_hz)) < len(sigmas_m)
            ),
            f"the least that {sensor.estimator} reports",
            "limit_mm",
            f"raise it to a few times {1e3 * sensor.least_sigma_m:.2g} mm",
        )


def _inconsistent(facts: CellFacts, motions: Iterable[PlannedMotion], entry: InconsistentConfig) -> _Shown:
    """Show a contact the innovations that nearly every frame of a consistent filter exceeds."""
    contact = next((each for each in motions if isinstance(each, PlannedContact)), None)
    for role, sensor in facts.sensors.items():
        if contact is None or not sensor.innovations:
            continue
        shown_s = (entry.frames + 1) / sensor.frame_rate_hz
        yield (
            (
                with_sensor(_in_contact(facts, role, t_s, contact.state), role, nis=_LEAST_NIS)
                for t_s in _times(shown_s, facts.period_s)
            ),
            f"and a consistent filter exceeds {_LEAST_NIS:g} in 19 of 20 frames",
            "limit_nis",
            "e.g. 22.5, which it exceeds in one of a thousand",
        )


def _reported(sensor: SensorFacts, filter_config: FilterConfig | None, lasts_s: float) -> list[float]:
    """Return the standard deviations of the depth, m, that are reported frame by frame of a contact at rest."""
    frames = 1 + math.ceil(lasts_s * sensor.frame_rate_hz)
    if filter_config is None:
        return [sensor.least_sigma_m] * frames
    contact_filter = filter_config.build()
    T_s_f = se3.exp(np.array([0.0, 0.0, -_DEPTH_M, 0.0, 0.0, 0.0]))
    seen = PoseGaussian(T_s_f, np.diag([sensor.least_sigma_m**2] * 3 + [_TURN_SIGMA_RAD**2] * 3))
    period_ns = round(1e9 / sensor.frame_rate_hz)
    states = [contact_filter.update(seen, np.eye(4), _START_NS + k * period_ns) for k in range(frames)]
    return [math.sqrt(state.belief.covariance[2, 2]) for state in states]


def _sheared(
    plan: CellPlan, facts: CellFacts, motions: Iterable[PlannedMotion], entry: ShearConfig | SlipConfig
) -> _Shown:
    """Show each contact that the task shears, sheared by most of that."""
    slip = isinstance(entry, SlipConfig)
    scene = None if plan.cell.scene is None else scene_section().model_validate(plan.cell.scene)
    for motion in motions:
        if isinstance(motion, PlannedContact) and not slip:
            shear_m, depth_m, lasts_s = motion.shear_m, None, motion.lasts_s
            what = f"as task.{_dotted(motion)} shears the contact"
        elif isinstance(motion, PlannedSlide) and scene is not None:
            most_m = scene.most_shear_m(motion.depth_m)
            if most_m is None or motion.distance_m <= most_m:
                continue
            shear_m, depth_m = most_m, motion.depth_m
            lasts_s = (motion.distance_m - most_m) / motion.speed_m_s
            what = f"as the tip slides at {1e3 * depth_m:g} mm of depth over the way of task.{_dotted(motion)}"
        else:
            continue
        shear_m *= _FELT_SHARE
        if shear_m <= 0.0:
            continue
        for role, sensor in facts.sensors.items():
            if motion.state == CHECKING and not sensor.leaves_range:
                continue
            shown_s = min(lasts_s, 1e-3 * entry.hold_ms + 2.0 * facts.period_s, _LONGEST_S)
            yield (
                (
                    with_sensor(_in_contact(facts, role, t_s, motion.state), role, shear_m=shear_m, depth_m=depth_m)
                    for t_s in _times(shown_s, facts.period_s)
                ),
                what,
                "limit_ratio" if slip else "limit_mm",
                "raise it" if slip else f"raise it well above {1e3 * shear_m / _FELT_SHARE:.2g} mm",
            )


def _in_contact(facts: CellFacts, role: str, t_s: float, state: str) -> CellView:
    view = facts.healthy(_START_NS + round(1e9 * t_s), state)
    return with_sensor(view, role, in_contact=True)


def _times(lasts_s: float, period_s: float) -> list[float]:
    """Return the times of the control cycles of a duration."""
    return [k * period_s for k in range(1 + math.floor(min(lasts_s, _LONGEST_S) / period_s + 1e-9))]


def _duration(contact: PlannedContact) -> float:
    return contact.lasts_s


def _dotted(motion: PlannedStart | PlannedTurn | PlannedContact | PlannedSlide) -> str:
    return ".".join(map(str, motion.key))


def _name(plan: CellPlan, role: str) -> str:
    return plan.arm_roles.get(role, role)
