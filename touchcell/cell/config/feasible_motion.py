"""Motions and contacts of a valid cell file with which every run would trip, or end as failed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from touchcell.cell.config.demands import demands
from touchcell.cell.config.rule_limits import is_kind, limits_of
from touchcell.cell.config.starts import lean_rad, pose_of, sensor_in_world, start_of_sensor
from touchcell.cell.config.yaml_file import KeyPath, YamlFile
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.scene import scene_section
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.perception.runtime.contact_gate import CHANGE_PERCENT_PER_MM
from touchcell.tasks.planned_motions import (
    Impossible,
    PlannedHold,
    PlannedMotion,
    PlannedRide,
    PlannedRim,
    PlannedSlide,
    PlannedStart,
    PlannedTime,
    PlannedTouch,
)

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan
    from touchcell.drivers.core.scene import SceneSection

# Numbers that are equal but for rounding are no contradiction.
_SLACK: Final = 1.0 + 1e-9
_EXACTNESS_MM: Final = 1e-3
_REACH_SLACK_M: Final = 5e-3
_RIDE_SLACK_M: Final = 0.025
_LEAST_TOUCH_PERCENT: Final = 0.1
"""A quarter of a grey level."""
_LIGHTEST: Final = 0.5
"""Part of the depth at which a contact ends as its image says that surely is none."""
_LEAN_SLACK_DEG: Final = 3.0
_MOST_TILT_RAD: Final = math.radians(35.0)
"""Against the face beside an edge; networks are trained to 32 deg."""
_WAY_SLACK_MM: Final = 5.0
"""By which a way over a surface may be elsewhere: the sensor turns with the surface a little late."""


Ways = Mapping[KeyPath, Array]
"""Ways (n, 3), m, of the sensor over surfaces of the scene, in the base frame of its arm, by the task's key."""


def foreseen_trips(file: YamlFile, plan: CellPlan, ways: Ways) -> Iterator[ConfigError]:
    """Return one problem for every parameter of a task with which each run would trip; else nothing is wrong."""
    for problems in (_ages, _gates, _too_light, _gains, _pressing, _lifted_out):
        yield from problems(file, plan)
    yield from _ways_out(file, plan, ways)
    yield from _untouched(file, plan)


