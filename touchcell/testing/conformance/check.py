"""Decorator for checks of the conformance suite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchcell.drivers.core.commands import C
from touchcell.testing.emulation.rig import DeviceFixture


@dataclass(frozen=True, slots=True)
class Needs:
    """Preconditions of a check.

    Attributes:
        needs: abilities, "arm", "camera", "truth" (an emulator), "process" (an emulator process), "limited axes".
        on_hardware: whether it may run on a real device.
        of_faults: selects the faults of the device fixture, by name, value and expected reaction, for which it runs;
            None for a check without faults.
    """

    needs: tuple[str, ...]
    on_hardware: bool
    of_faults: Callable[[str, Any, str], bool] | None

    def missing(self, rig: DeviceFixture) -> str | None:
        """Return why the check does not apply to ``rig``, or None."""
        capabilities = rig.spec.capabilities
        if rig.start is None and not self.on_hardware:
            return "not run on a real device"
        for need in self.needs:
            if need in ("arm", "camera"):
                if capabilities.kind != need:
                    return f"no {need}"
            elif need == "truth":
                if rig.start is None:
                    return "a real device has no ground truth besides its own measurements"
            elif need == "process":
                if not rig.process:
                    return "simulated in the client's own process: it cannot vanish or hang while the client runs"
            elif need == "limited axes":
                if all(capabilities.twist_axes):
                    return "follows all six axes"
            elif need not in capabilities.abilities:
                return f"its capability record does not name {need}"
        return None


def check(
    *needs: str, on_hardware: bool = False, of_faults: Callable[[str, Any, str], bool] | None = None
) -> Callable[[C], C]:
    """Mark a function of a ``ConformanceContext`` (and a fault's name) as a check of the suite; see ``Needs``."""

    def mark(function: C) -> C:
        function.conformance = Needs(needs, on_hardware, of_faults)  # type: ignore[attr-defined]
        return function

    return mark
