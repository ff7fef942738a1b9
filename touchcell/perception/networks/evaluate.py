"""Evaluate a model on a split of a data set: errors, likelihood, calibration and time per frame."""

from __future__ import annotations

import json
import os
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from touchcell.drivers.core.clock import Clock, MonotonicClock
from touchcell.drivers.replay.dataset import read_split
from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import ImageError
from touchcell.perception.models.labels import CONTACT_NAMES
from touchcell.perception.models.prediction import ContactEstimator, Prediction
from touchcell.perception.networks.dataset import ProgressCallback
from touchcell.perception.networks.scores import SCORE_NAMES, Scores
from touchcell.perception.runtime.estimators import load_estimator

if TYPE_CHECKING:
    from rich.console import Console

_OUT_OF_RANGE = "beyond the contacts that were taught"
_FEW_ACCEPTED = 0.95
_COVERAGE = {"68": 0.68, "95": 0.95}


@dataclass(frozen=True)
class Evaluation:
    """Results of a model on a split.

    Attributes:
        n: number of images.
        mae: mean absolute error of each component of the contact, mm or degrees.
        nll: mean negative log-likelihood of xi under the predicted Gaussian, summed over its components, in nats per
            image with xi in mm and degrees.
        latency_ms: ``median`` and ``p99`` of the time from a decoded image to its prediction, on one thread.
        mae_of_median: of predicting, for each image, the median of the split's own labels.
        accepted: fraction of the images that show the contact as the model's camera would, within the taught range.
        refusals: for each reason why images were not accepted, their number.
        coverage: for ``68`` and ``95`` percent, the fraction of labels of each component of xi that lie in the central
            interval of the predicted Gaussian; the components of xi are the contact's, seen from the surface's side.
    """

    n: int
    mae: dict[str, float]
    nll: float
    latency_ms: dict[str, float]
    mae_of_median: dict[str, float]
    accepted: float
    refusals: dict[str, int]
    coverage: dict[str, dict[str, float]]

    def to_json(self) -> str:
        """Return one JSON object with the attributes as keys."""
        return json.dumps(asdict(self), indent=2) + "\n"

    def write(self, path: Path) -> None:
        """Write ``to_json`` to a file atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            unfinished = Path(scratch) / path.name
            unfinished.write_text(self.to_json(), encoding="utf-8")
            os.replace(unfinished, path)


def evaluate(
    data: Path,
    split: str,
    model: Path,
    *,
    calibration: Path | None = None,
    deeper_than_mm: float | None = None,
    clock: Clock | None = None,
    progress: ProgressCallback | None = None,
) -> Evaluation:
    """Predict every image of a split one by one, as at run time, and compare with the labels.

    Errors are of all images, accepted or not.

    Args:
        data: data set, see ``touchcell.drivers.replay.dataset``.
        split: train, val or test.
        model: model file.
        calibration: of the camera, see ``load_estimator``.
        deeper_than_mm: leave out shallower contacts.
        clock: measures the latency; None for the machine's.
        progress: called with the images done and the total.

    Raises:
        DataError: the data set is damaged.
        ModelError: the model file is damaged.
        ImageError: the images do not match the model.
    """
    clock = clock or MonotonicClock()
    labelled = read_split(data, split)
    if deeper_than_mm is not None:
        labelled = labelled.deeper_than(deeper_than_mm)
    contact_model = load_estimator(model, calibration)
    n = len(labelled.images)
    predictions: list[Prediction] = []
    latencies_ns = np.empty(n)
    with one_opencv_thread():
        for i, image in enumerate(labelled.read()):
            if i == 0:
                _first(contact_model, image, data, model)
            start_ns = clock.now_ns()
            predictions.append(contact_model.predict(image))
            latencies_ns[i] = clock.now_ns() - start_ns
            if progress is not None:
                progress(i + 1, n)
    scores = Scores.of(labelled.contact_mm_deg, predictions)
    median = np.abs(labelled.contact_mm_deg - np.median(labelled.contact_mm_deg, axis=0)).mean(axis=0)
    refusals = Counter(each.refusal or _OUT_OF_RANGE for each in predictions if not each.in_range)
    return Evaluation(
        n=n,
        mae=scores.mae(),
        nll=float(scores.nll.mean()),
        latency_ms={
            "median": float(np.median(latencies_ns)) * 1e-6,
            "p99": float(np.percentile(latencies_ns, 99)) * 1e-6,
        },
        mae_of_median={name: float(median[CONTACT_NAMES.index(name)]) for name in SCORE_NAMES},
        accepted=float(scores.in_range.mean()),
        refusals=dict(refusals.most_common()),
        coverage={percent: scores.coverage(share) for percent, share in _COVERAGE.items()},
    )


def _first(estimator: ContactEstimator, image: ImageArray, data: Path, model: Path) -> None:
    """Predict once, as the first run also allocates memory; say what to do with images that the model does not read."""
    try:
        estimator.predict(image)
    except ImageError as error:
        what = f"{model.stem} is for another camera or crop, and its contacts mean nothing here"
        hint = f"{what}; {_remedy(estimator, data)}"
        raise ImageError(error.attribute, error.expected, error.found, hint=hint) from error


def _remedy(estimator: ContactEstimator, data: Path) -> str:
    header = estimator.header
    if header.architecture.kind != "markers":
        return f"an image network sees one camera only: `touchcell train --data {data} --out NAME.safetensors`"
    if header.camera is not None:
        return "it was adapted to its own sensor: use `touchcell adapt` with the model that it came from"
    return f"`touchcell adapt --data {data}` brings it to this one, by ten labelled images or more"


def print_table(evaluation: Evaluation, console: Console | None = None) -> None:
    """Print an evaluation as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{evaluation.n} images")
    table.add_column("")
    for name in evaluation.mae:
        table.add_column(name, justify="right")
    table.add_row("MAE", *(f"{error:.3f}" for error in evaluation.mae.values()))
    table.add_row("MAE of the median label", *(f"{error:.3f}" for error in evaluation.mae_of_median.values()))
    for percent, fractions in evaluation.coverage.items():
        table.add_row(f"within {percent} %", *(f"{100.0 * fractions[name]:.1f} %" for name in evaluation.mae))
    console = console or Console()
    console.print(table)
    latency = evaluation.latency_ms
    console.print(
        f"NLL {evaluation.nll:.3f} nats per image (mm, deg); "
        f"{latency['median']:.2f} ms per image (median), {latency['p99']:.2f} ms (99 %)",
        soft_wrap=True,
    )
    console.print(f"{100.0 * evaluation.accepted:.1f} % of the images accepted", soft_wrap=True)
    for line in warnings_of(evaluation):
        console.print(f"warning: {line}", soft_wrap=True, highlight=False, markup=False)


def warnings_of(evaluation: Evaluation) -> list[str]:
    """Return what speaks against using this model with this sensor, a sentence each."""
    found = []
    if evaluation.accepted < _FEW_ACCEPTED:
        found = [f"{count} images not accepted: {reason}" for reason, count in evaluation.refusals.items()]
    useless = [name for name, error in evaluation.mae.items() if error >= evaluation.mae_of_median[name]]
    if useless:
        found.append(
            f"{', '.join(useless)}: no better than the median of the labels; is it another sensor, or are its labels "
            "about other axes? `touchcell adapt` finds the convention"
        )
    return found


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Limit OpenCV to one thread, as at run time, inside a ``with`` block."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
