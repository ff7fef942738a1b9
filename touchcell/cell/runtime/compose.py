"""From a plan to a cell in a straight line: world, devices, sensors, supervisor, task, each made of those before it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias, cast

import numpy as np

from touchcell.cell.config.armed import require_armed
from touchcell.cell.config.cell_plan import REDUCED_SPEED_M_S, CellPlan
from touchcell.cell.config.perception_threads import threaded_sensors
from touchcell.cell.config.planning_scene import build_planning_scene
from touchcell.cell.recording.dataset_writer import Collection
from touchcell.cell.recording.frame_compressor import require_video
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.devices import build_devices, build_world
from touchcell.cell.runtime.enabling import SimulatedEnablingDevice
from touchcell.cell.runtime.sensor import build_sensor
from touchcell.control.interlocks.always_on import always_on
from touchcell.control.interlocks.basic import DepthConfig, TcpSpeed
from touchcell.control.interlocks.boundary import TiltConfig, WorkspaceConfig
from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.tactile import ShearConfig
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Severity
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.enabling import EnablingDevice
from touchcell.drivers.core.jog import JogInput
from touchcell.drivers.core.protocols import ExternalTorqueSource, StopCategory, TwistSink, WrenchSource
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.tasks.interface import Box, Cone, Task, TaskContext

AnyInterlock: TypeAlias = Interlock | TimedInterlock


def compose(
    plan: CellPlan,
    *,
    clock: Clock | None = None,
    enabling_device: EnablingDevice | None = None,
    jog_input: JogInput | None = None,
    arrange: Callable[[Sequence[AnyInterlock]], Sequence[AnyInterlock]] | None = None,
) -> Cell:
    """Build everything that ``plan`` needs; nothing is connected yet.

    Args:
        plan: a checked cell file.
        clock: in place of the one that the file asks for; frames are then processed in the loop.
        enabling_device: for a cell with ``enabling_device: external``.
        jog_input: operator input of the task ``jog``.
        arrange: returns the interlocks to use in place of the cell's own, which are proven to be armed all the same:
            for tests that show an interlock what its cell does not.

    Raises:
        ConfigError: an interlock names what is not there, or there is no enabling device.
        ModelError: a model file cannot be used.
        RecordingError: the folder for labelled frames cannot be written.
    """
    if plan.cell.recording.frames == "video":
        require_video()
    role_of = _arm_roles(plan)
    world = build_world(plan, role_of, clock)
    scene_start_ns = world.clock.now_ns()
    wanted = {name: device for name, device in plan.built.items() if name not in world.hosted}
    devices = build_devices(plan, wanted, world.clock, world.scene, world.hosted)
    arms = {role: cast(Arm, devices[name]) for name, role in role_of.items()}
    # A clock of the caller's may stand still, and a thread would wait for it.
    threaded = threaded_sensors(plan.cell, plan.sensors) if clock is None else frozenset()
    sensors = {
        role: build_sensor(plan, name, devices, world.truth, role_of, threaded=name in threaded)
        for role, name in plan.sensor_roles.items()
    }
    sensor_poses = {role: sensor.T_tcp_sensor for role, sensor in sensors.items()}
    planning_scene = build_planning_scene(plan, arms, {role: name for name, role in role_of.items()})
    configured = build_interlocks(plan.cell.interlocks, sensor_poses, planning_scene)
    interlocks = [
        *always_on(
            plan.cell.rate_hz,
            plan.cell.interlocks.values(),
            moved=any(isinstance(arm, TwistSink) for arm in arms.values()),
            arms=arms.keys(),
            sensors=sensors.keys(),
        ),
        *(configured if arrange is None else arrange(configured)),
        *_by_switch(plan),
    ]
    collection = _collection(plan)
    context = TaskContext(
        plan.cell.rate_hz,
        sensor_poses,
        0 if collection is None else collection.kept,
        T_world_base={role: plan.cell.arms[name].T_world_base for name, role in role_of.items()},
        carriers={role: sensor.arm_role for role, sensor in sensors.items() if sensor.arm_role is not None},
        boxes=_boxes(plan, sensor_poses),
        cones=_cones(plan, sensor_poses),
        max_depth_m=_smallest_mm(plan, DepthConfig) * 1e-3,
        max_shear_m=_smallest_mm(plan, ShearConfig) * 1e-3,
    )

    def resumed_task() -> Task:
        return plan.task.build(plan.task_config, replace(context, resumed=True))

    return Cell(
        plan=plan,
        clock=world.clock,
        arms=arms,
        cameras={name: devices[name] for name in plan.sensors},
        sensors=sensors,
        supervisor=Supervisor(interlocks, Latch()),
        task=plan.task.build(plan.task_config, context),
        resumed_task=resumed_task,
        auxiliaries={role: devices[name] for role, name in plan.auxiliary_roles.items()},
        stop_categories={role: StopCategory(plan.cell.arms[name].stop_category) for name, role in role_of.items()},
        holding=frozenset(
            role_of[pair.follower] for pair in plan.cell.pairs if pair.on_stop == "hold" and pair.follower in role_of
        ),
        watched_joints=frozenset(role for role, body in planning_scene.bodies.items() if body.link_count),
        watched_wrenches=_watched_wrenches(plan, role_of),
        watched_torques=_watched(plan, role_of, "external_torque", ExternalTorqueSource),
        watched_readings=frozenset(key for entry in plan.cell.interlocks.values() for key in entry.reads),
        enabling_device=_enabling_device(plan, world.clock, enabling_device),
        jog_input=jog_input,
        scene=world.truth,
        scene_start_ns=scene_start_ns,
        collection=collection,
        watchdog=world.watchdog,
        require_armed=partial(require_armed, plan, configured, planning_scene),
    )


def _cones(plan: CellPlan, T_tcp_sensor: Mapping[str, Array]) -> Mapping[str, tuple[Cone, ...]]:
    """The limits on the tilt of each arm role."""
    found: dict[str, tuple[Cone, ...]] = {}
    for entry in plan.cell.interlocks.values():
        if isinstance(entry, TiltConfig):
            axis = np.eye(3)[2] if entry.sensor is None else T_tcp_sensor[entry.sensor][:3, 2]
            direction = np.array(entry.direction) / np.linalg.norm(entry.direction)
            cone = Cone(axis, direction, math.radians(entry.limit_deg))
            found[entry.arm] = (*found.get(entry.arm, ()), cone)
    return found


def _smallest_mm(plan: CellPlan, kind: type[DepthConfig] | type[ShearConfig]) -> float:
    """The smallest limit of a kind of interlock, mm; infinite where there is none."""
    limits = (entry.limit_mm for entry in plan.cell.interlocks.values() if isinstance(entry, kind))
    return min(limits, default=math.inf)


def _boxes(plan: CellPlan, T_tcp_sensor: Mapping[str, Array]) -> Mapping[str, tuple[Box, ...]]:
    """The workspaces of each arm role."""
    found: dict[str, tuple[Box, ...]] = {}
    for entry in plan.cell.interlocks.values():
        if isinstance(entry, WorkspaceConfig):
            lever = np.zeros(3) if entry.sensor is None else T_tcp_sensor[entry.sensor][:3, 3]
            box = Box(lever, 1e-3 * np.array(entry.min_mm), 1e-3 * np.array(entry.max_mm))
            found[entry.arm] = (*found.get(entry.arm, ()), box)
    return found


def _by_switch(plan: CellPlan) -> tuple[TcpSpeed, ...]:
    """Interlocks that the file switches on by other keys than ``interlocks:``."""
    if not plan.cell.reduced_speed:
        return ()
    return (TcpSpeed("reduced_speed", Severity.TRIP, REDUCED_SPEED_M_S, math.inf),)


def _watched(plan: CellPlan, role_of: Mapping[str, str], measure: str, source: type) -> frozenset[str]:
    """Roles of arms of which an interlock needs a measurement that their drivers provide."""
    if not any(measure in entry.measures for entry in plan.cell.interlocks.values()):
        return frozenset()
    return frozenset(role for name, role in role_of.items() if source in plan.arms[name].spec.capabilities.provides)


def _watched_wrenches(plan: CellPlan, role_of: Mapping[str, str]) -> frozenset[str]:
    """Roles of arms whose wrench an interlock or the task needs."""
    of_task = frozenset(plan.task.needs_wrenches(plan.task_config))
    return of_task | _watched(plan, role_of, "wrench", WrenchSource)


def _enabling_device(plan: CellPlan, clock: Clock, given: EnablingDevice | None) -> EnablingDevice | None:
    wanted = plan.cell.enabling_device
    if wanted == "simulated":
        return SimulatedEnablingDevice(clock)
    if wanted == "external" and given is None:
        raise ConfigError(
            "the cell asks for an enabling device, and none is given",
            file=str(plan.file),
            key="enabling_device",
            hint="compose(plan, enabling_device=...)",
        )
    return given


def _arm_roles(plan: CellPlan) -> Mapping[str, str]:
    """The role of each arm by its name; one that only carries a sensor has its name as role."""
    role_of = {name: role for role, name in plan.arm_roles.items()}
    return role_of | {name: name for name in plan.arms if name not in role_of}


def _collection(plan: CellPlan) -> Collection | None:
    section = plan.cell.collect
    if section is None:
        return None
    # More samples of the same kind may be asked for later.
    about = {"cell": plan.cell.name, **plan.task_config.model_dump(exclude={"samples"})}
    settings = type(plan.task_config).model_fields.items()
    defaults = {name: field.default for name, field in settings if name in about and not field.is_required()}
    return Collection(section.data, dict(section.shares.items()), about, defaults)
