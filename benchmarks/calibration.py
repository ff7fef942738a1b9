"""``touchcell bench calibration``: cost of another camera, and recovery by zero-frame calibration.

Every n-th validation image is zoomed, rotated and shifted; so are the shallowest ones, which stand for images out of
contact. Where the model holds no lattice and no image out of contact, the shallowest training images stand for those.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from touchcell.drivers.replay.dataset import read_image, read_split
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.zero_frame import find_change
from touchcell.perception.models.labels import contact_from_xi
from touchcell.perception.models.model_file import load_model
from touchcell.perception.models.prediction import ContactEstimator
from touchcell.perception.runtime.calibrated_estimator import CalibratedEstimator
from touchcell.perception.runtime.estimators import load_estimator

_CHANGES = {
    "none": (1.0, 0.0, 0.0),
    "zoom 1 %": (1.01, 0.0, 0.0),
    "turn 1 deg": (1.0, 1.0, 0.0),
    "shift 4 px": (1.0, 0.0, 4.0),
    "zoom 3 %, turn 2 deg, shift 5 px": (1.03, 2.0, 5.0),
    "zoom 30 %": (1.3, 0.0, 0.0),
}
_SHALLOWEST = 20
_ORDER = (2, 3, 4, 0, 1, 5)


def run(arguments: Sequence[str], out: Path) -> None:
    """Measure, print, and write ``calibration.md``."""
    parser = argparse.ArgumentParser("touchcell bench calibration")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, action="append", required=True, help="may be given several times")
    parser.add_argument("--every", type=int, default=5, help="each so-many-th validation image")
    options = parser.parse_args(arguments)
    validation, training = read_split(options.data, "val"), read_split(options.data, "train")
    chosen = range(0, len(validation.images), options.every)
    images = [read_image(validation.images[i]) for i in chosen]
    labels = validation.contact_mm_deg[list(chosen)]
    zero = [read_image(validation.images[i]) for i in shallowest(validation.contact_mm_deg)]
    taught = [read_image(training.images[i]) for i in shallowest(training.contact_mm_deg)]
    table = Table(title=f"MAE on {len(images)} validation images, mm and deg")
    for name in ("model", "camera", "calibrated", "z", "alpha", "beta", "x", "y", "gamma", "in range"):
        table.add_column(name, justify="left" if name in ("model", "camera") else "right")
    lines = ["| model | camera | calibrated | z | alpha | beta | x | y | gamma | in range |", "|---" * 10 + "|"]
    for path in options.model:
        model = load_model(path)
        before = () if "lattice" in model.tensors or model.reference is not None else taught
        for name, (zoom, turn_deg, shift_px) in _CHANGES.items():
            seen = [changed(image, zoom, turn_deg, shift_px) for image in images]
            rows = [("no", load_estimator(path))]
            try:
                change = find_change(model, [changed(i, zoom, turn_deg, shift_px) for i in zero], taught=before)
            except TrainingError as error:
                note = str(error).split(";")[0]
            else:
                note = f"{change.zoom:.4f}, {change.turn_deg:.2f} deg"
                rows.append((note, CalibratedEstimator(load_estimator(path), change)))
            if len(rows) == 1:
                rows[0] = (f"refused: {note}", rows[0][1])
            for how, estimator in rows:
                mae, in_range = _errors(estimator, seen, labels)
                row = [path.stem, name, how, *(f"{mae[i]:.3f}" for i in _ORDER), f"{100 * in_range:.1f} %"]
                table.add_row(*row)
                lines.append("| " + " | ".join(row) + " |")
    Console(width=150).print(table)
    (out / "calibration.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def shallowest(contact_mm_deg: Array) -> list[int]:
    """Return the indices of the images with the least depth."""
    return [int(i) for i in np.argsort(contact_mm_deg[:, 2])[:_SHALLOWEST]]


def changed(image: ImageArray, zoom: float, turn_deg: float, shift_px: float) -> ImageArray:
    """Return a black and white image as another camera would have taken it."""
    height, width = image.shape
    matrix = cv2.getRotationMatrix2D((width / 2.0, height / 2.0), turn_deg, zoom)
    matrix[:, 2] += shift_px / np.sqrt(2.0)
    warped = np.asarray(cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR), dtype=np.uint8)
    return np.where(warped > 127, np.uint8(255), np.uint8(0))


def _errors(estimator: ContactEstimator, images: Sequence[ImageArray], labels: Array) -> tuple[Array, float]:
    predictions = [estimator.predict(image) for image in images]
    found = contact_from_xi(np.stack([each.xi for each in predictions]))
    mae: Array = np.abs(found - labels).mean(axis=0)
    return mae, float(np.mean([each.in_range for each in predictions]))
