"""Cells of experiments with shapes whose truth is sampled apart from what their controllers are told."""

from __future__ import annotations

from typing import Any, Final

SAMPLED: Final = "truth sampled"
"""Ends the names of rows in which nothing is quite what the controllers are told."""


def sampled_truth(sensor: str, arm: str) -> dict[str, Any]:
    """Return a ``truth:`` section: another mount, slip law, camera and delay than the cell file tells."""
    return {
        "arms": {arm: {"latency_ms": {"uniform": [0, 10]}, "lag_ms": {"uniform": [2, 10]}}},
        "sensors": {
            sensor: {
                "mount_offset_mm_deg": [{"normal": [0, 0.2]}] * 3 + [{"normal": [0, 0.3]}] * 3,
                "latency_ms": {"uniform": [5, 20]},
                "noise": {"uniform": [1, 4]},
                "exposure": {"uniform": [0.9, 1.1]},
                "shift_px": [{"normal": [0, 0.3]}, {"normal": [0, 0.3]}],
            }
        },
        "tip": {"slip_at_1mm_mm": {"uniform": [0.28, 0.4]}},
    }
