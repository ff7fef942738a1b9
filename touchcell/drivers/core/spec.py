"""Which drivers exist and what each can do, known without connecting and without any vendor SDK installed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import require_protocols
from touchcell.drivers.core.scene import SceneTruth
from touchcell.geometry.types import Array
from touchcell.registry import Registry


class DriverConfig(BaseModel):
    """Base of every driver's configuration: unknown keys refused, values frozen, units in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a driver promises, as data. The conformance suite holds it to every entry.

    Attributes:
        kind: of device: "arm", "camera", or any other that a package brings, e.g. "gripper".
        provides: runtime-checkable Protocols that its devices satisfy, of ``touchcell.drivers.core.protocols`` or the
            package's own.
        state_rate_hz: rate at which new samples appear.
        min_command_rate_hz: slowest stream of twists that keeps it moving smoothly; 0 for devices without commands.
        command_latency_s: typical time from call to wire.
        stop_categories: IEC 60204-1 categories it can do in software.
        max_watchdog_s: longest silence after which the device stops by itself; None when only the host's time-to-live
            stops it.
        twist_axes: which of [vx vy vz wx wy wz] it can follow.
        has_brakes: whether it stays up without power.
        falls_on_power_loss: whether power loss lets it sink.
        hardware_validated: False while the driver has only met emulators.
        virtual_time: whether it runs on an injected clock; real hardware does not.
    """

    kind: str
    provides: frozenset[type]
    state_rate_hz: float
    min_command_rate_hz: float = 0.0
    command_latency_s: float = 0.0
    stop_categories: frozenset[int] = frozenset()
    max_watchdog_s: float | None = None
    twist_axes: tuple[bool, bool, bool, bool, bool, bool] = (True, True, True, True, True, True)
    has_brakes: bool = False
    falls_on_power_loss: bool = False
    hardware_validated: bool = False
    virtual_time: bool = False

    def __post_init__(self) -> None:
        require_protocols(self.provides)


@dataclass(frozen=True, slots=True)
class DriverContext:
    """What a driver may need beyond its own configuration.

    Attributes:
        clock: injected time.
        devices: devices of the cell that are built already, by name.
        scene: the simulated scene, for simulated devices; None in a real cell.
        seed: seed of everything random.
        bases: T_world_base (4, 4) of arms by name, where a cell file says where they stand.
    """

    clock: Clock
    devices: Mapping[str, Device] = field(default_factory=dict)
    scene: SceneTruth | None = None
    seed: int = 0
    bases: Mapping[str, Array] = field(default_factory=dict)


ConfigT = TypeVar("ConfigT", bound=DriverConfig)
DeviceT_co = TypeVar("DeviceT_co", bound=Device, covariant=True)


@dataclass(frozen=True, slots=True)
class DriverSpec(Generic[ConfigT, DeviceT_co]):
    """A driver's entry point. Its module imports no SDK: that happens when a device is opened.

    Attributes:
        name: the word in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its configuration.
        capabilities: the static record.
        build: makes a DISCONNECTED device from name, configuration and context.
        extra: the optional extra that brings its SDK, or None.
    """

    name: str
    summary: str
    config: type[ConfigT]
    capabilities: Capabilities
    build: Callable[[str, ConfigT, DriverContext], DeviceT_co]
    extra: str | None = None


AnyDriver: TypeAlias = DriverSpec[Any, Device]
"""A driver that was found by name: its configuration is what its own model validates."""

DRIVERS: Final[Registry[AnyDriver]] = Registry("touchcell.drivers", "driver", DriverSpec)
"""All installed drivers."""
