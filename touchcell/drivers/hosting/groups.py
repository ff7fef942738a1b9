"""Which devices live in a process together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from touchcell.drivers.core.protocols import SERVO_ARM, FrameSource, HealthSource, JointSource
from touchcell.drivers.core.spec import AnyDriver, DriverConfig

FASTEST_HZ: Final = 500.0
"""Device cycles per second of a host at most: a process in Python holds no more beside others."""

REMOTE_PROTOCOLS: Final = SERVO_ARM | {JointSource, FrameSource, HealthSource}
"""What devices can do for a task in another process."""


@dataclass(frozen=True, slots=True)
class HostedDevice:
    """A device that lives in a host.

    Attributes:
        name: in the cell.
        spec, config: of its driver.
        category: by which an arm stops when something is wrong; 0 for a camera.
        policy: what an arm does when it is given back; empty for a camera.
    """

    name: str
    spec: AnyDriver
    config: DriverConfig
    category: int = 0
    policy: str = ""

    @property
    def is_arm(self) -> bool:
        """Whether it is an arm."""
        return self.spec.capabilities.kind == "arm"


@dataclass(frozen=True, slots=True)
class Group:
    """Devices that share a host, and why.

    Attributes:
        name: of the host.
        devices: arms before the sensors that they carry.
        why: in words.
        scene: the simulated scene's section, if they share one.
    """

    name: str
    devices: tuple[HostedDevice, ...]
    why: str
    scene: Mapping[str, Any] | None = None

    def rate_hz(self, control_hz: float) -> float:
        """Device cycles per second: as often as its arms tell something new, and twice in a control period at least."""
        told = max((each.spec.capabilities.state_rate_hz for each in self.devices if each.is_arm), default=0.0)
        return max(2.0 * control_hz, min(told, FASTEST_HZ))
