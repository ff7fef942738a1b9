"""Decorator for checks of the conformance suite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from touchcell.drivers.core.commands import C
from touchcell.testing.emulation.rig import DeviceFixture

Circumstance = Literal["arm", "camera", "truth", "process", "reachable", "limited axes"]
"""A kind of device, or what has to hold for it beside its protocols."""


@dataclass(frozen=True, slots=True)
class Needs:
    """Preconditions of a check.

    Attributes:
        needs: Protocols that the device provides, and "arm", "camera", "truth" (an emulator), "process" (an emulator of
            its own), "reachable" (by other processes), "limited axes".
        on_hardware: whether it may run on a real device.
        of_faults: chooses among the rig's faults, by name, value and expected reaction, those for which it runs;
            None for a check without faults.
    """

    needs: tuple[type | Circumstance, ...]
    on_hardware: bool
    of_faults: Callable[[str, Any, str], bool] | None

    def missing(self, rig: DeviceFixture) -> str | None:
        """Return why the check does not apply to ``rig``, or None."""
        capabilities = rig.spec.capabilities
        if rig.start is None and not self.on_hardware:
            return "not run on a real device"
        for need in self.needs:
            if isinstance(need, type):
                if need not in capabilities.provides:
                    return f"its capability record does not name {need.__name__}"
            elif need in ("arm", "camera"):
                if capabilities.kind != need:
                    return f"no {need}"
            elif need == "truth":
                if rig.start is None:
                    return "a real device has no ground truth besides its own measurements"
            elif need == "process":
                if not rig.process:
                    return "simulated in the client's own process: it cannot vanish or hang while the client runs"
            elif need == "reachable":
                if not rig.reachable:
                    return "emulated in the client's own process: no other client can use it"
            elif all(capabilities.twist_axes):
                return "follows all six axes"
        return None


def check(
    *needs: type | Circumstance, on_hardware: bool = False, of_faults: Callable[[str, Any, str], bool] | None = None
) -> Callable[[C], C]:
    """Mark a function of a ``ConformanceContext`` (and a fault's name) as a check of the suite; see ``Needs``."""

    def mark(function: C) -> C:
        function.conformance = Needs(needs, on_hardware, of_faults)  # type: ignore[attr-defined]
        return function

    return mark
