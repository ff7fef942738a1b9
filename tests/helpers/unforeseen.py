"""Cells that `touchcell check` accepts although their runs trip or fail: what they touch moves, by a micrometre."""

from __future__ import annotations

from typing import Any

_SWAYS = {"kind": "periodic", "amplitude_mm_deg": [0, 0, 0.001, 0, 0, 0], "period_s": 10}


def sway(data: dict[str, Any]) -> dict[str, Any]:
    """Let the surfaces of a cell move, so that nobody knows before where they lead; returns the changed cell."""
    for surface in data["scene"]["surfaces"].values():
        surface["motion"] = dict(_SWAYS)
    return data


def run_into_the_wall(data: dict[str, Any]) -> None:
    """End the workspace of ``surface_follow_sim`` 8 mm after its start, and its way later."""
    data["interlocks"]["workspace"]["max_mm"] = [-72, 50, 150]
    data["task"]["distance_mm"] = 30
    sway(data)
