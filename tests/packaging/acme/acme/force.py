"""An interlock: no reading ``force_n`` of a device exceeds a limit."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import PositiveFloat

from touchcell.control.interlocks.coverage import CellFacts, Fault, with_reading
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.geometry.types import Array


@dataclass(frozen=True)
class Force:
    name: str
    severity: Severity
    device: str
    limit_n: float

    def check(self, view: CellView) -> Violation | None:
        reading = view.devices[self.device].reading
        if reading is None or reading.value["force_n"] <= self.limit_n:
            return None
        reason = f"force is {reading.value['force_n']:.2f} N, limit {self.limit_n:g} N"
        return Violation(self.name, self.severity, self.device, reason, view.now_ns)


class ForceConfig(InterlockSettings):
    """Keys of the interlock."""

    kind: Literal["acme_force"]
    device: str
    limit_n: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        return Force(name, self.level, self.device, self.limit_n)

    def faults(self, facts: CellFacts) -> Iterator[Fault]:
        def pressed(view: CellView, t_s: float) -> CellView:
            return with_reading(view, self.device, force_n=1.1 * self.limit_n)

        def free(view: CellView, t_s: float) -> CellView:
            return with_reading(view, self.device, force_n=0.0)

        yield Fault(self.device, "pressed too hard", f"{self.limit_n:g} N", pressed, free)


SPEC = InterlockSpec("acme_force", "no force on a device exceeds a limit", ForceConfig)
