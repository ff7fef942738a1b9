"""The cell file: what it may say, and the plan that comes of it. Nothing is connected here, and no SDK is imported.

A plan holds every device, interlock and task of the file with its own validated configuration, proves that devices and
task fit, and says which devices the task does not need, so that they are not even built.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import BaseModel

from touchcell.cell.config.addresses import clashes
from touchcell.cell.config.cell_plan import (
    REDUCED_SPEED_M_S,
    ArmSection,
    CellFile,
    CellPlan,
    DevicePlan,
    DeviceSection,
    OpenSection,
    SensorSection,
)
from touchcell.cell.config.feasibility import unfeasible
from touchcell.cell.config.feasible_motion import failing_motions, foreseen_trips, places_outside, ways_over
from touchcell.cell.config.input_files import with_input_files, with_paths
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.starts import start_near
from touchcell.cell.config.stopping_distance import StoppingDistance, combined, overshoot
from touchcell.cell.config.truth import SampledTruth, sample
from touchcell.cell.config.worlds import WorldChanges, WorldName, world_changes
from touchcell.cell.config.yaml_file import InvalidCell, KeyPath, YamlFile
from touchcell.control.interlocks.boundary import WorkspaceConfig
from touchcell.control.interlocks.clearance import ClearanceConfig
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.protocols import JointSource, ReadingSource, WrenchSource, protocol_names
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DRIVERS, AnyDriver, DriverConfig
from touchcell.drivers.core.stand_in import STAND_INS, Placement
from touchcell.errors import ConfigError, suggest
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.input_file import BUILTIN
from touchcell.tasks.interface import TASKS, AnyTask, TaskConfig

EMULATED_CAMERAS: Final = "TOUCHCELL_V4L2"
"""Variable that names the folder of emulated cameras."""

M = TypeVar("M", bound=BaseModel)
C = TypeVar("C", bound=DriverConfig)


def plan_cell(
    path: str | PathLike[str],
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
    world: WorldChanges | None = None,
    to_run: bool = True,
    prove: bool = True,
) -> CellPlan:
    """Read and check a cell file without connecting anything.

    Args:
        path: the YAML file.
        overrides: driver keys set from the command line (``--data``), for every device whose driver has such a key.
        model: network model in place of the one that the file names.
        to_run: False for the cell of a run that has been: its files may be gone, and its limits are not judged again.
        prove: False leaves the proof that every interlock can trip to the activation of the composed cell.
        settings: values in place of the file's own, by dotted key ("task.speed_mm_s", "arms.arm.limits").
        world: what the world that it runs in changes; see ``plan_in_world``.

    Raises:
        ConfigError: with file, line, key, value and remedy; InvalidCell for several at once.
    """
    file = load_layers(Path(path), settings, None if world is None else world.settings)
    if model is not None and not model.startswith(BUILTIN):
        # Paths of the command line are relative to the working directory, those of the file to the file.
        model = str(Path(model).absolute())
    overrides = dict(overrides or {})
    if isinstance(data := overrides.get("data"), Path):
        overrides["data"] = data.absolute()
    if model is not None and isinstance(sensors := file.data.get("sensors"), dict):
        for sensor in sensors.values():
            estimator = sensor.get("estimator") if isinstance(sensor, dict) else None
            if isinstance(estimator, dict) and estimator.get("kind") in ("network", "edge_network"):
                estimator["model"] = model
    plan = _Planner(file, overrides, settings or {}, to_run=to_run, prove=prove).plan()
    return plan if world is None else replace(plan, world_settings=world.settings, notes=(*plan.notes, *world.notes))


def plan_in_world(
    path: str | PathLike[str],
    world: WorldName | None,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
    more: Mapping[str, Any] | None = None,
    prove: bool = True,
) -> CellPlan:
    """Read and check a cell file for one of its worlds; ``plan_cell`` has the other arguments.

    Args:
        path: the YAML file.
        world: where it is to run; None as the file is written.
        overrides, model, settings, prove: see ``plan_cell``; all go before what the world changes.
        more: further values that the world puts in place of the file's own, as the addresses of emulators.

    Raises:
        ConfigError: see ``plan_cell``; a device that the world has not.
    """
    if world is None:
        return plan_cell(path, overrides, model=model, settings=settings, prove=prove)
    found = _as_written(path, overrides, model, settings)
    if found.cell.world is not None and world != "bench":
        # The file has been through this already, as that of a run folder has.
        return plan_cell(path, overrides, model=model, settings={**(settings or {}), "world": world}, prove=prove)
    changes = world_changes(found, world)
    changes.settings.update(more or {})
    return plan_cell(path, overrides, model=model, settings=settings, world=changes, prove=prove)


def _as_written(
    path: str | PathLike[str],
    overrides: Mapping[str, Any] | None,
    model: str | None,
    settings: Mapping[str, Any] | None,
) -> CellPlan:
    return plan_cell(path, overrides, model=model, settings=settings, to_run=False)


class _Planner:
    def __init__(
        self, file: YamlFile, overrides: Mapping[str, Any], settings: Mapping[str, Any], *, to_run: bool, prove: bool
    ) -> None:
        self._file = file
        self._to_run, self._prove = to_run, prove
        self._overrides = overrides
        self._settings = settings
        self._problems: list[ConfigError] = []
        self._truth = SampledTruth()

    def plan(self) -> CellPlan:
        file = self._file
        if "data" in self._overrides and isinstance(collect := file.data.get("collect"), dict):
            collect["data"] = self._overrides["data"]
        cell = self._with_input_files(file.validate(CellFile, file.data), ())
        cell = self._in_truth(cell)
        cell = self._with_scenes(cell)
        task, task_config = self._task(cell)
        arm_roles = self._roles(cell, "arms", task.arms, cell.arms) if task else {}
        sensor_roles = self._roles(cell, "sensors", task.sensors, cell.sensors) if task else {}
        auxiliary_roles = self._roles(cell, "devices", task.devices, cell.devices) if task else {}
        left_out = self._left_out(cell, set(auxiliary_roles.values()))
        others = {name: plan for name in cell.devices if name not in left_out and (plan := self._auxiliary(cell, name))}
        auxiliaries = {
            name: plan
            for name, plan in others.items()
            if name in auxiliary_roles.values() or ReadingSource in plan.spec.capabilities.provides
        }
        auxiliary_roles |= {name: name for name in auxiliaries if name not in auxiliary_roles.values()}
        needed_sensors = set(sensor_roles.values())
        carried = [cell.sensors[name] for name in needed_sensors] + [cell.devices[name] for name in auxiliaries]
        needed_arms = set(arm_roles.values()) | {section.mounted_on for section in carried} - {None}
        devices = {name: plan for name in cell.arms if (plan := self._arm(cell, name))}
        devices |= {name: plan for name in cell.sensors if (plan := self._sensor(cell, name))}
        arms = {name: plan for name, plan in devices.items() if name in needed_arms}
        sensors = {name: plan for name, plan in devices.items() if name in needed_sensors}
        devices |= others
        self._require_names(cell)
        self._require_addresses({**arms, **sensors, **auxiliaries})
        if task:
            self._require_collection(cell, task)
            self._require_protocols(task, "arms", task.arms, arm_roles, arms)
            self._require_protocols(task, "devices", task.devices, auxiliary_roles, others)
            if task_config is not None:
                self._require_forces(cell, task, task_config, arm_roles, arms)
            self._require_processes(cell, task, arm_roles)
            self._require_data_is_used(cell, {**arms, **sensors})
        self._require_guarded_arms(cell, {*arm_roles, *(set(arms) - set(arm_roles.values()))})
        self._require_pairs(cell)
        self._require_use_of_data(cell, devices)
        stopping_distances = self._require_margins(cell, arm_roles, sensor_roles, arms)
        if self._problems:
            raise InvalidCell(self._problems)
        assert task is not None
        assert task_config is not None
        skipped = sorted({*cell.arms, *cell.sensors, *cell.devices} - {*arms, *sensors, *auxiliaries})
        planned = CellPlan(
            file.path,
            cell,
            arms,
            sensors,
            arm_roles,
            sensor_roles,
            task,
            task_config,
            tuple(skipped),
            devices,
            stopping_distances,
            self._settings,
            auxiliaries,
            auxiliary_roles,
            truth=self._truth.values,
        )
        if not self._to_run:
            return planned
        if problems := unfeasible(file, planned):
            raise InvalidCell(problems)
        ways = ways_over(planned)
        if problems := list(places_outside(file, planned, ways)):
            raise InvalidCell(problems)
        planned = replace(planned, foreseen=tuple(foreseen_trips(file, planned, ways)))
        notes = (*_remarks(file, planned), *(f"{name}: left out, as {reason}" for name, reason in left_out.items()))
        return replace(self._require_armed(planned) if self._prove else planned, notes=notes)

    def _in_truth(self, cell: CellFile) -> CellFile:
        """Return the cell with its scene as it truly is, and keep what is true of its devices."""
        if cell.truth is None or cell.world in ("bench", "emulated"):
            return cell
        if cell.scene is None:
            if cell.world is None and self._to_run:
                self._add(("truth",), "only a simulated world has one, and there is no `scene:`", hint="leave it out")
            return cell
        for kind, known in (("arms", cell.arms), ("sensors", cell.sensors), ("objects", cell.scene.get("objects", {}))):
            for name in getattr(cell.truth, kind):
                if name not in known:
                    hint = suggest(name, sorted(known))
                    self._add(("truth", kind, name), f"there is no {name!r} in `{kind}:`", value=name, hint=hint)
        self._truth = sample(cell.truth, cell.seed)
        return cell.model_copy(update={"scene": self._truth.scene(cell.scene)})

    def _with_truth(self, at: tuple[str, str], spec: AnyDriver, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return a device's keys with the true ones in place of the declared ones."""
        true = self._truth.device(*at, given) if at[0] in ("arms", "sensors") else {}
        for key in true.keys() - spec.config.model_fields.keys():
            self._add(("truth", *at, key), f"{spec.name} has no {key!r}", hint="leave it out")
        return {**given, **true}

    def _with_scenes(self, cell: CellFile) -> CellFile:
        """Return ``cell`` with its scenes checked, and the files that they name found."""
        if cell.world == "bench":
            self._require_nothing_simulated(cell)
        found = {}
        for key in ("scene", "emulated_scene"):
            data = getattr(cell, key)
            section = None if data is None else self._validated(scene_section(), data, (key,))
            if section is not None:
                found[key] = with_paths(data, section, self._with_input_files(section, (key,)))
        return cell.model_copy(update=found)

    def _require_nothing_simulated(self, cell: CellFile) -> None:
        if cell.enabling_device == "simulated":
            self._add(("enabling_device",), "a simulated one is no device of a bench", hint="enabling_device: external")
        for name, sensor in cell.sensors.items():
            if sensor.estimator.needs_truth:
                reason = f"{sensor.estimator.kind} asks a simulated scene, and a bench has none"
                self._add(("sensors", name, "estimator"), reason, hint="kind: network or known_surface")
        if (folder := os.environ.get(EMULATED_CAMERAS)) is not None:
            reason = "emulated cameras are put in place of real ones by this variable"
            self._problems.append(ConfigError(reason, key=EMULATED_CAMERAS, value=folder, hint="unset it"))

    def _task(self, cell: CellFile) -> tuple[AnyTask | None, TaskConfig | None]:
        try:
            spec = TASKS.load(cell.task.name)
        except ConfigError as error:
            self._add(("task", "name"), error.reason, value=cell.task.name, hint=error.hint)
            return None, None
        if spec.of_cell is not None:
            spec = spec.of_cell(frozenset(cell.task.arms or cell.arms), frozenset(cell.task.sensors or cell.sensors))
        return spec, self._validated(spec.config, cell.task.model_extra or {}, ("task",))

    def _roles(
        self, cell: CellFile, kind: str, roles: Collection[str], devices: Mapping[str, OpenSection]
    ) -> dict[str, str]:
        """Role -> device name. A role that the file does not assign goes to the device of the same name."""
        assigned: dict[str, str] = getattr(cell.task, kind)
        for role in assigned.keys() - set(roles):
            self._add(("task", kind, role), f"{cell.task.name} has no such role", hint=suggest(role, sorted(roles)))
        found = {}
        # In one order in every process: a set of names has another in each.
        for role in sorted(roles):
            name = assigned.get(role, role)
            if name in devices:
                found[role] = name
            else:
                self._add(
                    ("task", kind, role),
                    f"the role {role!r} needs one of `{kind}:`, and {name!r} is not there",
                    value=name,
                    hint=suggest(name, sorted(devices)) if devices else f"add `{kind}:`",
                )
        return found

    def _arm(self, cell: CellFile, name: str) -> DevicePlan | None:
        section = cell.arms[name]
        shared: dict[str, Any] = {
            "deactivate": section.deactivate,
            "base_pose_mm_deg": section.base_pose_mm_deg,
        }
        if section.start_pose_mm_deg is not None:
            shared["start_pose_mm_deg"] = section.start_pose_mm_deg
        plan = self._device(cell, ("arms", name), section, shared, "arm")
        offered = plan.spec.capabilities.stop_categories if plan else ()
        if plan and offered and section.stop_category not in offered:
            self._add(
                ("arms", name, "stop_category"),
                f"{plan.spec.name} does not offer stop category {section.stop_category}",
                value=section.stop_category,
                hint=f"it offers {', '.join(str(int(category)) for category in sorted(offered))}",
            )
        return plan

    def _sensor(self, cell: CellFile, name: str) -> DevicePlan | None:
        section = cell.sensors[name]
        self._require_mount(cell, ("sensors", name), section.mounted_on)
        if section.estimator.needs_truth and cell.scene is None and self._to_run:
            self._add(
                ("sensors", name, "estimator"), f"{section.estimator.kind} needs a `scene:`", hint="use kind: network"
            )
        shared = {"mounted_on": section.mounted_on, "tcp_to_sensor_mm_deg": section.tcp_to_sensor_mm_deg}
        return self._device(cell, ("sensors", name), section, shared, "camera")

    def _auxiliary(self, cell: CellFile, name: str) -> DevicePlan | None:
        section = cell.devices[name]
        self._require_mount(cell, ("devices", name), section.mounted_on)
        shared = {"mounted_on": section.mounted_on, "deactivate": section.deactivate}
        return self._device(cell, ("devices", name), section, shared, None)

    def _left_out(self, cell: CellFile, needed: set[str]) -> dict[str, str]:
        """Return the devices that a simulated world does without, by name with the reason: no task needs them."""
        found: dict[str, str] = {}
        if cell.world != "sim":
            return found
        for name in cell.devices.keys() - needed:
            with suppress(ConfigError):
                able = DRIVERS.load(cell.devices[name].driver).capabilities
                if not able.virtual_time and able.kind not in STAND_INS.names():
                    found[name] = f"nothing simulates {_a(able.kind)}"
        return dict(sorted(found.items()))

    def _require_addresses(self, devices: Mapping[str, DevicePlan]) -> None:
        """No two devices are at one address."""
        sections = {"arm": "arms", "camera": "sensors"}
        for name, key, other in clashes(devices):
            device = devices[name]
            at = (sections.get(device.spec.capabilities.kind, "devices"), name, key)
            value = getattr(device.config, key)
            self._add(at, f"{other!r} is there already", value=value, hint="give each device its own address")

    def _require_mount(self, cell: CellFile, at: tuple[str, str], arm: str | None) -> None:
        if arm is not None and arm not in cell.arms:
            self._add((*at, "mounted_on"), f"there is no arm {arm!r}", value=arm, hint=suggest(arm, sorted(cell.arms)))

    def _require_names(self, cell: CellFile) -> None:
        """A device is known by its name alone, to drivers and in messages."""
        taken: set[str] = set()
        for kind in ("arms", "sensors", "devices"):
            for name in getattr(cell, kind):
                if name in taken:
                    self._add(
                        (kind, name), "another device has this name", value=name, hint="give it a name of its own"
                    )
                taken.add(name)

    def _device(
        self,
        cell: CellFile,
        at: tuple[str, str],
        section: ArmSection | SensorSection | DeviceSection,
        shared: Mapping[str, Any],
        kind: str | None,
    ) -> DevicePlan | None:
        try:
            spec = DRIVERS.load(section.driver)
        except ConfigError as error:
            self._add((*at, "driver"), error.reason, value=section.driver, hint=error.hint)
            return None
        if kind is None and spec.capabilities.kind == "arm":
            self._add((*at, "driver"), f"{spec.name} drives an arm", value=spec.name, hint="list it under `arms:`")
        if kind is not None and spec.capabilities.kind != kind:
            self._add(
                (*at, "driver"),
                f"{spec.name} drives {_a(spec.capabilities.kind)}, not {_a(kind)}",
                value=section.driver,
                hint="`touchcell list` tells which drivers there are",
            )
        spec = self._in_world(cell, at, section, spec)
        if cell.time == "simulated" and cell.world != "sim" and not spec.capabilities.virtual_time:
            self._add(
                (*at, "driver"), f"{spec.name} cannot run in simulated time", value=spec.name, hint="set `time: real`"
            )
        fields = spec.config.model_fields
        settings = {key: value for key, value in {**shared, **self._overrides}.items() if key in fields}
        given = self._with_truth(at, spec, {**(section.model_extra or {}), **settings})
        config = self._validated(spec.config, given, at)
        if config is None:
            return None
        if cell.world == "bench" and (key := config.emulated_address()) is not None:
            reason = "leads to an emulator on this machine, and the cell is to run on the bench"
            hint = "give the device's own address, or run --on emulated"
            self._add((*at, key), reason, value=getattr(config, key, None), hint=hint)
        if cell.reduced_speed:
            config = _at_reduced_speed(config)
        return DevicePlan(at[1], spec, self._with_input_files(config, at))

    def _in_world(
        self,
        cell: CellFile,
        at: tuple[str, str],
        section: ArmSection | SensorSection | DeviceSection,
        spec: AnyDriver,
    ) -> AnyDriver:
        """Return the driver that is used in the cell's world: a simulated stand-in, or the real one."""
        able = spec.capabilities
        if cell.world == "bench" and (able.virtual_time or able.needs_scene):
            reason = f"{spec.name} is no device of a bench, and the cell is to run on the bench"
            self._add((*at, "driver"), reason, value=spec.name, hint="name a driver of a real device, or run --on sim")
        if cell.world == "emulated" and (able.virtual_time or able.needs_scene):
            reason = f"{spec.name} is simulated already, and has no emulator"
            self._add((*at, "driver"), reason, value=spec.name, hint="run --on sim")
        if cell.world != "sim" or able.virtual_time:
            return spec
        try:
            factory = STAND_INS.load(able.kind)
        except ConfigError:
            self._add((*at, "driver"), f"nothing simulates {_a(able.kind)}", value=spec.name, hint="leave it out")
            return spec
        if spec.behaviour is None:
            reason = f"{spec.name} does not describe how its device behaves, so that nothing can simulate it"
            self._add((*at, "driver"), reason, value=spec.name, hint="its DriverSpec needs `behaviour`")
            return spec
        place: dict[str, Any] = {}
        if isinstance(section, ArmSection):
            place = {"base_pose_mm_deg": section.base_pose_mm_deg, "start_pose_mm_deg": section.start_pose_mm_deg}
        elif isinstance(section, SensorSection):
            place = {"mounted_on": section.mounted_on, "tcp_to_sensor_mm_deg": section.tcp_to_sensor_mm_deg}
        return factory(spec, Placement(**place))

    def _require_armed(self, plan: CellPlan) -> CellPlan:
        """An interlock that cannot trip, and what moves or feels and nothing guards, is refused."""
        from touchcell.cell.config.armed import cell_facts, not_armed, prove_cell
        from touchcell.cell.config.healthy_motion import trips_in_motion
        from touchcell.cell.config.healthy_start import trips_when_healthy

        try:
            facts = cell_facts(plan)
            proofs = prove_cell(plan, facts)
        except ConfigError as error:
            self._add(tuple(error.key.split(".")), error.reason, value=error.value, hint=error.hint)
            raise InvalidCell(self._problems) from None
        # What cannot trip is shown nothing that must not trip it.
        for problem in list(not_armed(plan, facts, proofs)) or trips_when_healthy(plan, facts):
            self._add(problem.path, problem.reason, hint=problem.hint)
        if self._problems:
            raise InvalidCell(self._problems)
        foreseen = (self._file.problem(each.path, each.reason, hint=each.hint) for each in trips_in_motion(plan, facts))
        return replace(plan, proofs=proofs, foreseen=(*plan.foreseen, *foreseen))

    def _require_data_is_used(self, cell: CellFile, devices: Mapping[str, DevicePlan]) -> None:
        """A data set that is given exists, and something reads it or writes it."""
        data = self._overrides.get("data")
        if data is None or cell.collect is not None:
            return
        readers = [name for name, device in devices.items() if "data" in type(device.config).model_fields]
        if not readers:
            reason, hint = "no driver of this cell replays a data set", "leave out --data"
        elif not os.path.isdir(data):
            reason, hint = f"{data}: there is no such folder", f"{', '.join(readers)} would replay it"
        else:
            return
        self._problems.append(ConfigError(reason, key="--data", value=data, hint=hint))

    def _require_processes(self, cell: CellFile, task: AnyTask, arm_roles: Mapping[str, str]) -> None:
        """What devices in other processes cannot do is not asked of them."""
        if cell.processes == "one":
            return
        from touchcell.drivers.hosting.groups import REMOTE_PROTOCOLS

        if cell.time == "simulated":
            self._add(
                ("processes",), "several processes share real time only", value=cell.processes, hint="`time: real`"
            )
        for role, protocols in task.arms.items():
            if missing := protocols - REMOTE_PROTOCOLS:
                self._add(
                    ("processes",),
                    f"{task.name} needs {protocol_names(missing)} of {role!r}, which no other process passes on",
                    hint="leave out `processes:`",
                )

    def _require_guarded_arms(self, cell: CellFile, roles: set[str]) -> None:
        for name, entry in cell.interlocks.items():
            role = getattr(entry, "arm", None)
            if role is not None and roles and role not in roles:
                self._add(
                    ("interlocks", name, "arm"),
                    f"the task has no arm {role!r}",
                    value=role,
                    hint=suggest(role, sorted(roles)),
                )

    def _require_pairs(self, cell: CellFile) -> None:
        for k, pair in enumerate(cell.pairs):
            for key, name in (("leader", pair.leader), ("follower", pair.follower)):
                if name not in cell.arms:
                    self._add(
                        ("pairs", str(k), key),
                        f"there is no arm {name!r}",
                        value=name,
                        hint=suggest(name, sorted(cell.arms)),
                    )
            if pair.leader == pair.follower:
                self._add(("pairs", str(k)), "one arm is no pair", value=pair.leader, hint="name two")

    def _require_margins(
        self,
        cell: CellFile,
        arm_roles: Mapping[str, str],
        sensor_roles: Mapping[str, str],
        arms: Mapping[str, DevicePlan],
    ) -> dict[str, StoppingDistance]:
        """What an arm may get beyond its workspace before it stands has to fit the margin that there is."""
        found = {}
        for name, entry in cell.interlocks.items():
            if isinstance(entry, ClearanceConfig):
                found[name] = self._require_clearance(cell, name, entry, arms)
            if not isinstance(entry, WorkspaceConfig):
                continue
            arm = arms.get(arm_roles.get(entry.arm, entry.arm))
            section = cell.sensors.get(sensor_roles.get(entry.sensor or "", ""))
            lever_m = 0.0 if section is None else 1e-3 * (math.hypot(*section.tcp_to_sensor_mm_deg[:3]))
            way = None if arm is None else _overshoot(arm, lever_m, cell.rate_hz)
            if arm is None or way is None:
                continue
            found[name] = way
            if found[name].total_m > 1e-3 * entry.margin_mm:
                self._add(
                    ("interlocks", name, "margin_mm"),
                    f"the arm may get further out than the margin of {entry.margin_mm:g} mm: {found[name]}",
                    value=entry.margin_mm,
                    hint=f"lower arms.{arm.name}.limits.tcp_speed_m_s, or make the box smaller and the margin larger",
                )
        return found

    def _require_collection(self, cell: CellFile, task: AnyTask) -> None:
        if task.labels_frames and cell.collect is None:
            self._add(("collect",), f"{task.name} labels frames, and nothing says where they go", hint="add `collect:`")
        if cell.collect is not None and not task.labels_frames:
            self._add(("collect",), f"{task.name} labels no frames", hint="leave out `collect:`")

    def _require_clearance(
        self, cell: CellFile, name: str, entry: ClearanceConfig, arms: Mapping[str, DevicePlan]
    ) -> StoppingDistance:
        """Two arms that come near each other must stand before they touch, whatever way they go meanwhile."""
        ways = []
        for arm in arms.values():
            body = cell.arms[arm.name].body
            if not body and JointSource not in arm.spec.capabilities.provides:
                self._add(
                    ("arms", arm.name, "body"),
                    f"{arm.spec.name} tells only where its tool is; interlocks.{name} has to know its shape",
                    hint="name capsules: body: [{from_mm: [0, 0, 0], to_mm: [0, 0, -100], radius_mm: 40}]",
                )
            ends = [end for part in body for end in (part.from_mm, part.to_mm) if end is not None]
            lever_m = 1e-3 * max((math.hypot(*end) for end in ends), default=0.0)
            if (way := _overshoot(arm, lever_m, cell.rate_hz)) is not None:
                ways.append(way)
        both = combined(sorted(ways, key=lambda way: way.total_m)[-2:])
        if both.total_m > 1e-3 * entry.limit_mm:
            self._add(
                ("interlocks", name, "limit_mm"),
                f"the arms may touch before they stand: {both}, more than the limit of {entry.limit_mm:g} mm",
                value=entry.limit_mm,
                hint=f"raise it above {1e3 * both.total_m:.0f}, or lower limits.tcp_speed_m_s of "
                f"{', '.join(sorted(arms))}",
            )
        return both

    def _require_protocols(
        self,
        task: AnyTask,
        kind: str,
        needed: Mapping[str, frozenset[type]],
        names: Mapping[str, str],
        devices: Mapping[str, DevicePlan],
    ) -> None:
        for role, protocols in needed.items():
            name = names.get(role)
            if name is None or name not in devices:
                continue
            missing = protocols - devices[name].spec.capabilities.provides
            if missing:
                self._add(
                    (kind, name, "driver"),
                    f"{devices[name].spec.name} does not provide {protocol_names(missing)}, which {task.name} needs",
                    value=devices[name].spec.name,
                    hint="choose another driver; `touchcell list` names all",
                )

    def _require_forces(
        self,
        cell: CellFile,
        task: AnyTask,
        config: TaskConfig,
        names: Mapping[str, str],
        arms: Mapping[str, DevicePlan],
    ) -> None:
        for role, key in task.needs_wrenches(config).items():
            if cell.processes == "separate":
                reason = f"{task.name} waits for {key}, which no other process passes on"
                self._add(("processes",), reason, value=cell.processes, hint="leave out `processes:`")
            name = names.get(role)
            if name is None or name not in arms or WrenchSource in arms[name].spec.capabilities.provides:
                continue
            driver = arms[name].spec.name
            self._add(
                ("task",),
                f"a step waits for {key}, but {driver} measures no force",
                value=driver,
                hint=f"use depth_mm or contact, or an arm with a force sensor for arms.{name}.driver",
            )

    def _require_use_of_data(self, cell: CellFile, devices: Mapping[str, DevicePlan]) -> None:
        reads = any("data" in device.spec.config.model_fields for device in devices.values())
        if "data" in self._overrides and not reads and cell.collect is None:
            self._add((), "--data names a data set that no device reads and no task collects", hint="leave it out")

    def _with_input_files(self, config: M, at: KeyPath) -> M:
        if not self._to_run:
            return config
        found, problems = with_input_files(self._file, config, at)
        self._problems.extend(problems)
        return found

    def _validated(self, model: type[M], data: Any, at: KeyPath) -> M | None:
        try:
            return self._file.validate(model, data, at)
        except InvalidCell as error:
            self._problems.extend(error.problems)
            return None

    def _add(self, path: tuple[str, ...], reason: str, *, value: Any = None, hint: str = "") -> None:
        self._problems.append(self._file.problem(path, reason, value=value, hint=hint))


