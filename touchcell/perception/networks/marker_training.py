"""Train a marker estimator: from labelled images to a model file. Needs the extra ``train`` (PyTorch)."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from touchcell.drivers.replay.dataset import Split, read_rest, read_split
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import ImageError, TrainingError
from touchcell.perception.markers.camera_check import learn_check
from touchcell.perception.markers.detection import Discs, detect_markers, rings_of, typical_size
from touchcell.perception.markers.figures import write_markers
from touchcell.perception.markers.layers import mixed
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.models.labels import CONTACT_NAMES, contact_from_xi, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Labels, Model
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Preprocessing
from touchcell.perception.networks.checkpoint import (
    EpochRecord,
    Progress,
    delete_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from touchcell.perception.networks.contact_network import Alignment
from touchcell.perception.networks.dataset import cache_key, default_cache, label_range
from touchcell.perception.networks.displacement_network import (
    DisplacementNetwork,
    Jitter,
    details_of,
    displacement_loss,
)
from touchcell.perception.networks.export import write_trained
from touchcell.perception.networks.marker_learning import (
    GRID,
    GUESS_HIDDEN,
    KnownMarkers,
    Learned,
    find_rings,
    learn_markers,
    learned_of_known,
    match_all,
    spread,
    stacked,
)
from touchcell.perception.networks.progress import Display, Observer

_LEAST_SCORE_TAUGHT = 0.9
_LEAST_BATCHES = 16
_LOOKED_AT = 20
_MOST_FOR_CHECK = 40_000
_MOST_FOR_DETAILS = 8000
_MATCHING = 2  # Version of the matching, so that results of older versions are not taken from the cache.


@dataclass(frozen=True)
class MarkerSettings:
    """Training settings. The figures that chose the defaults are in docs/decisions/0006-markers.md.

    Attributes:
        epochs: passes over the training set; over few images, as many passes each as make 16 batches.
        seed: of everything random.
        rings: of the sensor's lattice; None counts them in the images.
        modes: number of components of the displacement model.
        guess_steps: of the first guess's training (``marker_learning.learn_markers``).
        hidden: units of each layer of a displacement network.
        networks: trained side by side; their mixture is the estimate.
        batch_size: contacts per step and network.
        learning_rate: its peak, after a rise over 5 % of the steps; then it falls as a half cosine.
        weight_decay: of AdamW.
        memory: decay of the running average of the networks: the fraction that is kept per step.
        noise: standard deviation added to scaled inputs.
        shift_px, turn_rad, zoom: standard deviations of the jitter, as of a camera that was remounted.
        marker_px: standard deviation added to each marker's place, anew in every epoch.
        details: principal components of the displacements that the networks have as inputs of their own.
        details_px: components that vary by less are scaled as if they varied by this.
    """

    epochs: int = 80
    seed: int = 0
    rings: int | None = None
    modes: int = 24
    guess_steps: int = 1200
    hidden: tuple[int, ...] = (384, 512, 512, 256)
    networks: int = 2
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    memory: float = 0.998
    noise: float = 0.02
    shift_px: float = 0.5
    turn_rad: float = 0.0022
    zoom: float = 0.00125
    marker_px: float = 0.0
    details: int = 0
    details_px: float = 0.1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0.0):
            raise TrainingError(f"learning rate {self.learning_rate} is not positive and finite")
        if min(self.epochs, self.rings or 1, self.modes, self.networks, *self.hidden) < 1 or self.batch_size < 2:
            raise TrainingError("epochs, rings, modes, networks and units must be 1 or more, the batch size 2 or more")


@dataclass(frozen=True)
class LabelledDiscs:
    """Detected discs of images, and their labels.

    Attributes:
        frames: discs of each image; none of a training set whose markers are known.
        xi: (n, 6) log(T_s_f), m and rad.
        markers: which disc is which marker, where a simulation knows it; None where it has to be learned.
    """

    frames: list[Discs]
    xi: Array
    markers: KnownMarkers | None = None

    def digest(self) -> str:
        """Return the SHA-256 of the content."""
        content = hashlib.sha256(np.round(self.xi, 12).astype("<f8").tobytes())
        for discs in self.frames:
            content.update(np.round(discs.centres, 6).astype("<f8").tobytes())
        if self.markers is not None:
            content.update(np.ascontiguousarray(self.markers.displacements, "<f4").tobytes())
            content.update(np.packbits(self.markers.seen).tobytes())
        return content.hexdigest()


def preprocessing_for(image: ImageArray) -> Preprocessing:
    """Return a preprocessing to binary images at full resolution: none, or the paper's median and threshold."""
    height, width = image.shape
    black_and_white = bool(np.isin(image, (0, 255)).all())
    return Preprocessing(
        input_size=(height, width),
        output_size=(height, width),
        median_px=None if black_and_white else 5,
        threshold=None if black_and_white else AdaptiveThreshold(block_px=61, offset=-5.0),
    )


