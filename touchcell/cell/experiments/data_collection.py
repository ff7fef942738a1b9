"""Data collection (paper 5.2, Algorithm 1): varied contacts with a plane, training on them, and evaluation.

The labels are the commanded contacts, as in the public data; the simulator knows how much of them slipped, so the table
also shows the distance between labels and true contacts. Training needs the extra ``train``.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, true_contacts
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import COLLECTED, Finished, Trial
from touchcell.drivers.replay.dataset import read_split
from touchcell.geometry.types import Array

SENSOR = "sensor"
_MODEL = "model.safetensors"
# The estimator that performs best on few images, trained in a minute.
_KIND: Literal["markers"] = "markers"
# Below this depth most of a shear slips (docs/glossary.md); the public models are evaluated above it as well.
_DEEP_MM = 3.0


def trials(scale: Scale) -> list[Trial]:
    """Return trials of a thousand samples, a fifth of that when quick; each repetition draws others."""
    samples = 200 if scale.quick else 1000
    return [
        Trial(f"collect_{samples}_{seed}", "plane", "collect_sim.yaml", {"task.samples": samples, "task.seed": seed})
        for seed in range(1, scale.repetitions(1) + 1)
    ]


def measure(trial: RunFolder) -> Mapping[str, float]:
    """Return number and rate of samples, distance of labels from true contacts, and a trained model's errors."""
    data = trial.path / COLLECTED
    labels = np.concatenate([read_split(data, split).contact_mm_deg for split in ("train", "val")])
    task = trial.recording.series("/task")
    assert task is not None
    found = {"samples": float(len(labels)), "seconds_each": float(np.ptp(task.t_s)) / len(labels)}
    commanded, actual = _grabbed(trial)
    slipped = np.linalg.norm(commanded[:, :2] - actual[:, :2], axis=1)
    deep = actual[:, 2] > _DEEP_MM
    found |= {"slip_mm": float(slipped[~deep].mean()), "slip_deep_mm": float(slipped[deep].mean())}
    return found | _learned(trial.path, data)


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot some of the frames with their labels, and the model's predictions of the validation images."""
    from touchcell.cell.experiments.collection_plots import plot_samples

    first = finished[0].folder.path
    pictures = [plot_samples(read_split(first / COLLECTED, "train"), folder / "samples.png")]
    predictions = (first / _MODEL).with_name("model_predictions.png")
    if predictions.exists():
        pictures.append(Path(shutil.copyfile(predictions, folder / "predictions.png")))
    return pictures


def _grabbed(trial: RunFolder) -> tuple[Array, Array]:
    """Return contacts (n, 6) commanded and true at the end of each grab."""
    asked = trial.recording.series(f"/sensors/{SENSOR}/contact")
    series, actual = true_contacts(trial, SENSOR)
    assert asked is not None
    grabs = trial.recording.during(series.t_s, "grab")
    last = np.flatnonzero(grabs[:-1] & ~grabs[1:])
    return asked.poses()[: len(actual)][last], actual[last]


def _learned(folder: Path, data: Path) -> dict[str, float]:
    """Return errors of a model trained on the collection; empty where PyTorch is not installed."""
    if importlib.util.find_spec("torch") is None:
        return {}
    from rich.console import Console

    from touchcell.perception.networks.evaluate import evaluate
    from touchcell.perception.networks.progress import Display
    from touchcell.perception.networks.trainer import train

    with (folder / "training.txt").open("w") as log, Display(Console(file=log)) as display:
        train(data, folder / _MODEL, kind=_KIND, cache=folder / "cache", observer=display)
    result = evaluate(data, "val", folder / _MODEL)
    return {f"mae_{name}": error for name, error in result.mae.items()}


SPEC = ExperimentSpec(
    name="data_collection",
    summary="Algorithm 1 over a plane; the marker estimator, trained on three quarters of it and evaluated on the rest",
    trials=trials,
    measure=measure,
    columns=(
        Column("samples", "samples", digits=0),
        Column("seconds_each", "s each", digits=1),
        Column("slip_mm", "slipped mm"),
        Column("slip_deep_mm", "if deeper than 3 mm"),
        *(
            Column(f"mae_{name}", f"MAE {title}")
            for name, title in (
                ("z_mm", "z mm"),
                ("alpha_deg", "alpha deg"),
                ("beta_deg", "beta deg"),
                ("x_mm", "x mm"),
                ("y_mm", "y mm"),
                ("gamma_deg", "gamma deg"),
            )
        ),
    ),
    draw=draw,
    paper={"plane": "10 000 samples"},
    notes=("labels are the commanded contacts; slipped: mean distance of commanded and true shear",),
)
