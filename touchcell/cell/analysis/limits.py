"""Recorded quantities that interlocks watch, each beside its limit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_data import Run, Series, tip_points
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.control.interlocks.boundary import TiltConfig, WorkspaceConfig
from touchcell.geometry.types import Array

_CLOSE: Final = 0.7
_NAMED: Final = 3


@dataclass(frozen=True, slots=True)
class WatchedQuantity:
    """A quantity over time, and the limit that an interlock sets it.

    Attributes:
        interlock: name of the interlock in the cell file.
        subject: role of the arm or sensor.
        title: name of the quantity.
        unit: of its values.
        t_s: (n,) times since the start of the recording.
        values: (n,); NaN where it has none.
        limit: that trips. Values above it are beyond it.
        distance: whether values are distances beyond a boundary, negative inside; else they begin at zero.
    """

    interlock: str
    subject: str
    title: str
    unit: str
    t_s: Array
    values: Array
    limit: float
    distance: bool = False

    def closest(self) -> tuple[float, float] | None:
        """Return the largest value and its time; None without any."""
        if not np.isfinite(self.values).any():
            return None
        at = int(np.nanargmax(self.values))
        return float(self.values[at]), float(self.t_s[at])


@dataclass(frozen=True, slots=True)
class _Rule:
    kind: str
    leaf: str
    title: str
    unit: str
    limit: Callable[[Any], float]
    values: Callable[[Run, Series], Array]


def _age_ms(run: Run, contact: Series) -> Array:
    frame_s = (contact.column("t_frame_ns") - run.start_ns) * 1e-9
    age: Array = 1e3 * (contact.t_s - frame_s)
    return age


_RULES: Final = (
    _Rule("depth", "contact", "depth", "mm", lambda e: e.limit_mm, lambda _, s: s.column("z_mm")),
    _Rule(
        "shear",
        "contact",
        "shear",
        "mm",
        lambda e: e.limit_mm,
        lambda _, s: np.hypot(s.column("x_mm"), s.column("y_mm")),
    ),
    _Rule("torsion", "contact", "torsion", "deg", lambda e: e.limit_deg, lambda _, s: np.abs(s.column("gamma_deg"))),
    _Rule("uncertain", "contact", "σ of depth", "mm", lambda e: e.limit_mm, lambda _, s: s.column("sigma_z_mm")),
    _Rule("inconsistent", "contact", "NIS", "", lambda e: e.limit_nis, lambda _, s: s.column("nis")),
    _Rule("frame_age", "contact", "age of the frame", "ms", lambda e: e.limit_ms, _age_ms),
    _Rule("tcp_speed", "tcp", "tool speed", "mm/s", lambda e: 1e3 * e.limit_m_s, lambda _, s: s.column("speed_mm_s")),
)


def watched_quantities(run: Run, plan: CellPlan) -> Iterator[WatchedQuantity]:
    """Yield what is recorded of what the interlocks of a cell watch; nothing for kinds that no recording shows."""
    for name, entry in plan.cell.interlocks.items():
        if isinstance(entry, WorkspaceConfig):
            yield from _in_workspace(run, plan, name, entry)
        if isinstance(entry, TiltConfig):
            yield from _tilted(run, plan, name, entry)
        for rule in _RULES:
            if entry.kind != rule.kind:
                continue
            only = getattr(entry, "sensor", None) or getattr(entry, "arm", None)
            for role in run.roles("arms" if rule.leaf == "tcp" else "sensors", rule.leaf):
                series = run.series(f"/{'arms' if rule.leaf == 'tcp' else 'sensors'}/{role}/{rule.leaf}")
                if series is not None and only in (None, role):
                    values = rule.values(run, series)
                    yield WatchedQuantity(name, role, rule.title, rule.unit, series.t_s, values, rule.limit(entry))


def _in_workspace(run: Run, plan: CellPlan, name: str, entry: WorkspaceConfig) -> Iterator[WatchedQuantity]:
    series = run.series(f"/arms/{entry.arm}/tcp")
    if series is None:
        return
    mount = np.eye(4)
    if entry.sensor is not None and entry.sensor in plan.sensor_roles:
        mount = plan.cell.sensors[plan.sensor_roles[entry.sensor]].T_tcp_sensor
    points = 1e3 * (tip_points(series) @ mount)[:, :3, 3]
    beyond = np.maximum(np.array(entry.min_mm) - points, points - np.array(entry.max_mm)).max(axis=1)
    yield WatchedQuantity(name, entry.arm, "distance beyond the workspace", "mm", series.t_s, beyond, 0.0, True)


def _tilted(run: Run, plan: CellPlan, name: str, entry: TiltConfig) -> Iterator[WatchedQuantity]:
    series = run.series(f"/arms/{entry.arm}/tcp")
    if series is None:
        return
    axis = np.array([0.0, 0.0, 1.0])
    if entry.sensor is not None and entry.sensor in plan.sensor_roles:
        axis = plan.cell.sensors[plan.sensor_roles[entry.sensor]].T_tcp_sensor[:3, 2]
    direction = np.array(entry.direction) / np.linalg.norm(entry.direction)
    tilt_deg = np.degrees(np.arccos(np.clip(tip_points(series)[:, :3, :3] @ axis @ direction, -1.0, 1.0)))
    yield WatchedQuantity(name, entry.sensor or entry.arm, "tilt", "deg", series.t_s, tilt_deg, entry.limit_deg)


def close_calls(run: Run, plan: CellPlan) -> list[str]:
    """Return a line on what came close to its limit, the closest first; on what came closest where nothing did."""
    found = []
    for each in watched_quantities(run, plan):
        closest = each.closest()
        if closest is None or each.distance or each.limit <= 0.0:
            continue
        found.append((closest[0] / each.limit, each, closest))
    found.sort(key=lambda row: -row[0])
    near = [row for row in found if row[0] >= _CLOSE][:_NAMED]
    if near:
        return [f"close to a limit: {_described(*row)}" for row in near]
    return [f"nothing came close to a limit; closest: {_described(*found[0])}"] if found else []


def tripped_quantity(run: Run, plan: CellPlan, cause: Mapping[str, Any]) -> WatchedQuantity | None:
    """Return the quantity that a cause of a trip is about; None where no recording shows it."""
    rows = [each for each in watched_quantities(run, plan) if each.interlock == cause.get("interlock")]
    return next((each for each in rows if each.subject == cause.get("subject")), rows[0] if rows else None)


def _described(fraction: float, quantity: WatchedQuantity, closest: tuple[float, float]) -> str:
    value, t_s = closest
    unit = f" {quantity.unit}" if quantity.unit else ""
    return (
        f"{quantity.title} of {quantity.subject} {value:.3g} of {quantity.limit:.3g}{unit} "
        f"({100 * fraction:.0f} %, `{quantity.interlock}`, at {t_s:.2f} s)"
    )