def failing_motions(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Return one problem for every parameter with which each run ends as failed, in an orderly way.

    Such a cell may be meant, as in a test of that very end, and is not refused.
    """
    for problems in (_impossible, _times, _unmet, _left_behind, _along_edge, _over_border):
        yield from problems(file, plan)


def places_outside(file: YamlFile, plan: CellPlan, ways: Ways) -> Iterator[ConfigError]:
    """Return one problem for every place to which the task surely takes an arm, outside a box that it must not leave.

    A way over a known surface is known better than by the plane of the first contact, and left to ``foreseen_trips``.
    """
    if not plan.sensor_roles:
        return
    start, mount = start_of_sensor(plan)
    reported: set[KeyPath] = set()
    for place in () if plan.task.places is None else plan.task.places(plan.task_config, start, mount):
        for rule, box in _boxes(plan).items():
            if place.key in reported or place.key in ways or box.arm != place.arm:
                continue
            carried = plan.sensor_roles.get(box.sensor or "")
            mount = np.eye(4) if carried is None else plan.cell.sensors[carried].T_tcp_sensor
            point_mm, slack_mm = 1e3 * place.point_m(mount), 1e3 * place.slack_m + _EXACTNESS_MM
            if outside := _outside(point_mm, box, slack_mm):
                reported.add(place.key)
                yield file.problem(
                    ("task", *place.key),
                    f"leads out of interlocks.{rule}, which would trip: {outside}",
                    hint="go less far, or make the workspace larger",
                )


def _boxes(plan: CellPlan) -> dict[str, Any]:
    return {rule: box for rule, box in plan.cell.interlocks.items() if is_kind(box, "workspace")}


def _cones(plan: CellPlan) -> dict[str, Any]:
    """Return the cones that guard the axis of a sensor."""
    rules: dict[str, Any] = dict(plan.cell.interlocks)
    return {rule: cone for rule, cone in rules.items() if is_kind(cone, "tilt") and cone.sensor in plan.sensor_roles}


def _ways_out(file: YamlFile, plan: CellPlan, ways: Ways) -> Iterator[ConfigError]:
    """Ways over surfaces of the scene, out of a box that the arm must not leave."""
    boxes = _boxes(plan)
    reported: set[KeyPath] = set()
    for key, way_m in ways.items():
        for rule, box in boxes.items():
            beyond = np.maximum(np.array(box.min_mm) - 1e3 * way_m, 1e3 * way_m - np.array(box.max_mm))
            left = np.flatnonzero((beyond > _WAY_SLACK_MM).any(axis=1))
            if left.size and box.sensor in plan.sensor_roles and not reported:
                reported.add(key)
                at_mm = 1e3 * way_m[left[0]]
                yield file.problem(
                    ("task", *key),
                    f"leads out of interlocks.{rule} over the surface, which would trip: "
                    f"{_outside(at_mm, box, _WAY_SLACK_MM)}",
                    hint="go less far, or make the workspace larger",
                )


def _outside(point_mm: Array, box: Any, slack_mm: float) -> str:
    """Return along which axes a point is outside a box by more than a slack; empty if it is not."""
    return "; ".join(
        f"{axis} = {value:.4g} mm, limit {low if value < low else high:g} mm"
        for axis, value, low, high in zip("xyz", point_mm, box.min_mm, box.max_mm, strict=True)
        if value < low - slack_mm or value > high + slack_mm
    )


def ways_over(plan: CellPlan) -> Ways:
    """Return the ways over surfaces that are known from the start."""
    return dict(_ways(plan)) if plan.sensor_roles else {}


def _ways(plan: CellPlan) -> Iterator[tuple[KeyPath, Array]]:
    first = _first_approach(plan)
    if first is None:
        return
    scene, tip, reach_m = first.scene, first.T_world_sensor, first.reach_m
    retract_m = 1e-3 * float(getattr(plan.task_config, "retract_mm", 0.0))
    for motion in _motions(plan):
        if isinstance(motion, PlannedSlide) and motion.known and motion.corners_m:
            over = scene.points_over(tip, np.array(motion.corners_m), motion.depth_m, reach_m)
            if over is not None:
                yield motion.key, first.in_base(over[:, 0])
        elif isinstance(motion, PlannedSlide) and motion.known:
            way = scene.way_over(tip, motion.direction_rad, motion.distance_m, motion.depth_m, reach_m, retract_m)
            if way is not None:
                inner = first.in_base(way)
                yield motion.key, inner[:-1]
                yield ("retract_mm",), inner[-1:]
        elif isinstance(motion, PlannedRide):
            way = scene.ride(tip, reach_m, motion.lasts_s)
            if way is not None:
                # The contact is made a little later, when the surface has moved on.
                inner = first.in_base(way)
                yield motion.key, inner + (inner[0] - inner) * min(1.0, _RIDE_SLACK_M / _extent(inner))


@dataclass(frozen=True, slots=True)
class _Approach:
    """How a sensor comes upon the scene.

    Attributes:
        arm: name of the arm that carries it.
        sensor: its name.
        scene: what it comes upon.
        T_world_base: (4, 4) where its arm stands.
        T_world_sensor: (4, 4) its own start.
        reach_m: how far it searches along its axis.
    """

    arm: str
    sensor: str
    scene: SceneSection
    T_world_base: Array
    T_world_sensor: Array
    reach_m: float

    def in_base(self, way_m: Array) -> Array:
        """Return points (n, 3) of the world in the base frame of the arm."""
        inner: Array = (way_m - self.T_world_base[:3, 3]) @ self.T_world_base[:3, :3]
        return inner


def _first_approach(plan: CellPlan) -> _Approach | None:
    """Return how the task's first sensor comes upon the scene; None where that is not known from the start."""
    reach_mm = getattr(plan.task_config, "approach_distance_mm", None)
    if plan.cell.scene is None or not plan.sensor_roles or reach_mm is None:
        return None
    sensor = _first_sensor(plan)
    arm, tip = plan.cell.sensors[sensor].mounted_on, sensor_in_world(plan, sensor)
    if arm is None or tip is None:
        return None
    scene = scene_section().model_validate(plan.cell.scene)
    return _Approach(arm, sensor, scene, plan.cell.arms[arm].T_world_base, tip, 1e-3 * reach_mm)


def _first_sensor(plan: CellPlan) -> str:
    return plan.sensor_roles[min(plan.sensor_roles)]


def _motions(plan: CellPlan) -> Iterable[PlannedMotion]:
    """Return what the task tells of its motions."""
    return () if plan.task.motions is None else plan.task.motions(plan.task_config, *start_of_sensor(plan))


def _lifted_out(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Gaps between tip and a known surface at which the sensor is outside a box that it must not leave."""
    clearance_mm = getattr(plan.task_config, "clearance_mm", None)
    aside_mm = float(getattr(plan.task_config, "shear_mm", 0.0))
    if clearance_mm is None:
        return
    for role, name in plan.sensor_roles.items():
        surface = pose_of(getattr(plan.cell.sensors[name].estimator, "surface_mm_deg", None))
        if surface is None:
            continue
        for rule, box in _boxes(plan).items():
            lifted_mm = 1e3 * surface[:3, 3] - clearance_mm * surface[:3, 2]
            if box.sensor == role and (outside := _outside(lifted_mm, box, aside_mm + _EXACTNESS_MM)):
                yield file.problem(
                    ("task", "clearance_mm"),
                    f"that far from the known surface {name!r} leaves interlocks.{rule}, which would trip: {outside}",
                    value=clearance_mm,
                    hint="leave less, or make the workspace larger",
                )
                return


def _left_behind(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Motions of what a contact goes along with that its arm cannot keep up with."""
    rides = [motion for motion in _motions(plan) if isinstance(motion, PlannedRide)]
    first = _first_approach(plan) if rides else None
    limits = None if first is None else getattr(plan.arms[first.arm].config, "limits", None)
    if first is None or not isinstance(limits, LimitsConfig):
        return
    for motion in rides:
        way_m = first.scene.ride(first.T_world_sensor, first.reach_m, motion.lasts_s)
        if way_m is None:
            continue
        step_m = limits.tcp_speed_m_s * motion.lasts_s / max(len(way_m) - 1, 1)
        behind_m, farthest_m, at = 0.0, 0.0, way_m[0]
        for ahead in way_m[1:]:
            behind_m = float(np.linalg.norm(ahead - at))
            at = ahead if behind_m <= step_m else at + (ahead - at) * step_m / behind_m
            farthest_m = max(farthest_m, behind_m - step_m)
        if farthest_m > _RIDE_SLACK_M:
            yield file.problem(
                ("arms", first.arm, "limits", "tcp_speed_m_s"),
                f"{1e3 * limits.tcp_speed_m_s:g} mm/s is less than what {first.sensor!r} is carried along with: "
                f"it falls {1e3 * farthest_m:.0f} mm behind",
                value=limits.tcp_speed_m_s,
                hint="raise it, with interlocks.tcp_speed and the margins, or let the object move more slowly",
            )


def _along_edge(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Edges of the scene that lead out of a box that the arm must not leave, or that do not lead back in time."""
    rims = [motion for motion in _motions(plan) if isinstance(motion, PlannedRim)]
    first = _first_approach(plan) if rims else None
    if first is None:
        return
    for motion in rims:
        frames = first.scene.way_along_edge(
            first.T_world_sensor, motion.distance_m, first.reach_m, backward=motion.backward
        )
        if frames is None:
            continue
        way_m = frames[:, :3, 3]
        steps_m = np.linalg.norm(np.diff(way_m, axis=0), axis=1)
        for rule, box in _boxes(plan).items():
            if box.sensor not in plan.sensor_roles:
                continue
            inner_mm = 1e3 * first.in_base(way_m)
            out = [i for i, at_mm in enumerate(inner_mm) if _outside(at_mm, box, _WAY_SLACK_MM)]
            if out:
                yield file.problem(
                    ("task", *motion.key),
                    f"after {1e3 * steps_m[: out[0]].sum():.0f} mm the edge leads out of interlocks.{rule}, which "
                    f"would trip: {_outside(inner_mm[out[0]], box, _WAY_SLACK_MM)}",
                    hint="go less far, or make the workspace larger",
                )
                return
        if motion.closes and np.linalg.norm(way_m[-1] - way_m[0]) > _REACH_SLACK_M:
            yield file.problem(
                ("task", *motion.key),
                f"{1e3 * motion.distance_m:g} mm along the edge do not lead back to where it begins",
                value=1e3 * motion.distance_m,
                hint="allow more, or leave out `close_loop`",
            )
        if not motion.tilts and _has_model(plan):
            cos = np.clip(frames[:, :3, 2] @ first.T_world_sensor[:3, 2], -1.0, 1.0)
            leaning = np.flatnonzero(cos < math.cos(_MOST_TILT_RAD))
            if leaning.size:
                i = int(leaning[0])
                yield file.problem(
                    ("task", "dimensions"),
                    f"after {1e3 * steps_m[:i].sum():.0f} mm along the edge its face leans by more than "
                    f"{math.degrees(_MOST_TILT_RAD):.0f} deg against the tip, which stays as it starts: up to "
                    f"{math.degrees(math.acos(float(cos.min()))):.0f} deg; no edge is read at that",
                    hint="start with the tip upright over the part, or let it tilt: `dimensions: 5`",
                )


def _over_border(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Paths over a surface that lead off it, or to where it is steeper than a cone lets the sensor be."""
    slides = [motion for motion in _motions(plan) if isinstance(motion, PlannedSlide) and motion.known]
    first = _first_approach(plan) if slides else None
    if first is None:
        return
    cones = _cones(plan)
    R = first.T_world_base[:3, :3]
    for motion in slides:
        corners_m, way_m = (np.array(each).reshape(-1, 2) for each in (motion.corners_m, motion.way_m))
        # An edge is no place to end, but may be crossed where it does not lean the tip too far.
        over = [
            first.scene.points_over(first.T_world_sensor, at_m, motion.depth_m, first.reach_m, of_edges=of_edges)
            for at_m, of_edges in ((corners_m, False), (way_m, True))
        ]
        places_mm = 1e3 * np.concatenate([corners_m, way_m])
        met = () if over[0] is None or over[1] is None else np.concatenate([over[0], over[1]])
        for (x, y), (_, normal) in zip(places_mm, met, strict=False):
            if np.isnan(normal).any():
                yield file.problem(
                    ("task", *motion.key),
                    f"leads off what it touches: below ({x:.0f}, {y:.0f}) mm of it is nothing, or only an edge",
                    hint="go less far, or start farther inside",
                )
                return
            for rule, cone in cones.items():
                lean_deg = math.degrees(lean_rad(-normal @ R, cone.direction))
                if lean_deg > cone.limit_deg + _LEAN_SLACK_DEG:
                    yield file.problem(
                        ("task", *motion.key),
                        f"leads to where the surface leans by {lean_deg:.0f} deg, at ({x:.0f}, {y:.0f}) mm of it; "
                        f"interlocks.{rule} would trip at {cone.limit_deg:g} deg",
                        hint="go less far, start elsewhere, or allow more tilt",
                    )
                    return


def _extent(way_m: Array) -> float:
    """Return how far a way (n, 3) gets from its start, or a micrometre."""
    return max(float(np.linalg.norm(way_m - way_m[0], axis=1).max()), 1e-6)


def _impossible(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    for motion in _motions(plan):
        if isinstance(motion, Impossible):
            yield file.problem(("task", *motion.key), motion.why, hint=motion.hint)


def _times(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Times that are shorter than what they are for."""
    reported: set[KeyPath] = set()
    for motion in _motions(plan):
        if (
            isinstance(motion, PlannedTime)
            and not (motion.by_model and not _has_model(plan))
            and motion.takes_s > motion.allowed_s * _SLACK
            and motion.key not in reported
        ):
            reported.add(motion.key)
            takes = f"takes {motion.takes_s:.3g} s at least" if math.isfinite(motion.takes_s) else "never ends"
            yield file.problem(
                ("task", *motion.key),
                f"{motion.allowed_s:g} s, but it {takes} {motion.what}",
                value=motion.allowed_s,
                hint="allow more time, go faster, or go less far",
            )


def _has_model(plan: CellPlan) -> bool:
    """Return whether a model estimates the contacts of any sensor."""
    return any(hasattr(plan.cell.sensors[name].estimator, "model") for name in plan.sensor_roles.values())


def _ages(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Frames that are older when they come than the task takes."""
    most_ms = getattr(plan.task_config, "max_frame_age_ms", None)
    if most_ms is None:
        return
    for device in plan.sensors.values():
        latency_ms = float(getattr(device.config, "latency_ms", 0.0))
        if most_ms < latency_ms:
            yield file.problem(
                ("task", "max_frame_age_ms"),
                f"frames of {device.name!r} come after {latency_ms:g} ms",
                value=most_ms,
                hint="allow frames of some cycles more",
            )
            return


def _gates(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Gates that see no contact before the depth at which an interlock has to see one."""
    limits = limits_of(plan, "depth", "limit_mm")
    for name in plan.sensor_roles.values() if limits else ():
        rule, limit_mm = min(limits.items(), key=lambda each: each[1])
        touch_percent = getattr(getattr(plan.cell.sensors[name].estimator, "gate", None), "touch_percent", 0.0)
        if touch_percent >= CHANGE_PERCENT_PER_MM * limit_mm:
            yield file.problem(
                ("sensors", name, "estimator", "gate", "touch_percent"),
                f"a contact begins at about {touch_percent / CHANGE_PERCENT_PER_MM:.2g} mm of depth, "
                f"which is not below the limit of interlocks.{rule}, {limit_mm:g} mm",
                value=touch_percent,
                hint="e.g. 4",
            )


def _too_light(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Depths that are to be held although the gate calls them no contact; and gates that any noise opens."""
    for name in plan.sensor_roles.values():
        gate = getattr(plan.cell.sensors[name].estimator, "gate", None)
        touch_percent, release_percent = (getattr(gate, f"{each}_percent", None) for each in ("touch", "release"))
        if touch_percent is None or release_percent is None:
            continue
        if touch_percent < _LEAST_TOUCH_PERCENT:
            yield file.problem(
                ("sensors", name, "estimator", "gate", "touch_percent"),
                "less than a quarter of a grey level: noise alone would be a contact",
                value=touch_percent,
                hint="e.g. 4",
            )
        least_mm = _LIGHTEST * release_percent / CHANGE_PERCENT_PER_MM
        for key, depth_mm in demands(plan.task_config, "depth"):
            if key[-1] == "depth_mm" and "until" not in key and depth_mm < least_mm:
                yield file.problem(
                    ("task", *key),
                    f"{depth_mm:g} mm is no contact to the gate of {name!r}, which ends it at about "
                    f"{release_percent / CHANGE_PERCENT_PER_MM:.2g} mm",
                    value=depth_mm,
                    hint="press deeper",
                )


def _gains(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Gains with which a correction overshoots by more than the error, from one control cycle to the next."""
    for at, config in (((), plan.task_config), (("follower",), getattr(plan.task_config, "follower", None))):
        gains = getattr(config, "kp_per_s", None)
        if gains is not None and max(gains) >= 2.0 * plan.cell.rate_hz:
            yield file.problem(
                ("task", *at, "kp_per_s"),
                f"{max(gains):g} per s overshoots by more than the error in a cycle of {1e3 / plan.cell.rate_hz:g} ms",
                value=gains,
                hint=f"well below {plan.cell.rate_hz:g} per s",
            )


def _pressing(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Speeds towards a first touch from which no arm of the task stops before the depth limit."""
    limits = limits_of(plan, "depth", "limit_mm")
    if not limits:
        return
    rule, limit_mm = min(limits.items(), key=lambda each: each[1])
    arms = (getattr(device.config, "limits", None) for device in plan.arms.values())
    accel_m_s2 = max((each.tcp_accel_m_s2 for each in arms if isinstance(each, LimitsConfig)), default=math.inf)
    latencies_ms = [float(getattr(device.config, "latency_ms", 0.0)) for device in plan.sensors.values()]
    reported: set[KeyPath] = set()
    for motion in _motions(plan):
        if not isinstance(motion, PlannedStart) or not motion.presses or motion.key in reported:
            continue
        braking_m = motion.speed_m_s * (1e-3 * min(latencies_ms, default=0.0) + 0.5 * motion.speed_m_s / accel_m_s2)
        if 1e3 * braking_m >= limit_mm:
            reported.add(motion.key)
            yield file.problem(
                ("task", *motion.key),
                f"at {1e3 * motion.speed_m_s:g} mm/s the tip gets {1e3 * braking_m:.1f} mm deep before it stands, "
                f"not below the limit of interlocks.{rule}, {limit_mm:g} mm",
                value=1e3 * motion.speed_m_s,
                hint="go slower where something is to be touched",
            )


def _unmet(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Ways on which something has to be touched, and nothing is there."""
    if plan.cell.scene is None:
        return
    scene = scene_section().model_validate(plan.cell.scene)
    reach_mm = getattr(plan.task_config, "approach_distance_mm", None)
    if reach_mm is not None:
        for name in plan.sensor_roles.values():
            tip = sensor_in_world(plan, name)
            if tip is not None and not scene.meets(tip, (1e-3 * reach_mm + _REACH_SLACK_M) * tip[:3, 2]):
                yield file.problem(
                    ("task", "approach_distance_mm"),
                    f"the tip of {name!r} meets nothing within that distance along its axis from its start",
                    value=reach_mm,
                    hint="start nearer to the surface and turned towards it, or search farther",
                )
    if not plan.sensor_roles:
        return
    name = _first_sensor(plan)
    reported: set[KeyPath] = set()
    for motion in _motions(plan):
        if not isinstance(motion, PlannedTouch) or motion.key in reported:
            continue
        tip = sensor_in_world(plan, name, motion.T_base_tcp)
        arm = plan.cell.sensors[name].mounted_on
        base = None if arm is None else pose_of(plan.cell.arms[arm].base_pose_mm_deg)
        if tip is not None and base is not None and not scene.meets(tip, base[:3, :3] @ motion.way_m, motion.depth_m):
            reported.add(motion.key)
            wanted = f"{1e3 * motion.depth_m:g} mm deep" if motion.depth_m else "at all"
            yield file.problem(
                ("task", *motion.key),
                f"touches nothing {wanted} on this way, which the step waits for",
                hint="go farther, or the other way",
            )


def _untouched(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Steps that hold a contact before anything is touched."""
    if not plan.sensor_roles:
        return
    name = _first_sensor(plan)
    reported: set[KeyPath] = set()
    for motion in _motions(plan):
        if not isinstance(motion, PlannedHold) or motion.key in reported:
            continue
        after = motion.after
        tip = None if motion.T_base_tcp is None else sensor_in_world(plan, name, motion.T_base_tcp)
        if not after and plan.cell.scene is not None and tip is not None:
            scene = scene_section().model_validate(plan.cell.scene)
            after = "" if scene.touches(tip) else f"standing clear of the scene with {name!r}"
        if after:
            reported.add(motion.key)
            yield file.problem(
                ("task", *motion.key),
                f"holds a contact, and there is none after {after}: it would trip for lack of one",
                hint="touch first, e.g. {move: {by_mm_deg: [0, 0, 30], until: {contact: true}}}",
            )
