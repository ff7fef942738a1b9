"""The devices of a plan, each made after those that it depends on, and the world that they live in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from touchcell.cell.config.cell_plan import CellPlan, DevicePlan
from touchcell.cell.runtime.watchdog import NullWatchdog, Watchdog
from touchcell.drivers.core.clock import Clock, MonotonicClock, VirtualClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DriverContext

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import Scene, SceneTruth


@dataclass(frozen=True, slots=True)
class World:
    """What exists before any device of this process.

    Attributes:
        clock: time of the cell.
        hosted: devices that live in processes of their own, by name.
        scene: simulated in this process, for devices to be mounted in; None where there is none.
        truth: what the simulated scene can be asked, also one in another process; None without a scene.
        watchdog: stops the arms when the loop falls silent.
    """

    clock: Clock
    hosted: Mapping[str, Device]
    scene: Scene | None
    truth: SceneTruth | None
    watchdog: Watchdog


def build_world(plan: CellPlan, role_of: Mapping[str, str], clock: Clock | None = None) -> World:
    """Make the clock, the simulated scene and, with ``processes: separate``, the hosts; nothing is started yet.

    Args:
        plan: a checked cell file.
        role_of: roles of the arms in the task, by name.
        clock: in place of the one that the file asks for.
    """
    clock = clock or _clock(plan)
    if plan.cell.processes == "one":
        scene = _scene(plan, clock)
        return World(clock, {}, scene, scene, NullWatchdog())
    from touchcell.cell.runtime.process_watchdog import ProcessWatchdog, build_chain

    chain = build_chain(plan, clock)
    # A scene that lives in a host is not here too.
    scene = _scene(plan, clock) if chain.scene is None else None
    truth = scene if chain.scene is None else chain.scene
    return World(clock, chain.devices, scene, truth, ProcessWatchdog(chain, role_of))


def build_devices(
    plan: CellPlan,
    wanted: Mapping[str, DevicePlan],
    clock: Clock | None = None,
    scene: Scene | None = None,
    present: Mapping[str, Device] | None = None,
) -> dict[str, Device]:
    """Make the ``wanted`` devices of ``plan``, DISCONNECTED, each after those that it depends on; with those present.

    Args:
        plan: a checked cell file.
        wanted: arms before the sensors that they carry.
        clock: in place of the one that the file asks for.
        scene: the simulated scene, if it exists already.
        present: devices that are there already.
    """
    clock = clock or _clock(plan)
    devices: dict[str, Device] = dict(present or {})
    if scene is None and wanted:
        scene = _scene(plan, clock)
    bases = {name: arm.T_world_base for name, arm in plan.cell.arms.items()}
    context = DriverContext(clock, devices, scene, plan.cell.seed, bases)
    for name, device in wanted.items():
        devices[name] = device.spec.build(name, device.config, context)
    return devices


def _clock(plan: CellPlan) -> Clock:
    if plan.cell.time == "simulated":
        return VirtualClock()
    return emulated_clock() if plan.cell.world == "emulated" else MonotonicClock()


def _scene(plan: CellPlan, clock: Clock) -> Scene | None:
    if plan.cell.scene is None:
        return None
    return scene_section().model_validate(plan.cell.scene).build(clock)
