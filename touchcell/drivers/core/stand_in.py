"""Simulated stand-ins for the devices of real drivers, found by entry point: one for each kind of device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

from touchcell.drivers.core.spec import AnyDriver
from touchcell.registry import Registry

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a cell file puts a device.

    Attributes:
        base_pose_mm_deg: pose of an arm's base in the world frame.
        start_pose_mm_deg: initial pose of an arm's tool in its base frame; None for the driver's home.
        mounted_on: name of the arm that carries a camera; None where nothing moves it.
        tcp_to_sensor_mm_deg: pose of a camera's sensor in the tool frame of that arm.
    """

    base_pose_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    start_pose_mm_deg: Six | None = None
    mounted_on: str | None = None
    tcp_to_sensor_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@runtime_checkable
class StandInFactory(Protocol):
    """Function that makes the simulated driver of a real one."""

    __name__: str

    def __call__(self, spec: AnyDriver, placement: Placement, /) -> AnyDriver:
        """Return a driver with the name, configuration and capabilities of ``spec``, on virtual time."""
        ...


STAND_INS: Final[Registry[StandInFactory]] = Registry("touchcell.stand_ins", "stand-in", StandInFactory)
"""Stand-ins by kind of device, as "arm"."""
