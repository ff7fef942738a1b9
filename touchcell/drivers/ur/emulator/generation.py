"""Generations of Universal Robots controllers: what differs on the wire between CB3, e-Series and PolyScope X.

Sources: Universal Robots, "Remote control via TCP/IP" (rates of the interfaces), "Dashboard server CB-Series" and
"Dashboard server e-Series" (commands and the versions that have them), "Real-Time Data Exchange (RTDE) Guide"
(variables), and the compatibility page of its client library (PolyScope X has no dashboard server before 10.11, and
no remote control to switch on). CB3 arms have no force-torque sensor and control at 125 Hz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Generation:
    """One generation of controllers.

    Attributes:
        version: its software, as major, minor, bugfix, build.
        models: arms that it drives, the usual one first.
        period_s: period of its control and shortest period of its state packets.
        has_dashboard: whether a dashboard server listens on port 29999.
        has_remote_control: whether scripts are taken in remote control only.
        unknown_outputs: state variables of the e-Series that it does not have.
        unknown_commands: dashboard commands of the e-Series that it does not have.
    """

    version: tuple[int, int, int, int]
    models: tuple[str, ...]
    period_s: float = 0.002
    has_dashboard: bool = True
    has_remote_control: bool = True
    unknown_outputs: frozenset[str] = frozenset()
    unknown_commands: frozenset[str] = frozenset()


_E_MODELS = ("ur5e", "ur3e", "ur10e", "ur16e")

GENERATIONS: Mapping[str, Generation] = MappingProxyType(
    {
        "cb3": Generation(
            version=(3, 15, 8, 106339),
            models=("ur5", "ur3", "ur10"),
            period_s=0.008,
            has_remote_control=False,
            unknown_outputs=frozenset({"ft_raw_wrench"}),
            unknown_commands=frozenset({"is in remote control", "get operational mode"}),
        ),
        "e": Generation(version=(5, 11, 1, 108249), models=_E_MODELS),
        "x": Generation(version=(10, 7, 0, 1), models=_E_MODELS, has_dashboard=False, has_remote_control=False),
    }
)
"""Generations by the name that ``touchcell emulate ur --generation`` takes."""
