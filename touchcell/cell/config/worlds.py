"""The worlds that one cell file runs in: simulated, emulated, on the bench.

A world is a set of values in place of the file's own, so that a plan, ``check --explain`` and the run folder show all
that it changes. In ``sim`` each real driver is also replaced by its simulated stand-in (``drivers.core.stand_in``).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, get_args

from pydantic import BaseModel, ConfigDict

from touchcell.cell.config.cell_plan import CellPlan, Six
from touchcell.cell.config.default_scene import Start, default_scene, start_of
from touchcell.cell.config.input_files import with_input_files, with_paths
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.yaml_file import InvalidCell, YamlFile, load
from touchcell.drivers.core.scene import scene_section
from touchcell.errors import ConfigError, suggest
from touchcell.input_file import BUILTIN

WorldName: TypeAlias = Literal["sim", "emulated", "bench"]
WORLDS: Final[tuple[WorldName, ...]] = get_args(WorldName)
_SIMULATED_MODELS: Final = {"network": "builtin:sim_gdn", "edge_network": "builtin:sim_edge"}


@dataclass
class WorldChanges:
    """What a world changes in a cell.

    Attributes:
        settings: values in place of the file's own, by dotted key.
        notes: for people: what it does not show, and what it puts in place of something else.
        starts: start pose of each arm.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    starts: dict[str, Start] = field(default_factory=dict)


def world_changes(plan: CellPlan, world: WorldName) -> WorldChanges:
    """Return what ``world`` changes in a planned cell.

    Args:
        plan: the cell as its file describes it.
        world: where it is to run.

    Raises:
        ConfigError: the scene beside the file cannot be read, or a start pose is out of reach.
    """
    found = WorldChanges({"world": world})
    if world == "bench":
        return found
    cell = plan.cell
    if cell.enabling_device == "external":
        found.settings["enabling_device"] = "simulated"
        found.notes.append("enabling_device: simulated in place of the external one, and held")
    if cell.collect is not None and not str(cell.collect.data).endswith(f"-{world}"):
        found.settings["collect.data"] = f"{cell.collect.data}-{world}"
        found.notes.append(f"collect: labels go to {cell.collect.data}-{world}, not among those of the bench")
    _use_the_model_of_simulated_tips(plan, found)
    if _needs_scene(plan, world):
        _add_scene(plan, world, found)
    if world == "sim":
        _to_virtual_time(plan, found)
    elif cell.emulated_pace < 1.0:
        _slow_down(plan, found)
    return found


def _slow_down(plan: CellPlan, found: WorldChanges) -> None:
    pace = plan.cell.emulated_pace
    if plan.cell.processes == "separate":
        found.settings["processes"] = "one"
        found.notes.append("processes: one in place of separate, which run at the machine's own pace only")
    found.notes.append(f"emulated time runs at {pace:g} of the machine's, so computing counts for {pace:g} of its time")


def _needs_scene(plan: CellPlan, world: WorldName) -> bool:
    return world == "emulated" or any(not device.spec.capabilities.virtual_time for device in plan.built.values())


def _to_virtual_time(plan: CellPlan, found: WorldChanges) -> None:
    if plan.cell.time != "simulated":
        found.settings["time"] = "simulated"
    if plan.cell.processes == "separate":
        found.settings["processes"] = "one"
        found.notes.append("processes: one in place of separate; process crashes and the watchdog chain are not shown")
    if any(not device.spec.capabilities.virtual_time for device in plan.arms.values()):
        found.notes.append("not shown: buses and controllers, joint dynamics, sag, and what power loss does")
    if any(not device.spec.capabilities.virtual_time for device in plan.sensors.values()):
        found.notes.append("not shown: exposure, gain and compression of cameras")


def _use_the_model_of_simulated_tips(plan: CellPlan, found: WorldChanges) -> None:
    for name in plan.sensors:
        if plan.sensors[name].spec.capabilities.virtual_time:
            continue
        estimator = plan.cell.sensors[name].estimator
        model, known = getattr(estimator, "model", None), _SIMULATED_MODELS.get(estimator.kind)
        if isinstance(model, str) and known is not None and not model.startswith(BUILTIN):
            found.settings[f"sensors.{name}.estimator.model"] = known
            found.notes.append(
                f"{name}: {known} in place of {Path(model).name}, which has learnt another sensor's images"
            )


def _add_scene(plan: CellPlan, world: WorldName, found: WorldChanges) -> None:
    """Take the scene of the file or the one beside it, and make what is missing."""
    key = "scene" if world == "sim" else "emulated_scene"
    cell = plan.cell
    starts: Mapping[str, Any] = {}
    given = getattr(cell, key)
    for other in ("scene", "emulated_scene"):
        if given is None and (section := getattr(cell, other)) is not None:
            given = _with_files(load_layers(plan.file, plan.settings), section, (other,))
    beside = scene_beside(plan.file)
    if given is None and os.path.isfile(beside):
        given, starts = _read_scene(beside, plan)
        found.notes.append(f"scene: {beside.name}")
    for name in plan.arms:
        own = cell.arms[name].start_pose_mm_deg
        try:
            found.starts[name] = start_of(plan, name, own or starts.get(name))
        except ConfigError as error:
            if own is not None or name not in starts:
                raise
            at, hint = f"start_pose_mm_deg.{name}", error.hint
            raise ConfigError(error.reason, file=str(beside), key=at, value=error.value, hint=hint) from None
    for name, start in found.starts.items():
        found.settings[f"arms.{name}.start_pose_mm_deg"] = [round(value, 4) for value in start.pose_mm_deg]
    if given is None:
        given = default_scene(plan, {name: start.pose_mm_deg for name, start in found.starts.items()})
        found.notes.append(f"scene: a default for {plan.task.name}; `check --explain` prints it")
    if getattr(cell, key) is None:
        found.settings[key] = dict(given)


class _SceneFile(BaseModel):
    """A scene beside a cell file: a `scene:` section, and where the arms start, by their names."""

    model_config = ConfigDict(extra="allow")

    start_pose_mm_deg: dict[str, Six] = {}


def _read_scene(path: Path, plan: CellPlan) -> tuple[dict[str, Any] | None, Mapping[str, Six]]:
    """Return the scene of a file, None if it has start poses only, and those. Raises ConfigError with the line."""
    file = load(path)
    starts = file.validate(_SceneFile, file.data).start_pose_mm_deg
    for name in starts:
        if name not in plan.cell.arms:
            hint = suggest(name, sorted(plan.cell.arms))
            raise file.problem(("start_pose_mm_deg", name), f"the cell has no arm {name!r}", value=name, hint=hint)
    scene = {key: value for key, value in file.data.items() if key != "start_pose_mm_deg"}
    return _with_files(file, scene, ()) if scene else None, starts


def _with_files(file: YamlFile, scene: Mapping[str, Any], at: tuple[str, ...]) -> dict[str, Any]:
    """Return a scene with the files that it names found: what a world puts in their place is read from elsewhere."""
    section = file.validate(scene_section(), scene, at)
    found, problems = with_input_files(file, section, at)
    if problems:
        raise InvalidCell(problems)
    return with_paths(scene, section, found)


def scene_beside(file: Path) -> Path:
    """Return the path of the scene beside a cell file: ``bench.scene.yaml`` for ``bench.yaml``."""
    return file.with_name(f"{file.stem}.scene.yaml")
