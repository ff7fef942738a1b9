"""``touchcell bench features``: what the shipped classifier takes contacts for, with its calibration and run time."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.trainings.feature_kinds import confusion_table, drawn
from touchcell.geometry.types import Array
from touchcell.paths import CLASSIFIERS
from touchcell.perception.features.feature_model import CLASSES, FeatureModel, load_feature_model
from touchcell.perception.networks.feature_training import LabelledFields

_SEED: Final = 424_242
_BINS: Final = 10
_TIMED: Final = 500


def run(arguments: Sequence[str], out: Path) -> None:
    """Print confusion, calibration and run time; write ``features.txt`` into ``out``. Raises ModelError."""
    parser = argparse.ArgumentParser(prog="touchcell bench features", description=__doc__)
    parser.add_argument("--model", type=Path, default=CLASSIFIERS / "sim_kinds.safetensors", help="classifier's file")
    parser.add_argument("--contacts", type=int, default=2000, help="random contacts (default: %(default)s)")
    options = parser.parse_args(arguments)
    model = load_feature_model(options.model)
    contacts = drawn(options.contacts, _SEED)
    probabilities = model.probabilities(contacts.displacements)
    right = probabilities.argmax(axis=1) == contacts.classes
    text = "\n".join(
        [
            f"{options.model.name}: {options.contacts} random contacts that it was not trained on; how often, per cent",
            confusion_table(likeliest_shares(probabilities, contacts)),
            f"right: {100.0 * right.mean():.1f} %; "
            f"expected calibration error {100.0 * miscalibration(probabilities, right):.1f} %",
            f"time: {1e6 * _seconds(model, contacts):.0f} us a frame",
        ]
    )
    print(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / "features.txt").write_text(f"{_about()}\n{text}\n")


def _about() -> str:
    return "touchcell bench features; " + ", ".join(f"{key} {value}" for key, value in provenance().items())


def likeliest_shares(probabilities: Array, contacts: LabelledFields) -> Array:
    """Return (4, 4): the share of contacts of each class, rows, that each class is the likeliest for, columns."""
    taken = np.eye(len(CLASSES))[probabilities.argmax(axis=1)]
    return np.stack([taken[contacts.classes == i].mean(axis=0) for i in range(len(CLASSES))])


def miscalibration(probabilities: Array, right: Array) -> float:
    """Return the expected calibration error: mean gap between the largest probability and how often it is right."""
    largest = probabilities.max(axis=1)
    bins = np.minimum((largest * _BINS).astype(int), _BINS - 1)
    gaps = [
        (bins == i).mean() * abs(largest[bins == i].mean() - right[bins == i].mean())
        for i in range(_BINS)
        if (bins == i).any()
    ]
    return float(sum(gaps))


def _seconds(model: FeatureModel, contacts: LabelledFields) -> float:
    durations = []
    for i in range(_TIMED):
        frame = contacts.displacements[i % len(contacts.displacements)]
        start = time.perf_counter()
        model.touched(frame)
        durations.append(time.perf_counter() - start)
    return float(np.median(durations))
