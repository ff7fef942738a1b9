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

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.default_scene import Start, default_scene, start_of
from touchcell.cell.config.yaml_file import load
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
    given = getattr(cell, key) or cell.scene or cell.emulated_scene
    beside = scene_beside(plan.file)
    if given is None and os.path.isfile(beside):
        written = load(beside).data
        starts = written.pop("start_pose_mm_deg", {})
        given = written
        found.notes.append(f"scene: {beside.name}")
    found.starts = {
        name: start_of(plan, name, cell.arms[name].start_pose_mm_deg or starts.get(name)) for name in plan.arms
    }
    for name, start in found.starts.items():
        found.settings[f"arms.{name}.start_pose_mm_deg"] = [round(value, 4) for value in start.pose_mm_deg]
    if given is None:
        given = default_scene(plan, {name: start.pose_mm_deg for name, start in found.starts.items()})
        found.notes.append(f"scene: a default for {plan.task.name}; `check --explain` prints it")
    if getattr(cell, key) is None:
        found.settings[key] = dict(given)


def scene_beside(file: Path) -> Path:
    """Return the path of the scene beside a cell file: ``bench.scene.yaml`` for ``bench.yaml``."""
    return file.with_name(f"{file.stem}.scene.yaml")