def _remarks(file: YamlFile, plan: CellPlan) -> tuple[str, ...]:
    from touchcell.cell.config.armed import advised

    failing = (f"each run would fail: {problem}" for problem in failing_motions(file, plan))
    return (*advised(plan), *_remarks_on_scene(plan), *failing)


def _remarks_on_scene(plan: CellPlan) -> tuple[str, ...]:
    scene = plan.cell.scene
    if scene is None:
        return ()
    reach_mm = getattr(plan.task_config, "approach_distance_mm", None)
    reach_m = None if reach_mm is None else 1e-3 * reach_mm
    section, starts = scene_section().model_validate(scene), _sensor_starts(plan)
    remarks = list(section.remarks(starts, reach_m))
    if reach_m is None:
        return tuple(remarks)
    for name, T_world_s in starts.items():
        if plan.task.feature == "edge" and (missed := section.edge_missed(T_world_s, reach_m)):
            remarks.append(f"sensors.{name}: {missed}")
        if other := start_near(plan, section, name):
            remarks.append(f"sensors.{name}: it would come upon it from {other}")
    return tuple(remarks)


def _sensor_starts(plan: CellPlan) -> dict[str, Array]:
    """Return the pose (4, 4) in the world of each of the task's sensors, where its arm has a start pose."""
    starts = {}
    for name in plan.sensor_roles.values():
        section = plan.cell.sensors[name]
        arm = plan.cell.arms.get(section.mounted_on or "")
        if arm is not None and arm.start_pose_mm_deg is not None:
            T_base_tcp = se3.from_euler_mm_deg(np.array(arm.start_pose_mm_deg))
            starts[name] = arm.T_world_base @ T_base_tcp @ section.T_tcp_sensor
    return starts


def _a(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def _at_reduced_speed(config: C) -> C:
    """``config`` with the gate's speed capped; of what is no arm, as it is."""
    limits = getattr(config, "limits", None)
    if not isinstance(limits, LimitsConfig) or limits.tcp_speed_m_s <= REDUCED_SPEED_M_S:
        return config
    return config.model_copy(update={"limits": limits.model_copy(update={"tcp_speed_m_s": REDUCED_SPEED_M_S})})


def _overshoot(arm: DevicePlan, lever_m: float, rate_hz: float) -> StoppingDistance | None:
    """Of a point ``lever_m`` from the tool centre point; None for what has no limits, as a replay."""
    limits = getattr(arm.config, "limits", None)
    if not isinstance(limits, LimitsConfig):
        return None
    able = arm.spec.capabilities
    latency_s = able.command_latency_s + (1.0 / able.state_rate_hz if able.state_rate_hz else 0.0)
    return overshoot(limits.build(), lever_m, rate_hz, latency_s)
