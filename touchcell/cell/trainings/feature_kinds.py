"""``touchcell train-sim --feature kinds``: a classifier of what the simulated sensor touches, and its confusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import CLASSES, FeatureModel, save_feature_model
from touchcell.perception.networks.feature_training import LabelledFields, train_features
from touchcell.simulation.feature_samples import feature_contacts
from touchcell.simulation.samples import USUAL_VARIATION
from touchcell.simulation.tip import Tip, TipParameters


def drawn(samples: int, seed: int) -> LabelledFields:
    """Return random contacts as displacements of the default tip's markers, the same for the same seed."""
    tip = Tip(TipParameters())
    rest = tip.project(tip.rest_positions)
    classes, pixels = zip(*feature_contacts(samples, seed, variation=USUAL_VARIATION), strict=True)
    return LabelledFields((np.stack(pixels) - rest).reshape(samples, -1), np.array(classes, np.int64))


def train_kinds(out: Path, *, samples: int, epochs: int | None, seed: int) -> str:
    """Train on ``samples`` contacts, validate on a fifth of that, write ``out``; return the table of confusion."""
    validation = drawn(max(samples // 5, 100), seed + 1_000_000)
    model = train_features(drawn(samples, seed), validation, epochs=epochs or 30, seed=seed)
    save_feature_model(model, out)
    return confusion_table(confusion(model, validation))


def confusion(model: FeatureModel, contacts: LabelledFields) -> Array:
    """Return (4, 4): mean probability of each class, columns, for contacts of each class, rows."""
    probabilities = model.probabilities(contacts.displacements)
    return np.stack([probabilities[contacts.classes == i].mean(axis=0) for i in range(len(CLASSES))])


def confusion_table(rows: Array) -> str:
    """Return a confusion matrix in per cent, a class in each row."""
    head = f"{'touched':10s}" + "".join(f"{name:>10s}" for name in CLASSES)
    body = [f"{name:10s}" + "".join(f"{100.0 * v:10.1f}" for v in row) for name, row in zip(CLASSES, rows, strict=True)]
    return "\n".join([head, *body])
