"""Grouping of devices into processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from touchcell.drivers.core.protocols import SERVO_ARM, FrameSource, HealthSource, JointSource
from touchcell.drivers.core.spec import AnyDriver, DriverConfig

FASTEST_HZ: Final = 500.0
"""Highest rate of device cycles of a host: a process in Python sustains no more beside others."""

REMOTE_PROTOCOLS: Final = SERVO_ARM | {JointSource, FrameSource, HealthSource}
"""Protocols of devices that are available to a task in another process."""


@dataclass(frozen=True, slots=True)
class HostedDevice:
    """A device in a host.

    Attributes:
        name: name in the cell.
        spec, config: spec and configuration of its driver.
        category: stop category of an arm after a failure; 0 for a camera.
        policy: policy of an arm on deactivation; empty for a camera.
    """

    name: str
    spec: AnyDriver
    config: DriverConfig
    category: int = 0
    policy: str = ""

    @property
    def is_arm(self) -> bool:
        """True for an arm."""
        return self.spec.capabilities.kind == "arm"


@dataclass(frozen=True, slots=True)
class Group:
    """Devices that share a host, and the reason.

    Attributes:
        name: name of the host.
        devices: arms before the sensors that they carry.
        why: reason, for operators.
        scene: the simulated scene's section, if they share one.
    """

    name: str
    devices: tuple[HostedDevice, ...]
    why: str
    scene: Mapping[str, Any] | None = None

    def rate_hz(self, control_hz: float) -> float:
        """Return the device cycles per second: the state rate of its arms, and at least twice the control rate."""
        reported = max((each.spec.capabilities.state_rate_hz for each in self.devices if each.is_arm), default=0.0)
        return max(2.0 * control_hz, min(reported, FASTEST_HZ))