def preprocessing_and_size(images: Iterable[ImageArray]) -> tuple[Preprocessing, MarkerSize]:
    """Return preprocessing and size of markers of a data set's images, from the first that shows markers.

    Raises:
        ImageError: the first twenty images show none.
    """
    error: ImageError | None = None
    for image in islice(images, _LOOKED_AT):
        preprocessing = preprocessing_for(image)
        try:
            return preprocessing, typical_size(preprocessing.reduce(image))
        except ImageError as found:
            error = error or found
    raise error or ImageError("content", "7 markers or more", 0)


def train_markers(
    data: Path,
    out: Path,
    *,
    settings: MarkerSettings | None = None,
    resume: bool = True,
    cache: Path | None = None,
    observer: Observer | None = None,
) -> Model:
    """Learn to match the markers of ``data/train`` without its labels, then contact pose and shear with them.

    Arguments, files written and resuming as ``trainer.train``; ``NAME_markers.png`` shows displacements and density.
    Matching is done once for the same images.

    Raises:
        DataError: the data set is damaged.
        TrainingError: no lattice is found, too few images match, or as ``trainer.train``.
    """
    settings = settings or MarkerSettings()
    if observer is None:
        with Display() as display:
            return train_markers(data, out, settings=settings, resume=resume, cache=cache, observer=display)
    splits = {name: read_split(data, name) for name in ("train", "val")}
    preprocessing, size = preprocessing_and_size(splits["train"].read())
    cache = cache or default_cache()
    report = observer.images
    sets = {
        name: LabelledDiscs(
            _discs(split, preprocessing, size, cache, partial(report, name)), xi_from_contact(split.contact_mm_deg)
        )
        for name, split in splits.items()
    }
    return train_on_discs(
        sets["train"],
        sets["val"],
        out,
        preprocessing=preprocessing,
        size=size,
        settings=settings,
        reference=None if (rest := read_rest(data)) is None else preprocessing.reduce(rest),
        resume=resume,
        cache=cache,
        observer=observer,
    )


