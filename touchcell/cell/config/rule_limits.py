"""Limits of a cell's interlocks, by kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan


def limits_of(plan: CellPlan, kind: str, key: str) -> Mapping[str, float]:
    """Limit of each interlock of ``kind``, by the name of the interlock."""
    entries = {name: entry for name, entry in plan.cell.interlocks.items() if is_kind(entry, kind)}
    return {name: float(getattr(entry, key)) for name, entry in entries.items()}


def is_kind(entry: Any, kind: str) -> bool:
    return bool(getattr(entry, "kind", "") == kind)
