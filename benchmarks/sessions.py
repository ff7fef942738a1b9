"""Whether sigmas hold in a session that neither chose the epoch nor calibrated them: marker models of the public data.

A marker model is trained on four in five images of ``train``; the fifth part chooses the epoch and calibrates sigma.
``val`` is another session. It is judged as it is, with the sigmas calibrated again on every second of its images and
judged on the others, and each with camera and skin drifted: images shifted, zoomed and turned, displacements larger or
smaller. Images of the public splits are sorted by depth, so that a part set aside takes every n-th of them.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.bench.perception_bands import band_lines, summaries, write_reliability_by_band
from touchcell.cell.bench.provenance import provenance
from touchcell.drivers.replay.dataset import Split, read_split
from touchcell.geometry.types import Array
from touchcell.perception.markers.detection import Discs, detect_markers
from touchcell.perception.markers.estimator import MarkerEstimator
from touchcell.perception.markers.matching import MarkerField
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerSize
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.marker_training import (
    LabelledDiscs,
    MarkerSettings,
    preprocessing_and_size,
    train_on_discs,
)
from touchcell.perception.networks.scores import Scores
from touchcell.perception.networks.sigma_scaling import calibration

_ASIDE: Final = 5
_DRIFTS: Final = 3
_SHIFT_PX, _ZOOM, _TURN_DEG, _SKIN = 0.5, 0.001, 0.1, 0.02


def run(arguments: Sequence[str], out: Path) -> None:
    """Train, judge, print the tables, and write ``sessions.txt``, ``sessions.json`` and the plots."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks sessions")
    parser.add_argument("--data", type=Path, required=True, help="data set with train and val of two sessions")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=MarkerSettings().epochs)
    parser.add_argument("--work", type=Path, default=Path("runs/sessions"), help="for models and matched markers")
    options = parser.parse_args(arguments)
    out.mkdir(parents=True, exist_ok=True)
    options.work.mkdir(parents=True, exist_ok=True)
    splits = {name: read_split(options.data, name) for name in ("train", "val")}
    preprocessing, size = preprocessing_and_size(splits["train"].read())
    sets = {name: _discs(split, preprocessing, size) for name, split in splits.items()}
    aside = np.arange(len(sets["train"].frames)) % _ASIDE == _ASIDE - 1
    pooled: dict[str, list[Scores]] = {}
    for seed in range(options.seeds):
        model = train_on_discs(
            _some(sets["train"], ~aside),
            _some(sets["train"], aside),
            options.work / f"session_{seed}.safetensors",
            preprocessing=preprocessing,
            size=size,
            settings=MarkerSettings(epochs=options.epochs, seed=seed),
            cache=options.work,
        )
        for name, scores in judged(model, sets["val"], seed).items():
            pooled.setdefault(name, []).append(scores)
    found = {name: summaries(joined(each)) for name, each in pooled.items()}
    lines = [f"{options.data}: {options.seeds} models of {options.epochs} epochs"]
    for name, rows in found.items():
        mae = ", ".join(f"{key} {value:.3f}" for key, value in rows["all"]["mae"].items())
        lines += [*band_lines(name, rows), f"MAE: {mae}"]
    print("\n".join(lines))
    (out / "sessions.txt").write_text("\n".join(lines) + "\n")
    (out / "sessions.json").write_text(json.dumps({"provenance": provenance(), "rows": found}, indent=1) + "\n")
    for number, (name, rows) in enumerate(found.items(), 1):
        write_reliability_by_band(out / f"sessions_{number}.png", name, rows)


def judged(model: Model, other: LabelledDiscs, seed: int) -> dict[str, Scores]:
    """Return the scores of a model on another session: as it is, calibrated on half of it, and each drifted."""
    fields = _fields(model, other.frames)
    contacts = contact_from_xi(other.xi)
    half = np.arange(len(fields)) % 2 == 1
    again = recalibrated(model, [field for field, kept in zip(fields, half, strict=True) if kept], other.xi[half])
    rest = _some(other, ~half)
    rng = np.random.default_rng(seed)
    found: dict[str, list[Scores]] = {}
    plain = [field for field, kept in zip(fields, half, strict=True) if not kept]
    found["another session"] = [_scored(model, fields, contacts)]
    found["calibrated on one half of it, the other half"] = [_scored(again, plain, contacts[~half])]
    for _ in range(_DRIFTS):
        skin = 1.0 + rng.normal(0.0, _SKIN)
        moved = _fields(model, _drifted(rest.frames, model.header.preprocessing.output_size, rng))
        moved = [dataclasses.replace(field, displacements=skin * field.displacements) for field in moved]
        found.setdefault("another session, drifted", []).append(_scored(model, moved, contacts[~half]))
        name = "calibrated on one half of it, the other half drifted"
        found.setdefault(name, []).append(_scored(again, moved, contacts[~half]))
    return {name: joined(each) for name, each in found.items()}


def recalibrated(model: Model, fields: Sequence[MarkerField], xi: Array) -> Model:
    """Return the model with sigmas that are calibrated on other contacts (n, 6), m and rad, as a training does."""
    estimator, labels = MarkerEstimator(model), model.header.labels
    told = [estimator.infer(field) for field in fields]
    mean, sigma = np.stack([each[0] for each in told]), np.stack([each[1] for each in told])
    calibrated = calibration(labels, mean, sigma, labels.targets(xi))
    return dataclasses.replace(model, header=model.header.model_copy(update=calibrated))


def joined(scores: Sequence[Scores]) -> Scores:
    """Return scores of several models or drifts as one."""
    first = scores[0]
    return Scores(
        np.concatenate([each.contact_mm_deg for each in scores]),
        np.concatenate([each.xi for each in scores]),
        np.concatenate([each.covariance for each in scores]),
        np.concatenate([each.in_range for each in scores]),
        first.tail_scale,
    )


def _scored(model: Model, fields: Sequence[MarkerField], contacts: Array) -> Scores:
    estimator = MarkerEstimator(model)
    return Scores.of(contacts, [estimator.decode(field, *estimator.infer(field)) for field in fields])


def _fields(model: Model, frames: Sequence[Discs]) -> list[MarkerField]:
    estimator = MarkerEstimator(model)
    return [estimator.match(discs) for discs in frames]


def _drifted(frames: Sequence[Discs], size: tuple[int, int], rng: np.random.Generator) -> list[Discs]:
    """Return discs as a camera that has moved a little sees them."""
    height, width = size
    middle = complex(width / 2.0, height / 2.0)
    factor = (1.0 + rng.normal(0.0, _ZOOM)) * np.exp(1j * np.radians(rng.normal(0.0, _TURN_DEG)))
    shift = complex(*rng.normal(0.0, _SHIFT_PX, 2))
    moved = []
    for discs in frames:
        flat = (discs.centres @ np.array([1.0, 1.0j]) - middle) * factor + middle + shift
        moved.append(Discs(np.column_stack([flat.real, flat.imag]), discs.areas))
    return moved


def _some(contacts: LabelledDiscs, chosen: NDArray[np.bool_]) -> LabelledDiscs:
    return LabelledDiscs([contacts.frames[i] for i in np.flatnonzero(chosen)], contacts.xi[chosen])


def _discs(split: Split, preprocessing: Preprocessing, size: MarkerSize) -> LabelledDiscs:
    frames = [detect_markers(preprocessing.reduce(image), size) for image in split.read()]
    return LabelledDiscs(frames, xi_from_contact(split.contact_mm_deg))