def train_on_discs(
    training: LabelledDiscs,
    validation: LabelledDiscs,
    out: Path,
    *,
    preprocessing: Preprocessing,
    size: MarkerSize,
    settings: MarkerSettings | None = None,
    reference: ImageArray | None = None,
    resume: bool = True,
    cache: Path | None = None,
    observer: Observer | None = None,
) -> Model:
    """Train on discs in memory and write the model file ``out`` with three figures beside it.

    Args:
        training: training set.
        validation: selects the best epoch and calibrates sigma.
        out: ``NAME.safetensors``.
        preprocessing: of the images; becomes part of the model.
        size: with which the discs were found; likewise.
        settings: None for the defaults.
        reference: preprocessed image out of contact, stored for the contact gate.
        resume: continue an interrupted training of the same data and settings.
        cache: folder for the matched markers; None stores nothing.
        observer: receives the progress.

    Raises:
        TrainingError: as ``train_markers``.
    """
    settings = settings or MarkerSettings()
    rings = settings.rings or _rings_of(training)
    settings = replace(settings, rings=rings)
    labels = label_range(training.xi, validation.xi)
    training_data = training.digest()
    matched = _matched(training, validation, preprocessing.output_size, training_data, settings, rings, cache, observer)
    check, check_tensors = learn_check(matched.model, rings, matched.some_taught(_MOST_FOR_CHECK))
    architecture = MarkerArchitecture(
        input_size=preprocessing.output_size,
        size=size,
        rings=rings,
        modes=len(matched.tensors["displacement.sd"]),
        bank=len(matched.tensors["bank"]),
        grid=GRID,
        guess_low_px=(float(matched.frame[0]), float(matched.frame[1])),
        guess_cell_px=float(matched.frame[2]),
        guess_hidden=GUESS_HIDDEN,
        least_score=float(matched.frame[3]),
        most_rms_px=float(matched.frame[4]),
        hidden=settings.hidden,
        networks=settings.networks,
        camera_check=check,
    )
    recipe: dict[str, Any] = {
        "data": training_data,
        "validation_data": validation.digest(),
        "architecture": architecture.model_dump(mode="json"),
        "settings": asdict(settings),
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        run = _Run(settings, labels, matched, training.xi, validation.xi, observer)
        run.fit(out, recipe, resume=resume)
    mean, sigma = run.predict()
    model = write_trained(
        out,
        architecture=architecture,
        preprocessing=preprocessing,
        labels=labels,
        tensors={**matched.tensors, **run.average.folded(), **check_tensors},
        reference=reference,
        training_data=training_data,
        metadata={
            **asdict(settings),
            "images": len(training.xi),
            "images_matched": int(matched.taught.sum()),
        },
        progress=run.progress,
        mean=mean,
        sigma=sigma,
        validation_xi=validation.xi,
    )
    _write_examples(out.with_name(f"{out.stem}_markers.png"), run.model, matched.validation, preprocessing.output_size)
    return model


def _rings_of(training: LabelledDiscs) -> int:
    return find_rings(training.frames) if training.markers is None else rings_of(len(training.markers.reference))


@dataclass(frozen=True)
class _Matched:
    """Displacements of all images, and the tensors of the matcher that found them.

    Attributes:
        tensors: of the model file.
        frame: (5,) guess_low_px, guess_cell_px, least_score, most_rms_px.
        training, validation: (n, 2 m) px.
        taught: (n,) training images that matched well enough to be used.
    """

    tensors: dict[str, NDArray[np.float32]]
    frame: Array
    training: NDArray[np.float32]
    validation: NDArray[np.float32]
    taught: NDArray[np.bool_]

    @property
    def model(self) -> DisplacementModel:
        """The displacement model."""
        names = ("lattice", "displacement.mean", "displacement.basis", "displacement.sd")
        return DisplacementModel(*(self.tensors[name].astype(np.float64) for name in names))

    def some_taught(self, most: int) -> Array:
        """Return (n, 2 m) px of ``most`` taught images at most, from all over the set."""
        return self.training[spread(np.flatnonzero(self.taught), most)].astype(np.float64)


def _matched(
    training: LabelledDiscs,
    validation: LabelledDiscs,
    image_size: tuple[int, int],
    training_data: str,
    settings: MarkerSettings,
    rings: int,
    cache: Path | None,
    observer: Observer | None,
) -> _Matched:
    matching = [_MATCHING, rings, settings.modes, settings.guess_steps, settings.seed]
    key = json.dumps([training_data, validation.digest(), *matching])
    name = f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.markers.npz"
    stored = _load(cache / name) if cache is not None else None
    if stored is not None:
        arrays = {key: stored.pop(key) for key in ("frame", "training", "validation", "taught")}
        return _Matched(tensors=stored, **arrays)

    def report(what: str) -> Callable[[int, int], None]:
        return lambda done, total: None if observer is None else observer.images(what, done, total)

    if training.markers is not None:
        learned = learned_of_known(
            training.markers, image_size, modes=settings.modes, guess_steps=settings.guess_steps, seed=settings.seed
        )
        displacements, taught = training.markers.displacements, [True] * len(training.xi)
        return _as_matched(learned, displacements, taught, validation, report)
    learned = learn_markers(
        training.frames,
        image_size,
        rings=rings,
        modes=settings.modes,
        guess_steps=settings.guess_steps,
        seed=settings.seed,
        progress=report("matched"),
    )
    taught = [each.score >= _LEAST_SCORE_TAUGHT for each in learned.fields]
    matched = _as_matched(learned, stacked(learned.fields)[0], taught, validation, report)
    if cache is not None:
        _save(
            cache / name,
            {
                **matched.tensors,
                "frame": matched.frame,
                "training": matched.training,
                "validation": matched.validation,
                "taught": matched.taught,
            },
        )
    return matched


def _as_matched(
    learned: Learned,
    displacements: NDArray[np.floating[Any]],
    taught: list[bool],
    validation: LabelledDiscs,
    report: Callable[[str], Callable[[int, int], None]],
) -> _Matched:
    fields = match_all(learned.matcher, validation.frames, report("matched, val"))
    return _Matched(
        tensors=_tensors(learned),
        frame=np.array([*learned.guess.low, learned.guess.cell_px, learned.least_score, learned.most_rms_px]),
        training=displacements.reshape(len(displacements), -1).astype(np.float32, copy=False),
        validation=stacked(fields)[0].reshape(len(fields), -1).astype(np.float32),
        taught=np.array(taught),
    )


def _write_examples(
    path: Path, model: DisplacementModel, displacements: NDArray[np.float32], size: tuple[int, int]
) -> None:
    """Plot a slight, a medium and a strong contact, to check the matching by eye."""
    order = np.argsort(np.abs(displacements).mean(axis=1))
    shares = (0.1, 0.5, 0.95)
    chosen = [order[int(share * (len(order) - 1))] for share in shares]
    positions = [model.reference + displacements[i].reshape(-1, 2).astype(np.float64) for i in chosen]
    titles = [f"validation image {i + 1}" for i in chosen]
    write_markers(path, model.reference, positions, titles, size, model.spacing_px)


def _tensors(learned: Learned) -> dict[str, NDArray[np.float32]]:
    model, guess = learned.matcher.model, learned.guess
    tensors = {
        "lattice": model.reference,
        "displacement.mean": model.mean,
        "displacement.basis": model.basis,
        "displacement.sd": model.sd,
        "bank": learned.bank,
        "guess.hidden.weight": np.ascontiguousarray(guess.hidden_weight.T),
        "guess.hidden.bias": guess.hidden_bias,
        "guess.output.weight": guess.weight,
        "guess.output.bias": guess.bias,
        "guess.sd": guess.sd,
    }
    return {name: np.ascontiguousarray(tensor, dtype=np.float32) for name, tensor in tensors.items()}


@dataclass
class _Run:
    """One training: the networks, their optimizer, and the progress."""

    settings: MarkerSettings
    labels: Labels
    matched: _Matched
    training_xi: Array
    validation_xi: Array
    observer: Observer | None
    progress: Progress = field(default_factory=Progress)

    def __post_init__(self) -> None:
        self.model = model = self.matched.model
        settings = self.settings
        details = None
        if settings.details:
            shown = self.matched.some_taught(_MOST_FOR_DETAILS)
            details = details_of(shown, settings.details, settings.details_px)
        self.network = DisplacementNetwork(model, settings.hidden, settings.networks, details)
        self.average = copy.deepcopy(self.network).eval()
        self.alignment = Alignment(self.labels)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        taught = self.matched.taught
        self.inputs = torch.from_numpy(self.matched.training if taught.all() else self.matched.training[taught])
        self.targets = self._normalised(self.training_xi[self.matched.taught])
        self.validation_inputs = torch.from_numpy(self.matched.validation)
        self.validation_targets = self._normalised(self.validation_xi)
        self.jitter = Jitter(model.reference, settings.shift_px, settings.turn_rad, settings.zoom, settings.marker_px)

    def fit(self, out: Path, recipe: dict[str, Any], *, resume: bool) -> None:
        """Run all remaining epochs and leave the best epoch's tensors in the average."""
        if resume:
            self.progress = load_checkpoint(out, recipe, self.network, self.average, self.optimizer) or self.progress
        try:
            for epoch in range(len(self.progress.history) + 1, self.settings.epochs + 1):
                self._epoch_and_its_validation(epoch)
                save_checkpoint(out, recipe, self.network, self.average, self.optimizer, self.progress)
        except TrainingError:
            delete_checkpoint(out)
            raise
        self.average.load_state_dict(self.progress.best_state)
        # 0.5 is the mean error of the constant centre of the range for uniform labels.
        if self.progress.best_loss > 6 * 0.5:
            raise TrainingError("the training diverged", epoch=self.progress.best_epoch, hint="lower the learning rate")

    @torch.inference_mode()
    def predict(self) -> tuple[Array, Array]:
        """Return mean and uncalibrated sigma (n, 6) of the validation set, in label half-ranges."""
        networks = self.settings.networks
        outputs = self.average(self.validation_inputs.expand(networks, -1, -1)).numpy().astype(np.float64)
        return mixed(outputs[..., :6], outputs[..., 12:], self.labels)

    def _epoch_and_its_validation(self, epoch: int) -> None:
        started_s = time.process_time()
        train_loss = self._epoch(epoch)
        mean, _ = self.predict()
        loss = float(np.abs(mean - self.validation_targets.numpy()).mean(axis=0).sum())
        if not math.isfinite(loss):
            raise TrainingError("the validation loss is not finite", epoch=epoch, hint="lower the learning rate")
        contacts = self.labels.contacts(mean)
        mae = np.abs(contacts - contact_from_xi(self.validation_xi)).mean(axis=0)
        errors = dict(zip(CONTACT_NAMES, mae.tolist(), strict=True))
        record = EpochRecord(epoch, train_loss, loss, errors, time.process_time() - started_s)
        self.progress.add(record, self.average)
        if self.observer is not None:
            self.observer.epoch(record, best=self.progress.best_epoch == epoch)

    def _epoch(self, epoch: int) -> float:
        # Every epoch has its own seed, so that a resumed training draws the same numbers as an uninterrupted one.
        torch.manual_seed(int(np.random.SeedSequence((self.settings.seed, epoch)).generate_state(1)[0]))
        settings = self.settings
        self.network.train()
        # With few images an epoch uses each several times: eighty steps would not train a network to convergence.
        passes = math.ceil(_LEAST_BATCHES * settings.batch_size / len(self.inputs))
        n, networks = len(self.inputs), range(settings.networks)
        order = torch.cat([torch.stack([torch.randperm(n) for _ in networks]) for _ in range(passes)], dim=1)
        batches = order.shape[1] // settings.batch_size
        total = 0.0
        for i in range(batches):
            step = (epoch - 1) * batches + i
            for group in self.optimizer.param_groups:
                group["lr"] = _cosine(step, batches * settings.epochs, settings.learning_rate)
            chosen = order[:, i * settings.batch_size : (i + 1) * settings.batch_size]
            outputs = self.network(self.jitter(self.inputs[chosen]), settings.noise)
            loss = displacement_loss(outputs, self.targets[chosen], self.alignment)
            if not torch.isfinite(loss):
                raise TrainingError("the loss is not finite", epoch=epoch, hint="lower the learning rate")
            self.optimizer.zero_grad(set_to_none=True)
            # The networks are independent: each shall train as fast as it would alone.
            (loss * settings.networks).backward()  # type: ignore[no-untyped-call]
            self.optimizer.step()
            self._follow(step)
            total += loss.item()
            if self.observer is not None:
                self.observer.batch(epoch, settings.epochs, i + 1, batches, total / (i + 1))
        return total / batches

    @torch.no_grad()
    def _follow(self, step: int) -> None:
        share = max(1.0 - self.settings.memory, 9.0 / (10.0 + step))
        for kept, new in zip(self.average.parameters(), self.network.parameters(), strict=True):
            kept.lerp_(new, share)

    def _normalised(self, xi: Array) -> Tensor:
        return torch.from_numpy(self.labels.targets(xi).astype(np.float32))


def _cosine(step: int, steps: int, peak: float) -> float:
    """Return the learning rate: linear rise over 5 % of the steps, times a half cosine over all of them."""
    return peak * min(1.0, (step + 1) / (0.05 * steps)) * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def _discs(
    split: Split, preprocessing: Preprocessing, size: MarkerSize, cache: Path, progress: Callable[[int, int], None]
) -> list[Discs]:
    """Return the discs of every image of a split; cached."""
    key = hashlib.sha256((cache_key(split, preprocessing) + size.model_dump_json()).encode()).hexdigest()[:32]
    kept = cache / f"{key}.discs.npz"
    stored = _load(kept)
    if stored is None:
        found = []
        for i, image in enumerate(split.read()):
            found.append(detect_markers(preprocessing.reduce(image), size))
            progress(i + 1, len(split.images))
        _save(
            kept,
            {
                "counts": np.array([len(discs) for discs in found]),
                "centres": np.concatenate([discs.centres for discs in found]),
                "areas": np.concatenate([discs.areas for discs in found]),
            },
        )
        return found
    ends = np.cumsum(stored["counts"])[:-1]
    return [
        Discs(centres, areas)
        for centres, areas in zip(np.split(stored["centres"], ends), np.split(stored["areas"], ends), strict=True)
    ]


def _load(path: Path) -> dict[str, NDArray[Any]] | None:
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError, BadZipFile):
        path.unlink()
        return None


def _save(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        unfinished = Path(scratch) / "arrays.npz"
        np.savez(unfinished, **arrays)  # type: ignore[arg-type]
        os.replace(unfinished, path)
