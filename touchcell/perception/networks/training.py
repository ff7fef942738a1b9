"""Train a contact network: from labelled images to a model file. Needs the extra ``train`` (PyTorch)."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from touchcell.drivers.replay.dataset import read_rest, read_split
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import TrainingError
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.labels import CONTACT_NAMES, contact_from_xi, xi_from_contact
from touchcell.perception.models.model_file import Labels, Model
from touchcell.perception.models.preprocessing import Crop, Preprocessing, scale
from touchcell.perception.networks.checkpoint import (
    EpochRecord,
    Progress,
    delete_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from touchcell.perception.networks.contact_network import (
    Alignment,
    ContactNetwork,
    gaussian_loss,
    weighted_absolute_loss,
    weighted_square_loss,
)
from touchcell.perception.networks.dataset import LabelledImages, default_cache, label_range, load_reduced
from touchcell.perception.networks.export import write_trained
from touchcell.perception.networks.image_check import learn_image_check
from touchcell.perception.networks.progress import Observer
from touchcell.perception.networks.trainer import TrainingJob

_EVALUATION_BATCH = 100
_SHORT_SIDE_PX = 100
_LEAST_SIDE_PX = 32


@dataclass(frozen=True)
class Settings:
    """Training settings. The defaults, and the figures that chose them, are in docs/decisions/0002-training.md.

    Attributes:
        epochs: passes over the training set; the learning rate's schedule is stretched over them.
        seed: of everything random.
        batch_size: images per step.
        learning_rate: its peak.
        weight_decay: of AdamW.
        memory: decay of the running average of the network that is validated and stored: the fraction kept per step.
        patience: epochs without a better validation loss after which training stops.
        gdn_weights: of the six absolute errors added to a density network's likelihood, in label half-ranges; the
            likelihood alone does not learn gamma for ten epochs.
        cnn_weights: of the six squared errors of a plain network.
        shift_px: standard deviation of the jitter of training images along each axis, in pixels of the network's input.
        rotation_deg: standard deviation of their rotation.
        zoom: standard deviation of their scale, relative.
    """

    epochs: int = 24
    seed: int = 0
    batch_size: int = 16
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    memory: float = 0.998
    patience: int = 25
    gdn_weights: tuple[float, ...] = (2.0, 2.0, 1.0, 1.0, 1.0, 5.0)
    cnn_weights: tuple[float, ...] = (1.0, 1.0, 4.0, 4.0, 4.0, 1.0)
    shift_px: float = 0.15
    rotation_deg: float = 0.13
    zoom: float = 0.0012

    def __post_init__(self) -> None:
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0.0):
            raise TrainingError(f"learning rate {self.learning_rate} is not positive and finite")
        if not 0.0 <= self.memory < 1.0:
            raise TrainingError(f"memory {self.memory} does not lie in [0, 1)")
        if self.epochs < 1 or self.batch_size < 2 or self.patience < 1:
            raise TrainingError("epochs and patience must be at least 1, the batch size at least 2")


def learning_rate(step: int, steps: int, peak: float) -> float:
    """Return the learning rate of the paper's schedule (Lloyd & Lepora 2024, 3.1.4) stretched over ``steps``.

    It rises from a hundredth of the peak in the first 5 %, is held for 2 %, then falls linearly to a ten-thousandth.
    """
    ramp, hold = 0.05 * steps, 0.07 * steps
    if step < ramp:
        return peak * (0.01 + 0.99 * step / ramp)
    if step < hold:
        return peak
    return peak * max(1e-4, 1.0 - (step - hold) / (steps - hold))


def train_on_images(job: TrainingJob, *, kind: Literal["gdn", "cnn"], epochs: int, short_side_px: int) -> Model:
    """Train a network on the images of a data set.

    Args:
        job: data set and file to write.
        kind: of network.
        epochs: passes over the images.
        short_side_px: smallest short side of its input, see ``preprocessing_for``.

    Raises:
        DataError: the data set is damaged.
        TrainingError: as ``trainer.train``.
    """
    splits = {name: read_split(job.data, name) for name in ("train", "val")}
    preprocessing = preprocessing_for(next(splits["train"].read()), short_side_px)
    sets = {
        name: LabelledImages(
            load_reduced(
                split,
                preprocessing,
                cache=job.cache or default_cache(),
                progress=partial(job.observer.images, name),
            ),
            xi_from_contact(split.contact_mm_deg),
        )
        for name, split in splits.items()
    }
    return train_on_arrays(
        sets["train"],
        sets["val"],
        job.out,
        preprocessing=preprocessing,
        kind=kind,
        settings=Settings(seed=job.seed, epochs=epochs),
        reference=None if (rest := read_rest(job.data)) is None else preprocessing.reduce(rest),
        resume=job.resume,
        observer=job.observer,
    )


def preprocessing_for(image: ImageArray, short_side_px: int = _SHORT_SIDE_PX) -> Preprocessing:
    """Return a preprocessing that averages whole pixels into one, leaving a short side of ``short_side_px`` or more.

    OpenCV shrinks by whole numbers three times as fast as to the paper's 128x128. The remainder at the border is cut
    off.

    Raises:
        TrainingError: a short side of less than 32, of which a network's five halvings leave nothing.
    """
    if short_side_px < _LEAST_SIDE_PX:
        raise TrainingError(f"a short side of {short_side_px} px is less than {_LEAST_SIDE_PX}")
    height, width = image.shape[:2]
    factor = max(1, min(height, width) // short_side_px)
    rows, columns = height // factor, width // factor
    left, top = (width - columns * factor) // 2, (height - rows * factor) // 2
    crop = Crop(left, top, left + columns * factor, top + rows * factor)
    return Preprocessing(
        input_size=(height, width),
        crop=None if crop == (0, 0, width, height) else crop,
        output_size=(rows, columns),
    )


def train_on_arrays(
    training: LabelledImages,
    validation: LabelledImages,
    out: Path,
    *,
    preprocessing: Preprocessing,
    kind: Literal["gdn", "cnn"] = "gdn",
    architecture: Architecture | None = None,
    settings: Settings | None = None,
    reference: ImageArray | None = None,
    resume: bool = True,
    observer: Observer | None = None,
) -> Model:
    """Train on images in memory and write the model file ``out`` with two figures beside it.

    Args:
        training: training set.
        validation: selects the best epoch and calibrates sigma.
        out: ``NAME.safetensors``.
        preprocessing: of the images; becomes part of the model.
        kind: of network, when no architecture is given.
        architecture: None for the default one of this kind.
        settings: None for the defaults.
        reference: preprocessed image out of contact, stored in the model file for the contact gate.
        resume: continue an interrupted training of the same data and settings.
        observer: receives the progress.

    Raises:
        TrainingError: as ``trainer.train``.
    """
    settings = settings or Settings()
    architecture = architecture or Architecture(kind=kind, input_size=preprocessing.output_size)
    if len(training.images) != len(training.xi) or len(validation.images) != len(validation.xi):
        raise TrainingError("every image needs one label")
    labels = label_range(training.xi, validation.xi)
    training_data = training.digest()
    recipe: dict[str, object] = {
        "data": training_data,
        "validation_data": validation.digest(),
        "architecture": architecture.model_dump(mode="json"),
        "settings": asdict(settings),
    }
    with _own_randomness(settings.seed):
        network = ContactNetwork(architecture)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        run = _Run(network, settings, labels, training, validation, observer)
        run.fit(out, recipe, resume=resume)
    mean, sigma = run.predict()
    tensors = run.average.folded()
    check = learn_image_check(
        training.images,
        lambda images: run.outputs(images)[:, :6],
        preprocessing,
        rest=reference,
        seed=settings.seed,
        progress=None if observer is None else partial(observer.images, "check"),
    )
    if check is not None:
        architecture = architecture.model_copy(update={"check": check[0]})
        tensors |= check[1]
    return write_trained(
        out,
        architecture=architecture,
        preprocessing=preprocessing,
        labels=labels,
        tensors=tensors,
        reference=reference,
        training_data=training_data,
        metadata={**asdict(settings), "images": len(training)},
        progress=run.progress,
        mean=mean,
        sigma=sigma,
        validation_xi=validation.xi,
    )


@dataclass
class _Run:
    """One training: the network, its optimizer, and the progress.

    A running average of the network over the last few hundred steps is validated and stored: its error is lower than
    the network's while the learning rate is high, and smoother, so that the best epoch is not a matter of chance.
    """

    network: ContactNetwork
    settings: Settings
    labels: Labels
    training: LabelledImages
    validation: LabelledImages
    observer: Observer | None
    progress: Progress = field(default_factory=Progress)

    def __post_init__(self) -> None:
        learned = [parameter for parameter in self.network.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(
            learned, lr=self.settings.learning_rate, weight_decay=self.settings.weight_decay
        )
        self.average = copy.deepcopy(self.network).eval()
        self.alignment = Alignment(self.labels)
        self.training_labels = self._normalised(self.training.xi)
        self.validation_labels = self._normalised(self.validation.xi)
        self.weights = torch.tensor(
            self.settings.gdn_weights if self.network.architecture.kind == "gdn" else self.settings.cnn_weights
        )

    def fit(self, out: Path, recipe: dict[str, object], *, resume: bool) -> None:
        """Run all remaining epochs and leave the best epoch's tensors in the average."""
        if resume:
            self.progress = load_checkpoint(out, recipe, self.network, self.average, self.optimizer) or self.progress
        try:
            self._remaining_epochs(out, recipe)
        except TrainingError:
            # The checkpoint cannot be continued, and must not block a training with another learning rate.
            delete_checkpoint(out)
            raise
        self.average.load_state_dict(self.progress.best_state)

    def outputs(self, images: ImageArray) -> NDArray[np.float32]:
        """Return the network outputs (n, 6 or 12) for preprocessed images."""
        with torch.inference_mode():
            return np.concatenate(
                [
                    self.average(_as_input(images[i : i + _EVALUATION_BATCH])).numpy()
                    for i in range(0, len(images), _EVALUATION_BATCH)
                ]
            )

    def predict(self) -> tuple[Array, Array]:
        """Return mean and uncalibrated sigma (n, 6) of the validation set, in label half-ranges; sigma is 1 for cnn."""
        outputs = self.outputs(self.validation.images).astype(np.float64)
        sigma = np.exp(-outputs[:, 6:]) if outputs.shape[1] > 6 else np.ones_like(outputs)
        return outputs[:, :6], sigma

    def _remaining_epochs(self, out: Path, recipe: dict[str, object]) -> None:
        for epoch in range(len(self.progress.history) + 1, self.settings.epochs + 1):
            if epoch - self.progress.best_epoch > self.settings.patience:
                break
            started_s = time.process_time()
            train_loss = self._epoch(epoch)
            outputs = self.outputs(self.validation.images)
            loss = self._loss(torch.from_numpy(outputs), self.validation_labels).item()
            if not math.isfinite(loss):
                raise TrainingError("the validation loss is not finite", epoch=epoch, hint="lower the learning rate")
            mae = np.abs(
                self.labels.contacts(outputs[:, :6].astype(np.float64)) - contact_from_xi(self.validation.xi)
            ).mean(axis=0)
            errors = dict(zip(CONTACT_NAMES, mae.tolist(), strict=True))
            record = EpochRecord(epoch, train_loss, loss, errors, time.process_time() - started_s)
            self.progress.add(record, self.average)
            save_checkpoint(out, recipe, self.network, self.average, self.optimizer, self.progress)
            if self.observer is not None:
                self.observer.epoch(record, best=self.progress.best_epoch == epoch)
        guess = torch.zeros(len(self.validation_labels), self.network.architecture.outputs)
        if self.progress.best_loss > 2.0 * self._loss(guess, self.validation_labels).item():
            raise TrainingError(
                f"the training diverged: its best validation loss is {self.progress.best_loss:.3g}",
                epoch=self.progress.best_epoch,
                hint="lower the learning rate",
            )

    def _epoch(self, epoch: int) -> float:
        # Every epoch has its own seed, so that a resumed training draws the same numbers as an uninterrupted one.
        torch.manual_seed(int(np.random.SeedSequence((self.settings.seed, epoch)).generate_state(1)[0]))
        self.network.train()
        order = torch.randperm(len(self.training)).numpy()
        batches = max(1, len(order) // self.settings.batch_size)
        total = 0.0
        for i in range(batches):
            step = (epoch - 1) * batches + i
            for group in self.optimizer.param_groups:
                group["lr"] = learning_rate(step, batches * self.settings.epochs, self.settings.learning_rate)
            chosen = order[i * self.settings.batch_size : (i + 1) * self.settings.batch_size]
            images = _jittered(_as_input(self.training.images[chosen]), self.settings)
            loss = self._loss(self.network(images), self.training_labels[chosen])
            if not torch.isfinite(loss):
                raise TrainingError("the loss is not finite", epoch=epoch, hint="lower the learning rate")
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
            self.optimizer.step()
            self._follow(step)
            total += loss.item()
            if self.observer is not None:
                self.observer.batch(epoch, self.settings.epochs, i + 1, batches, total / (i + 1))
        return total / batches

    @torch.no_grad()
    def _follow(self, step: int) -> None:
        # The first steps weigh more, so that the untrained network soon vanishes from the average.
        share = max(1.0 - self.settings.memory, 9.0 / (10.0 + step))
        for kept, new in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if kept.is_floating_point():
                kept.lerp_(new, share)

    def _loss(self, outputs: Tensor, labels: Tensor) -> Tensor:
        if self.network.architecture.kind == "cnn":
            return weighted_square_loss(outputs, labels, self.weights)
        return gaussian_loss(outputs, labels, self.alignment) + weighted_absolute_loss(outputs, labels, self.weights)

    def _normalised(self, xi: Array) -> Tensor:
        return torch.from_numpy(self.labels.targets(xi).astype(np.float32))


def _as_input(images: ImageArray) -> Tensor:
    return torch.from_numpy(scale(images)).unsqueeze(1).contiguous(memory_format=torch.channels_last)


def _jittered(images: Tensor, settings: Settings) -> Tensor:
    """Return images randomly shifted, rotated and zoomed, as by a remounted camera."""
    n, _, height, width = images.shape
    angle = torch.randn(n) * math.radians(settings.rotation_deg)
    zoom = 1.0 + torch.randn(n) * settings.zoom
    motion = torch.zeros(n, 2, 3)
    motion[:, 0, 0] = motion[:, 1, 1] = zoom * angle.cos()
    motion[:, 0, 1] = -zoom * angle.sin()
    motion[:, 1, 0] = zoom * angle.sin()
    motion[:, :, 2] = torch.randn(n, 2) * settings.shift_px * torch.tensor([2.0 / width, 2.0 / height])
    grid = functional.affine_grid(motion, list(images.shape), align_corners=False)
    moved = functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
    return moved.contiguous(memory_format=torch.channels_last)


@contextmanager
def _own_randomness(seed: int) -> Iterator[None]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
