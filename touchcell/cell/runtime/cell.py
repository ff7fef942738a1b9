"""A composed cell: its devices, sensors, task and supervisor, and their life from connection to disconnection."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.recording.dataset_writer import Collection
from touchcell.cell.runtime.health import health_of
from touchcell.cell.runtime.sensor import Sensor
from touchcell.cell.runtime.watchdog import NullWatchdog, Watchdog
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.enabling import EnablingDevice
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.jog import JogInput
from touchcell.drivers.core.protocols import StopCategory
from touchcell.errors import ConfigError
from touchcell.tasks.interface import Task

_FIRST_READING_NS = 1_000_000_000
_POLL_NS = 20_000_000

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import SceneTruth


@dataclass
class Cell:
    """A cell that is built. As a context manager it is connected and activated, and given back at the end.

    Attributes:
        plan: where it came from.
        clock: its time.
        arms: by role in the task, and those that only carry a sensor by their own name.
        sensors: by role.
        auxiliaries: devices that are neither arms nor cameras, by role, or by name where they have none.
        task: what the cell does.
        resumed_task: makes it anew, in its first state, after a trip.
        stop_categories: by which each arm stops when something is wrong, by role.
        holding: roles of arms that keep their power when another's fault stops them.
        watched_joints: roles of arms whose joint angles an interlock reads.
        watched_wrenches, watched_torques: roles of arms whose wrench, or external torque, is needed.
        watched_readings: names of devices and of the readings in their health that interlocks limit.
        enabling_device: operator input of a cell whose file names one.
        jog_input: what an operator who moves the arms by hand asks for; None for other tasks.
        scene: what is simulated around the arms, as far as it can be looked into; None in a cell of real devices.
        collection: where labelled frames go, None where the task labels none.
        watchdog: stops the arms when the loop falls silent.
        scene_start_ns: when the scene's own time began.
        require_armed: raises ConfigError unless every interlock trips on the faults that it guards against; called when
            all devices have answered and none is energised.
    """

    plan: CellPlan
    clock: Clock
    arms: Mapping[str, Any]
    cameras: Mapping[str, Device]
    sensors: Mapping[str, Sensor]
    supervisor: Supervisor
    task: Task
    resumed_task: Callable[[], Task]
    auxiliaries: Mapping[str, Device] = field(default_factory=dict)
    stop_categories: Mapping[str, StopCategory] = field(default_factory=dict)
    holding: frozenset[str] = frozenset()
    watched_joints: frozenset[str] = frozenset()
    watched_wrenches: frozenset[str] = frozenset()
    watched_torques: frozenset[str] = frozenset()
    watched_readings: frozenset[tuple[str, str]] = frozenset()
    enabling_device: EnablingDevice | None = None
    jog_input: JogInput | None = None
    scene: SceneTruth | None = None
    collection: Collection | None = None
    watchdog: Watchdog = field(default_factory=NullWatchdog)
    require_armed: Callable[[], None] = lambda: None
    scene_start_ns: int = 0
    start_ns: int = 0
    _exit: ExitStack = field(default_factory=ExitStack, init=False)

    def __repr__(self) -> str:
        devices = ", ".join(repr(device) for device in self.devices())
        return f"<Cell {self.plan.cell.name!r}: task {self.task_name} in {self.task.state!r}, {devices}>"

    @property
    def rate_hz(self) -> float:
        """Control cycles per second."""
        return self.plan.cell.rate_hz

    @property
    def max_duration_s(self) -> float:
        """Longest run."""
        return self.plan.cell.max_duration_s

    @property
    def task_name(self) -> str:
        """The task's name, which owns the arms' leases."""
        return self.plan.task.name

    def __enter__(self) -> Self:
        with self._exit:
            self._exit.enter_context(self.watchdog)
            for device in self.devices():
                self._exit.enter_context(device)
                if device.state is Lifecycle.FAULTED:
                    raise DeviceError(
                        device.name,
                        f"has a fault from before: {device.fault}",
                        hint="`touchcell recover CELL` clears it, after asking you",
                    )
                device.configure()
            self.require_armed()
            self._require_readings()
            # Every device must answer before the first one is energised.
            for device in self.devices():
                device.activate()
                self._exit.callback(self._deactivate, device)
            for sensor in self.sensors.values():
                self._exit.callback(sensor.end)
            self.watchdog.self_test()
            self.start_ns = self.clock.now_ns()
            self._exit = self._exit.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.close()

    def devices(self) -> list[Device]:
        """Every device of the cell, once."""
        unique = {
            id(device): device for device in [*self.arms.values(), *self.cameras.values(), *self.auxiliaries.values()]
        }
        return list(unique.values())

    def _require_readings(self) -> None:
        """Raise ConfigError for a limited reading that a device does not report within a second of being asked."""
        devices = {device.name: device for device in self.devices()}
        for name, reading in sorted(self.watched_readings):
            deadline_ns = self.clock.now_ns() + _FIRST_READING_NS
            while reading not in (health := health_of(devices[name])):
                if self.clock.now_ns() >= deadline_ns:
                    raise ConfigError(
                        f"{name} reports no {reading!r}",
                        file=str(self.plan.file),
                        key="interlocks",
                        hint=f"it reports {', '.join(sorted(health))}",
                    )
                self.clock.sleep_until_ns(self.clock.now_ns() + _POLL_NS)

    def _deactivate(self, device: Device) -> None:
        section = self.plan.cell.arms.get(device.name) or self.plan.cell.devices.get(device.name)
        if device.state is Lifecycle.ACTIVE:
            device.deactivate(section.deactivate) if section is not None else device.deactivate()
