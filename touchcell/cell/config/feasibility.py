"""What a valid cell file would still be refused for by ``touchcell run``, or would surely trip or fail on."""

from __future__ import annotations

import importlib.util
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from touchcell.cell.config.demands import demands
from touchcell.cell.config.rule_limits import is_kind, limits_of
from touchcell.cell.config.starts import given_start, sensor_in_world, start_near
from touchcell.cell.config.yaml_file import YamlFile
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.scene import scene_section
from touchcell.errors import ConfigError, suggest
from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError
from touchcell.input_file import BUILTIN
from touchcell.perception.runtime.filter_spec import FILTERS, FilterConfig

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan

# Numbers that are equal but for rounding are no contradiction.
_SLACK: Final = 1.0 + 1e-9
_OF_EDGES: Final = ("sim_edge",)
"""Shipped networks of edges."""
_LONGEST_HEADER: Final = 100 << 20


def unfeasible(file: YamlFile, plan: CellPlan) -> list[ConfigError]:
    """Return one problem for everything that ``plan`` would be refused for, or would surely trip or fail on."""
    return [
        *_models(file, plan),
        *(scene := list(_scene(file, plan))),
        *_features(file, plan),
        *_interlock_sensors(file, plan),
        *_depths(file, plan),
        *_speeds(file, plan),
        *_distances(file, plan),
        *(starts := list(_starts(file, plan))),
        *(() if starts or scene else _contacts(file, plan)),
    ]


