"""Rows of following and tracking: each with each estimator, some with truth sampled apart from what is declared."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final

REAL_TIP: Final = "franka_tactip_1"
"""Tip that was fitted to the images of a real sensor."""
REAL_TIP_MODEL: Final = "sim_franka_tactip_1"
"""Shipped model that was adapted to it (docs/decisions/0070-adapted-to-a-tip.md)."""
OTHER_TIP_MODEL: Final = "sim_gdn"
"""Shipped model that knows the default tip alone."""
SAMPLED: Final = "truth sampled"
"""Ends the names of rows in which nothing is quite what the controllers are told."""


def sampled_truth(sensor: str, arm: str, tip: str | None = None) -> dict[str, Any]:
    """Return a ``truth:`` section: another mount, slip law, camera and delay than the cell file declares.

    Args:
        sensor, arm: names in the cell file.
        tip: name or file of another tip than the network was trained on, with its own camera; without it the camera
            has moved a little.
    """
    camera = {"shift_px": [{"normal": [0, 0.3]}, {"normal": [0, 0.3]}]} if tip is None else {"tip": tip}
    return {
        "arms": {arm: {"latency_ms": {"uniform": [0, 10]}, "lag_ms": {"uniform": [2, 10]}}},
        "sensors": {
            sensor: {
                "mount_offset_mm_deg": [{"normal": [0, 0.2]}] * 3 + [{"normal": [0, 0.3]}] * 3,
                "latency_ms": {"uniform": [5, 20]},
                "noise": {"uniform": [1, 4]},
                "exposure": {"uniform": [0.9, 1.1]},
                **camera,
            }
        },
        "tip": {"slip_at_1mm_mm": {"uniform": [0.28, 0.4]}},
    }


def shape_rows(
    shapes: Collection[str],
    estimators: Mapping[str, Mapping[str, Any] | None],
    sampled: Collection[str],
    *,
    sensor: str,
    arm: str,
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield shape, row and changes of the cell file, of all shapes with each estimator and then with truth sampled.

    Args:
        shapes: by name.
        estimators: name of the row and ``estimator:`` section; None for that of the cell file.
        sampled: shapes that have a row with truth sampled, with the estimator of the cell file.
        sensor, arm: names in the cell file.
    """
    for estimator, section in estimators.items():
        for name in shapes:
            yield name, estimator, {} if section is None else {f"sensors.{sensor}.estimator": section}
    for name in shapes:
        if name in sampled:
            yield name, f"learned, {SAMPLED}", {"truth": sampled_truth(sensor, arm)}
