"""Registry of installed drivers and their capabilities, readable without connecting and without any vendor SDK."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict

from touchcell.drivers.core.behaviour import Behaviour
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import require_protocols
from touchcell.drivers.core.scene import SceneTruth
from touchcell.geometry.types import Array
from touchcell.registry import Registry

if TYPE_CHECKING:
    from touchcell.drivers.kinematics.chain import SerialChain


class DriverConfig(BaseModel):
    """Base of every driver's configuration: unknown keys are rejected, instances are frozen, units are in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    def described_chain(self) -> SerialChain | None:
        """Return the kinematic chain that an arm's configuration names, with its tool; None without one.

        Raises:
            ConfigError: its chain file cannot be read.
        """
        return None

    def emulated_address(self) -> str | None:
        """Return the key whose value leads to an emulator on this machine, not to a device of a bench; None if none."""
        return None


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Static capabilities of a driver. The conformance suite verifies every entry.

    Attributes:
        kind: of device: "arm", "camera", or any other that a package brings, e.g. "gripper".
        provides: runtime-checkable Protocols that its devices satisfy, of ``touchcell.drivers.core.protocols`` or the
            package's own.
        state_rate_hz: rate at which new samples appear.
        min_command_rate_hz: lowest rate of twist commands that gives smooth motion; 0 for devices without commands.
        command_latency_s: typical time from the call to the transmission.
        stop_categories: IEC 60204-1 stop categories supported in software.
        max_watchdog_s: longest silence after which the device stops by itself; None if only the host's time-to-live
            stops it.
        twist_axes: which of [vx vy vz wx wy wz] it can follow.
        has_brakes: whether the arm holds its position without power.
        falls_on_power_loss: whether the arm sinks when power is lost.
        hardware_validated: False while the driver has been tested with emulators only.
        virtual_time: whether the device runs on an injected clock; real hardware does not.
        needs_scene: whether the device exists only in a simulated scene.
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
    needs_scene: bool = False

    def __post_init__(self) -> None:
        require_protocols(self.provides)


@dataclass(frozen=True, slots=True)
class DriverContext:
    """Dependencies of a driver beyond its own configuration.

    Attributes:
        clock: injected time.
        devices: devices of the cell that are already built, by name.
        scene: the simulated scene, for simulated devices; None in a real cell.
        seed: seed of all randomness.
        bases: T_world_base (4, 4) of arms by name, where the cell file gives them.
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
    """Entry point of a driver. Its module imports no SDK: that happens when a device is opened.

    Attributes:
        name: value of ``driver`` in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of the configuration.
        capabilities: static capabilities.
        build: creates a DISCONNECTED device from name, configuration and context.
        extra: optional dependency group that installs the SDK, or None.
        behaviour: of the device with a configuration, for its simulated stand-in; None for what has none.
    """

    name: str
    summary: str
    config: type[ConfigT]
    capabilities: Capabilities
    build: Callable[[str, ConfigT, DriverContext], DeviceT_co]
    extra: str | None = None
    behaviour: Callable[[ConfigT], Behaviour] | None = None


AnyDriver: TypeAlias = DriverSpec[Any, Device]
"""A driver that was found by name: its configuration is what its own model validates."""

DRIVERS: Final[Registry[AnyDriver]] = Registry("touchcell.drivers", "driver", DriverSpec)
"""All installed drivers."""