def _models(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Files of models that are no models. Their names and places are checked with all other input files."""
    for name in plan.sensors:
        model = getattr(plan.cell.sensors[name].estimator, "model", None)
        if isinstance(model, str) and not model.startswith(BUILTIN) and not _is_safetensors(Path(model)):
            at = ("sensors", name, "estimator", "model")
            hint = "a model file is what `touchcell train --data DIR --out NAME.safetensors` writes"
            yield file.problem(at, "is no model file", value=model, hint=hint)


def _is_safetensors(path: Path) -> bool:
    """Whether the file begins with a safetensors header: its length and a JSON object."""
    try:
        with path.open("rb") as stream:
            head = stream.read(9)
            size = path.stat().st_size
    except OSError:
        return False
    length = struct.unpack("<Q", head[:8])[0] if len(head) == 9 else 0
    return 2 <= length <= min(_LONGEST_HEADER, size - 8) and head[8:] == b"{"


def _scene(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    if plan.cell.scene is None:
        for device in {**plan.arms, **plan.sensors}.values():
            if device.spec.capabilities.needs_scene:
                kind = "arms" if device.name in plan.arms else "sensors"
                hint = "add `scene:`, e.g. {surfaces: {plane: {kind: plane}}}"
                yield file.problem((kind, device.name, "driver"), f"{device.spec.name} needs a scene", hint=hint)
        return
    section = scene_section().model_validate(plan.cell.scene)
    missing = False
    for module, (key, hint) in section.modules().items():
        if importlib.util.find_spec(module) is None:
            missing = True
            yield file.problem(("scene", *key.split(".")), f"needs {module}, which is not installed", hint=hint)
    if not missing:
        for problem in section.problems():
            at = ("scene", *problem.key.split("."))
            yield file.problem(at, problem.reason, value=problem.value, hint=problem.hint)


def _features(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    for name in plan.sensor_roles.values():
        estimator, wanted = plan.cell.sensors[name].estimator, plan.task.feature
        model = str(getattr(estimator, "model", ""))
        of = "edge" if model.removeprefix(BUILTIN) in _OF_EDGES else "surface"
        if model.startswith(BUILTIN) and of != estimator.feature:
            yield file.problem(
                ("sensors", name, "estimator", "model"),
                f"estimates the pose of {_a(of)}, and {estimator.kind} needs one that does of {_a(estimator.feature)}",
                value=model,
                hint=f"{BUILTIN}{_OF_EDGES[0]}" if estimator.feature == "edge" else f"{BUILTIN}sim_gdn",
            )
        if wanted is not None and estimator.feature != wanted:
            reason = f"{estimator.kind} estimates the pose of {_a(estimator.feature)}, and {plan.task.name} needs it of"
            yield file.problem(
                ("sensors", name, "estimator", "kind"),
                f"{reason} {_a(wanted)}",
                value=estimator.kind,
                hint="kind: true_edge in a simulated scene" if wanted == "edge" else "kind: network",
            )
        section = getattr(estimator, "filter", None)
        spec = FILTERS.load(section.model) if isinstance(section, FilterConfig) else None
        if spec is not None and spec.anchored and plan.task.glides:
            yield file.problem(
                ("sensors", name, "estimator", "filter", "model"),
                f"it counts a contact from where it was first touched, and {plan.task.name} glides on from there",
                value=spec.name,
                hint="model: stick_slip",
            )
        predicted = estimator.feature if spec is None else spec.feature
        if predicted != estimator.feature:
            yield file.problem(
                ("sensors", name, "estimator", "filter"),
                f"it predicts the motion of {_a(predicted)}, and {estimator.kind} estimates {_a(estimator.feature)}",
                value=section,
                hint="leave out `filter:`",
            )


def _a(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def _interlock_sensors(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    for name, entry in plan.cell.interlocks.items():
        role = getattr(entry, "sensor", None)
        if isinstance(role, str) and role not in plan.sensor_roles:
            known = sorted(plan.sensor_roles)
            hint = suggest(role, known, otherwise="its sensors are") if known else "leave out `sensor:`"
            at = ("interlocks", name, "sensor")
            yield file.problem(at, f"the task has no sensor {role!r}", value=role, hint=hint)


def _depths(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    limits = limits_of(plan, "depth", "limit_mm")
    if not limits:
        return
    rule, limit_mm = min(limits.items(), key=lambda each: each[1])
    for key, depth_mm in demands(plan.task_config, "depth"):
        if depth_mm >= limit_mm:
            yield file.problem(
                ("task", *key),
                f"{depth_mm:g} mm is not below the limit of interlocks.{rule}, {limit_mm:g} mm, which would trip",
                value=depth_mm,
                hint=f"press less deep, or raise interlocks.{rule}.limit_mm as far as the sensor allows",
            )


def _speeds(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Speeds that no arm of the task may have. (Which of several arms a speed is of, its task knows alone.)"""
    bounds = {
        f"arms.{device.name}.limits.tcp_speed_m_s": 1e3 * limits.tcp_speed_m_s
        for device in plan.arms.values()
        if isinstance(limits := getattr(device.config, "limits", None), LimitsConfig)
    }
    rules = {
        f"interlocks.{name}.limit_m_s": 1e3 * m_s for name, m_s in limits_of(plan, "tcp_speed", "limit_m_s").items()
    }
    for key, speed_mm_s in demands(plan.task_config, "speed"):
        for group, reason in ((bounds, "is more than any arm may move"), (rules, "would trip")):
            if not group:
                continue
            bound, limit_mm_s = max(group.items(), key=lambda each: each[1])
            if speed_mm_s > limit_mm_s * _SLACK:
                yield file.problem(
                    ("task", *key),
                    f"{speed_mm_s:g} mm/s {reason}: {bound} is {limit_mm_s:g} mm/s",
                    value=speed_mm_s,
                    hint=f"at most {limit_mm_s:g} mm/s",
                )
                break


def _distances(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    boxes: list[Any] = [box for box in plan.cell.interlocks.values() if is_kind(box, "workspace")]
    if not boxes:
        return
    longest_mm = max(math.dist(box.max_mm, box.min_mm) for box in boxes)
    for key, distance_mm in demands(plan.task_config, "distance"):
        if distance_mm > longest_mm * _SLACK:
            yield file.problem(
                ("task", *key),
                f"{distance_mm:g} mm is longer than the largest workspace, {longest_mm:.0f} mm from corner to corner",
                value=distance_mm,
                hint="go less far, or make the workspace larger",
            )


def _starts(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    boxes: dict[str, Any] = {rule: box for rule, box in plan.cell.interlocks.items() if is_kind(box, "workspace")}
    for rule, box in boxes.items():
        name = plan.arm_roles.get(box.arm, box.arm)
        start = given_start(plan, name) if name in plan.arms else None
        if start is None:
            continue
        try:
            T = se3.from_euler_mm_deg(start)
        except GeometryError as error:
            hint = "millimetres and degrees"
            yield file.problem(("arms", name, "start_pose_mm_deg"), f"is no pose: {error}", value=start, hint=hint)
            continue
        sensor = plan.sensor_roles.get(box.sensor or "")
        if sensor is not None:
            T = T @ plan.cell.sensors[sensor].T_tcp_sensor
        at_mm = 1e3 * T[:3, 3]
        outside = [
            f"{axis} = {value:g} mm, limit {low if value < low else high:g} mm"
            for axis, value, low, high in zip("xyz", at_mm.round(3), box.min_mm, box.max_mm, strict=True)
            if not low <= value <= high
        ]
        if outside:
            point = "the tool" if sensor is None else f"{sensor!r}"
            yield file.problem(
                ("arms", name, "start_pose_mm_deg"),
                f"{point} is outside interlocks.{rule} there, which would trip at once: {'; '.join(outside)}",
                value=start,
                hint="start inside, or make the workspace larger",
            )


def _contacts(file: YamlFile, plan: CellPlan) -> Iterator[ConfigError]:
    """Tips pressed into the scene at the start of a task whose first frame has no contact; and no edge."""
    around = plan.cell.emulated_scene if plan.cell.world == "emulated" else plan.cell.scene
    if around is None or not plan.task.starts_free or plan.cell.truth is not None:
        return
    known = {name: sensor_in_world(plan, name) for name in plan.sensor_roles.values()}
    tips = {name: T for name, T in known.items() if T is not None}
    scene = scene_section().model_validate(around)
    try:
        pressed = scene.pressed(tips)
    except (ConfigError, GeometryError) as error:
        key = error.key if isinstance(error, ConfigError) else ""
        yield file.problem(("scene", *key.split(".")), str(error), hint="put it right")
        return
    if plan.task.feature == "edge" and not scene.has_edges():
        hint = "e.g. {disc: {kind: cylinder, radius_mm: 50, height_mm: 20}}"
        yield file.problem(("scene", "surfaces"), f"no surface has an edge, which {plan.task.name} needs", hint=hint)
    for name, depth_m in pressed.items():
        other = start_near(plan, scene, name)
        yield file.problem(
            ("arms", str(plan.cell.sensors[name].mounted_on), "start_pose_mm_deg"),
            f"the tip of {name!r} is {1e3 * depth_m:.1f} mm deep in something there, but the task starts free",
            hint=f"start clear of it, as with {other}" if other else "start farther away",
        )
