"""False accepts and false rejects of estimators over changed camera frames, for ``touchcell bench perception``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchcell.cell.bench.perception_changes import CHANGES
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.camera_frames import served_from_camera
from touchcell.perception.models.model_file import load_model
from touchcell.perception.runtime.estimators import calibrated

_SEED = 7


def validity(path: Path, frames: Sequence[ImageArray], contact_mm_deg: Array) -> list[dict[str, Any]]:
    """Return one row for each change: what share of the frames the model accepts, and its errors on them.

    Args:
        path: model file.
        frames: grey camera frames, or images of the size that the model was trained on.
        contact_mm_deg: (n, 6) their labels.
    """
    model = load_model(path)
    if frames[0].shape != model.header.preprocessing.input_size:
        model = served_from_camera(model)
    rows = []
    for change in CHANGES:
        # A new estimator each time, so that no match starts from that of the previous change.
        estimator = calibrated(model)
        accepted, errors = [], []
        for i, frame in enumerate(frames):
            other = frames[(i + len(frames) // 3) % len(frames)]
            changed = change.apply(frame, other, np.random.default_rng((_SEED, i)))
            prediction = estimator.predict(changed)
            accepted.append(prediction.in_range)
            errors.append(np.abs(prediction.pose_mm_deg - contact_mm_deg[i]))
        chosen = np.array(errors)[np.array(accepted)]
        rows.append(
            {
                "change": change.name,
                "wanted": change.wanted,
                "frames": len(frames),
                "accepted": float(np.mean(accepted)),
                "mae_accepted": chosen.mean(axis=0).tolist() if len(chosen) else None,
            }
        )
    return rows


def totals(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the share of frames accepted though they should be refused, and refused though they should be kept."""
    refused = [row["accepted"] for row in rows if row["wanted"] == "refuse"]
    kept = [row["accepted"] for row in rows if row["wanted"] == "keep"]
    return float(np.mean(refused)), float(1.0 - np.mean(kept))


def validity_lines(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterator[str]:
    """Yield the lines of the table, one column for each model."""
    if not found:
        return
    first = next(iter(found.values()))
    yield f"\nchanged camera frames, {first[0]['frames']} for each change: accepted, %"
    yield f"{'':<32}{'wanted':<9}" + "".join(f"{name:>16}" for name in found)
    for i, row in enumerate(first):
        cells = "".join(f"{100.0 * rows[i]['accepted']:>16.1f}" for rows in found.values())
        yield f"{row['change']:<32}{row['wanted']:<9}{cells}"
    sums = [totals(rows) for rows in found.values()]
    yield f"{'falsely accepted':<41}" + "".join(f"{100.0 * accepted:>16.2f}" for accepted, _ in sums)
    yield f"{'falsely refused':<41}" + "".join(f"{100.0 * refused:>16.2f}" for _, refused in sums)
