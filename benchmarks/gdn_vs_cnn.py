"""``touchcell bench gdn-vs-cnn``: Gaussian-density networks against regression networks (Lloyd & Lepora 2024, 5.2).

Both kinds share everything but the output layer and the loss: images, network, epochs, schedule, jitter, seeds and the
split that selects the epoch. Small images and few epochs keep twenty trainings within half an hour of a core.

Trained networks are stored, so that an interrupted benchmark resumes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.cli.workers import add_workers, workers_of
from touchcell.cell.experiments.executors import EXECUTORS, Lost
from touchcell.drivers.replay.dataset import read_split
from touchcell.geometry.types import Array
from touchcell.perception.errors import TrainingError
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.labels import xi_from_contact
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.dataset import LabelledImages, default_cache, load_reduced
from touchcell.perception.networks.scores import SCORE_NAMES, Scores

Kind: TypeAlias = Literal["gdn", "cnn"]
KINDS: tuple[Kind, ...] = ("gdn", "cnn")
_LIMIT_S = 86_400


def run(arguments: Sequence[str], out: Path) -> None:
    """Train missing networks, print the table; write ``gdn-vs-cnn.json`` and ``gdn-vs-cnn.png`` into ``out``.

    Raises:
        DataError: the data set is damaged.
        TrainingError: an earlier training in the same folder had other settings.
    """
    options = _options(arguments)
    out.mkdir(parents=True, exist_ok=True)
    first = next(read_split(options.data, "train").read())
    preprocessing = Preprocessing(input_size=(first.shape[0], first.shape[1]), output_size=(options.size, options.size))
    sets = {name: _images(options.data, name, preprocessing) for name in ("train", "val")}
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    networks = [(kind, seed) for seed in range(options.seeds) for kind in KINDS]
    models = {
        (kind, seed): options.networks / f"{kind}_{options.size}px_{options.epochs}epochs_{seed}.safetensors"
        for kind, seed in networks
    }
    _train_missing(
        _TrainNetwork(sets["train"], sets["val"], preprocessing, options.epochs),
        {network: path for network, path in models.items() if not path.exists()},
        options,
    )
    for seed in range(options.seeds):
        for kind in KINDS:
            row = _scores(models[kind, seed], sets["val"])
            rows[kind].append(row)
            print(
                f"{kind:<8} seed {seed}  " + "  ".join(f"{name} {value:.3f}" for name, value in row.items()), flush=True
            )
    result = {
        "provenance": provenance(),
        "options": {key: str(value) for key, value in vars(options).items()},
        "networks": rows,
        "summary": {kind: summary(found) for kind, found in rows.items()},
    }
    (out / "gdn-vs-cnn.json").write_text(json.dumps(result, indent=1) + "\n")
    _print(rows)
    _plot(rows, out / "gdn-vs-cnn.png")


def summary(rows: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation over networks, of each figure."""
    spread = len(rows) > 1
    return {
        name: {
            "mean": float(np.mean([row[name] for row in rows])),
            "sd": float(np.std([row[name] for row in rows], ddof=1)) if spread else 0.0,
        }
        for name in rows[0]
    }


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("touchcell bench gdn-vs-cnn --", description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="data set folder with train/ and val/")
    parser.add_argument("--seeds", type=int, default=10, help="networks of each kind")
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--size", type=int, default=64, help="side of the networks' input, px")
    parser.add_argument("--networks", type=Path, default=Path("runs/gdn-vs-cnn"), help="folder for trained networks")
    add_workers(parser, time_limit_s=_LIMIT_S, what="training")
    return parser.parse_args(arguments)


def _images(data: Path, split: str, preprocessing: Preprocessing) -> LabelledImages:
    found = read_split(data, split)
    return LabelledImages(
        load_reduced(found, preprocessing, cache=default_cache()), xi_from_contact(found.contact_mm_deg)
    )


@dataclass(frozen=True, slots=True)
class _TrainNetwork:
    """Trains one network on one thread and returns the bytes of its model file; picklable."""

    training: LabelledImages
    validation: LabelledImages
    preprocessing: Preprocessing
    epochs: int

    def __call__(self, network: tuple[Kind, int]) -> bytes:
        import torch

        from touchcell.perception.networks.training import Settings, train_on_arrays

        kind, seed = network
        torch.set_num_threads(1)
        size = self.preprocessing.output_size
        with tempfile.TemporaryDirectory() as folder:
            model = Path(folder) / "network.safetensors"
            # The jitter is the same in millimetres of the sensor.
            train_on_arrays(
                self.training,
                self.validation,
                model,
                preprocessing=self.preprocessing,
                architecture=Architecture(kind=kind, input_size=size),
                settings=Settings(seed=seed, epochs=self.epochs, shift_px=0.15 * size[0] / 128),
            )
            return model.read_bytes()


def _train_missing(train: _TrainNetwork, missing: dict[tuple[Kind, int], Path], options: argparse.Namespace) -> None:
    networks = list(missing)
    name, _, address = options.executor.partition(":")
    workers = replace(workers_of(options), address=address)
    for index, model in EXECUTORS.load(name).run(train, networks, workers):
        if isinstance(model, Lost):
            raise TrainingError(f"{networks[index]}: {model.reason}")
        path = missing[networks[index]]
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(model)
        unfinished.replace(path)


def _scores(model: Path, validation: LabelledImages) -> dict[str, float]:
    from touchcell.perception.models.labels import contact_from_xi
    from touchcell.perception.runtime.inference import ContactModel

    network = ContactModel.load(model)
    predictions = [network.predict_reduced(image) for image in validation.images]
    scores = Scores.of(contact_from_xi(validation.xi), predictions)
    return {**scores.mae(), "nll": float(scores.nll.mean())}


def _print(rows: dict[str, list[dict[str, float]]]) -> None:
    names = (*SCORE_NAMES, "nll")
    print(f"\nMAE over {len(rows['gdn'])} networks, mean +- sd\n{'':<9}" + "".join(f"{name:>17}" for name in names))
    for kind, found in rows.items():
        figures = summary(found)
        print(
            f"{kind:<9}"
            + "".join(f"{figures[name]['mean']:>10.3f} +-{figures[name]['sd']:5.3f}"[:17] for name in names)
        )
    better = [sum(one[name] < other[name] for one, other in zip(*rows.values(), strict=True)) for name in names]
    print("gdn < cnn" + "".join(f"{n:>17}" for n in better))


def _plot(rows: dict[str, list[dict[str, float]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(SCORE_NAMES), figsize=(12, 3.2), layout="constrained")
    for axis, name in zip(axes, SCORE_NAMES, strict=True):
        values: list[Array] = [np.array([row[name] for row in rows[kind]]) for kind in KINDS]
        for i, found in enumerate(values):
            axis.plot(np.full(len(found), i), found, "o", alpha=0.5)
            axis.plot([i - 0.25, i + 0.25], [found.mean()] * 2, "k-")
        axis.set(title=name, xticks=range(len(KINDS)), xlim=(-0.5, len(KINDS) - 0.5))
        axis.set_xticklabels(KINDS, fontsize=8)
        axis.set_ylim(bottom=0.0)
    axes[0].set_ylabel("MAE on val, one dot a network")
    figure.savefig(path, dpi=120)
    plt.close(figure)
