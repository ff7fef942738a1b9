"""An interlock of one's own: a pure rule over a snapshot of the cell, tried on data before any arm moves."""

from dataclasses import dataclass

import numpy as np

from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.samples import Stamped, TcpState


@dataclass(frozen=True)
class Ceiling:
    """No arm's tool rises above ``limit_m`` in its base frame."""

    limit_m: float
    name: str = "ceiling"
    severity: Severity = Severity.TRIP

    def check(self, view: CellView) -> Violation | None:
        for role, arm in view.arms.items():
            z_m = float(arm.state.value.T_base_tcp[2, 3])
            if z_m > self.limit_m:
                reason = f"tool at z = {1e3 * z_m:.0f} mm, limit {1e3 * self.limit_m:.0f} mm"
                return Violation(self.name, self.severity, role, reason, view.now_ns, z_m, self.limit_m, "m")
        return None


def at_height(z_m: float) -> CellView:
    """A cell whose one arm has its tool at ``z_m``."""
    T_base_tcp = np.eye(4)
    T_base_tcp[2, 3] = z_m
    return CellView(0, {"arm": ArmView(Stamped(TcpState(T_base_tcp, np.zeros(6)), 0, 0))})


supervisor = Supervisor([Ceiling(limit_m=0.5)], Latch())
for height_m in (0.4, 0.6, 0.4):  # the trip is latched: coming back down does not clear it
    verdict = supervisor.review(at_height(height_m))
    print(f"z {height_m} m: motion {'allowed' if verdict.allow else f'stopped: {verdict.trip}'}")
