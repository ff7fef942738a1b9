"""Few-shot adaptation of a marker estimator to another sensor of its kind. Needs the extra ``train``.

Two such sensors differ mostly in the pose of the camera and in the orientation of the label axes: six numbers that are
estimated first, so that the old networks see markers and labels as in their training. The rest - mounts, stiffness,
skin - is left to a short training regularised towards the old weights.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from touchcell.drivers.replay.dataset import read_image, read_split
from touchcell.geometry.types import Array
from touchcell.perception.calibration.least_squares import robust_fit
from touchcell.perception.calibration.marked_data import evenly
from touchcell.perception.calibration.zero_frame import lattice_turns, similarity
from touchcell.perception.errors import ModelError, TrainingError
from touchcell.perception.markers.detection import Discs, detect_markers, typical_size
from touchcell.perception.markers.estimator import displacement_model_of, matcher_of, mixed
from touchcell.perception.markers.matching import DisplacementModel, MarkerMatcher
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.labels import xi_from_contact
from touchcell.perception.models.marker_architecture import LOG_PRECISION_BOUNDS, MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Header, Labels, Model, load_model, save_model, touchcell_version
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.displacement_network import Jitter, features_of
from touchcell.perception.networks.marker_learning import fit_lattice
from touchcell.perception.networks.marker_training import LabelledDiscs, preprocessing_for

_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
_REFINED_WITH = 60
_TYPICAL_ERROR = 0.05
_SHALLOW = 5
_TRIED = 30
_FEWEST = 10
_MATCHED = 0.5


@dataclass(frozen=True)
class AdaptSettings:
    """Settings of the adaptation of the networks.

    Attributes:
        steps: of the training.
        batch_size: contacts per step and network.
        learning_rate: at its peak; it falls as a half cosine.
        hold: strength of the regularisation towards the old weights: the loss of one weight that is off by its layer's
            typical magnitude, times the number of weights.
        dropout: after each hidden layer.
        shift_px, turn_rad, zoom: standard deviations of the jitter.
        seed: of everything random.
    """

    steps: int = 150
    batch_size: int = 32
    learning_rate: float = 1e-3
    hold: float = 0.3
    dropout: float = 0.1
    shift_px: float = 0.3
    turn_rad: float = 0.001
    zoom: float = 0.0006
    seed: int = 0


@dataclass(frozen=True)
class CameraAlignment:
    """Mapping of a new sensor's images and labels to those of the old.

    Attributes:
        camera: from its pixels to the old sensor's.
        turn_rad: rotation of its label axes about the sensor's axis, to the old sensor's.
        gain: of its displacements.
        offset: (6,) of the old networks' outputs, in label half-ranges.
        displacements: (n, 2 m) px, as the old sensor would have seen them.
        matched: (n,) contacts whose markers could be matched.
    """

    camera: CameraChange
    turn_rad: float
    gain: float
    offset: Array
    displacements: NDArray[np.float32]
    matched: NDArray[np.bool_]


def adapt(
    model: Path, data: Path, out: Path, *, frames: int | None = None, settings: AdaptSettings | None = None
) -> Model:
    """Write ``out``, a model for the sensor that took ``data/train``.

    Args:
        model: model file of kind markers.
        data: data set; ``train`` is used.
        out: ``NAME.safetensors``.
        frames: number of images, evenly chosen; None for all.
        settings: None for the defaults.

    Raises:
        ModelError: the model is of another kind, or was adapted already.
        DataError: the data set is damaged.
        TrainingError: fewer than ten images can be matched to the old sensor's markers.
    """

    old = load_model(model)
    if not isinstance(old.header.architecture, MarkerArchitecture):
        raise ModelError(
            model,
            f"is {old.header.architecture.kind}; only marker estimators can be adapted",
            key="architecture.kind",
            hint="train one with `touchcell train --kind markers`, or train this kind again on the new sensor's images",
        )
    if old.header.camera is not None:
        raise ModelError(model, "was adapted already", key="camera", hint="adapt the original model")
    split = read_split(data, "train")
    chosen = evenly(len(split.images), len(split.images) if frames is None else frames)
    images = [read_image(split.images[i]) for i in chosen]
    preprocessing = preprocessing_for(images[0])
    size = typical_size(preprocessing.reduce(images[0]))
    dataset = LabelledDiscs(
        [detect_markers(preprocessing.reduce(image), size) for image in images],
        xi_from_contact(split.contact_mm_deg[chosen]),
    )
    adapted = adapt_to(old, dataset, preprocessing=preprocessing, size=size, settings=settings)
    save_model(adapted, out)
    return adapted


def adapt_to(
    old: Model,
    dataset: LabelledDiscs,
    *,
    preprocessing: Preprocessing,
    size: MarkerSize,
    settings: AdaptSettings | None = None,
) -> Model:
    """Return the model for another sensor, from discs in memory. Arguments as of the model; raises as ``adapt``."""
    settings = settings or AdaptSettings()
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    alignment = align_to_sensor(old, dataset)
    xi, displacements = dataset.xi[alignment.matched], alignment.displacements[alignment.matched]
    layers, labels = _aligned(layers_of(old), alignment), old.header.labels
    target = labels.targets(about_z(alignment.turn_rad, xi))
    # Held-out contacts decide the step away from the old weights and the scale of the sigmas.
    even = np.arange(len(xi)) % 2 == 0
    halves = [tune(old, layers, displacements[half], target[half], settings) for half in (even, ~even)]
    errors, standardised = [], []
    for fraction in _FRACTIONS:
        off, by_sigma = [], []
        for half, trained in zip((~even, even), halves, strict=True):
            mean, sigma = outputs_of(_interpolated(layers, trained, fraction), displacements[half], labels)
            off.append(np.abs(target[half] - mean))
            by_sigma.append(labels.aligned(target[half] - mean, mean) / sigma ** np.array(old.header.sigma_power))
        errors.append(float(np.concatenate(off).mean()))
        standardised.append(np.concatenate(by_sigma))
    best = int(np.argmin(errors))
    scale = np.sqrt(np.mean(standardised[best] ** 2, axis=0))
    tuned = (
        _interpolated(layers, tune(old, layers, displacements, target, settings), _FRACTIONS[best]) if best else layers
    )
    tensors = dict(old.tensors)
    for i, (weight, bias) in enumerate(tuned):
        tensors[f"layer{i}.weight"] = np.ascontiguousarray(weight, dtype=np.float32)
        tensors[f"layer{i}.bias"] = np.ascontiguousarray(bias, dtype=np.float32)
    header = old.header
    return Model(
        Header(
            touchcell_version=touchcell_version(),
            architecture=architecture.model_copy(update={"input_size": preprocessing.output_size, "size": size}),
            preprocessing=preprocessing,
            labels=labels,
            sigma_scale=tuple(scale.tolist()),
            sigma_power=header.sigma_power,
            camera=alignment.camera,
            label_turn_deg=math.degrees(alignment.turn_rad),
            training_data=header.training_data,
            training={
                **header.training,
                "adapted_images": len(dataset.frames),
                "adapted_images_matched": int(alignment.matched.sum()),
                "adapted_fraction": _FRACTIONS[best],
                **{f"adapted_{key}": value for key, value in asdict(settings).items()},
            },
        ),
        tensors,
    )


def align_to_sensor(old: Model, dataset: LabelledDiscs) -> CameraAlignment:
    """Estimate the camera and the label axes.

    A lattice is symmetric under rotation by 60 degrees: of the six possible cameras the right one, together with its
    rotation of the label axes, is that with which the old networks err least.
    """
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    matcher = matcher_of(old, architecture)
    old_lattice = matcher.model.reference
    # |log| stands in for the depth: the least deformed are the shallowest.
    depth = np.abs(dataset.xi[:, 2])
    fits = [fit_lattice(dataset.frames[i], architecture.rings) for i in np.argsort(depth)[:_SHALLOW]]
    new_lattice, rms = min(fits, key=lambda each: each[1])
    if not np.isfinite(rms):
        raise TrainingError(
            f"no lattice of {architecture.rings} rings found in the shallowest images",
            hint="only a sensor of the same kind can be adapted to; give an image of hardly any contact",
        )
    layers = layers_of(old)
    some = np.linspace(0, len(dataset.frames) - 1, min(_TRIED, len(dataset.frames))).round().astype(int)
    best: tuple[float, CameraChange, float] | None = None
    for order in lattice_turns(architecture.rings):
        linear, off = similarity(new_lattice[order], old_lattice)
        centre = new_lattice.mean(axis=0)
        du, dv = old_lattice.mean(axis=0) - centre
        camera = CameraChange(
            zoom=abs(linear),
            turn_deg=float(np.degrees(np.angle(linear))),
            centre_px=(float(centre[0]), float(centre[1])),
            shift_px=(float(du), float(dv)),
            frames=1,
            rms_px=off,
        )
        displacements, matched = _seen_by(camera, matcher, [dataset.frames[i] for i in some])
        if matched.mean() < _MATCHED or matched.sum() < min(_FEWEST, len(some)):
            continue
        mean, _ = outputs_of(layers, displacements[matched], old.header.labels)
        predicted = xi_from_contact(old.header.labels.contacts(mean))
        turn, error = _label_turn(dataset.xi[some][matched], predicted)
        if best is None or error < best[0]:
            best = (error, camera, turn)
    if best is None:
        raise TrainingError(
            "the markers of too few images can be matched to the old sensor's",
            hint="only a sensor of the same kind can be adapted to; check threshold and crop",
        )
    _, camera, turn = best
    displacements, matched = _seen_by(camera, matcher, dataset.frames)
    if matched.sum() < _FEWEST:
        raise TrainingError(f"{int(matched.sum())} images could be matched, {_FEWEST} are needed", hint="give more")
    refined = _refined(old, layers, old_lattice, displacements[matched], dataset.xi[matched], turn)
    camera, turn = _composed(camera, refined), turn + float(refined[4])
    displacements, matched = _seen_by(camera, matcher, dataset.frames)
    return CameraAlignment(camera, turn, float(refined[5]), refined[6:], displacements, matched)


def _refined(
    old: Model, layers: Layers, old_lattice: Array, displacements: NDArray[np.float32], xi: Array, turn: float
) -> Array:
    """Return the (12,) parameters with which the old networks err least.

    They are log zoom, rotation and shift (2) px of the camera, rotation of the label axes, gain of the displacements,
    and offset (6) of the outputs in label half-ranges. One light contact determines the camera to 0.3 % only, which
    would bias depth.
    """
    some = np.linspace(0, len(xi) - 1, min(_REFINED_WITH, len(xi))).round().astype(int)
    centre = old_lattice.mean(axis=0)
    labels = old.header.labels
    moved = displacements[some].astype(np.float64).reshape(len(some), -1, 2)

    def residuals(x: Array) -> Array:
        linear = np.exp(x[0]) * np.array([[np.cos(x[1]), -np.sin(x[1])], [np.sin(x[1]), np.cos(x[1])]])
        seen = (old_lattice + moved - centre) @ linear.T + centre + x[2:4] - old_lattice
        mean, _ = outputs_of(layers, (x[5] * seen).reshape(len(some), -1).astype(np.float32), labels)
        aim = labels.targets(about_z(turn + x[4], xi[some]))
        flat: Array = (mean + x[6:] - aim).ravel() / _TYPICAL_ERROR
        return flat

    start = np.concatenate([np.zeros(5), [1.0], np.zeros(6)])
    scale = np.array([0.003, 0.005, 1.0, 1.0, 0.05, 0.05, *[0.05] * 6])
    return robust_fit(
        residuals, start, scale, low=start - 20 * scale, high=start + 20 * scale, prior=3.0, soft=1.0, turns=6
    )


def _composed(camera: CameraChange, refined: Array) -> CameraChange:
    return camera.model_copy(
        update={
            "zoom": camera.zoom * float(np.exp(refined[0])),
            "turn_deg": camera.turn_deg + float(np.degrees(refined[1])),
            "shift_px": (camera.shift_px[0] + float(refined[2]), camera.shift_px[1] + float(refined[3])),
        }
    )


def about_z(turn_rad: float, xi: Array) -> Array:
    """Return labels (n, 6) with axes rotated about the sensor's z axis."""
    turned = xi.copy()
    for first in (0, 3):
        plane = _plane(xi, first) * np.exp(1j * turn_rad)
        turned[:, first], turned[:, first + 1] = plane.real, plane.imag
    return turned


def _seen_by(
    camera: CameraChange, matcher: MarkerMatcher, frames: list[Discs]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    fields = [matcher.match(Discs(camera.points(discs.centres), discs.areas)) for discs in frames]
    displacements = np.stack([each.displacements.ravel() for each in fields]).astype(np.float32)
    return displacements, np.array([each.valid for each in fields])


def _label_turn(xi: Array, predicted: Array) -> tuple[float, float]:
    """Return the angle about z that maps labels xi (n, 6) to predictions, and the mean residual, mm or degrees."""
    a, b = (np.concatenate([_plane(each, 0) / 1e-3, _plane(each, 3) / np.radians(1.0)]) for each in (xi, predicted))
    turn = float(np.angle(np.vdot(a, b)))
    return turn, float(np.abs(a * np.exp(1j * turn) - b).mean())


def _plane(xi: Array, first: int) -> NDArray[np.complex128]:
    return (xi[:, first] + 1j * xi[:, first + 1]).astype(np.complex128)


Layers = list[tuple[Array, Array]]
"""Weights (networks, before, units) and biases (networks, 1, units) of a model's networks, in order."""


def layers_of(model: Model) -> Layers:
    """Return the weights and biases of a marker model's networks."""
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    return [
        (model.tensors[f"layer{i}.weight"].astype(np.float64), model.tensors[f"layer{i}.bias"].astype(np.float64))
        for i in range(len(architecture.hidden) + 1)
    ]


def _aligned(layers: Layers, alignment: CameraAlignment) -> Layers:
    first, last = layers[0], layers[-1]
    shifted = (last[0], last[1] + np.concatenate([alignment.offset, np.zeros(6)]))
    return [(alignment.gain * first[0], first[1]), *layers[1:-1], shifted]


def _interpolated(one: Layers, other: Layers, fraction: float) -> Layers:
    """Return weights interpolated by ``fraction`` from one to the other."""
    return [
        (weight + fraction * (to - weight), bias + fraction * (shift - bias))
        for (weight, bias), (to, shift) in zip(one, other, strict=True)
    ]


def outputs_of(layers: Layers, displacements: NDArray[np.float32], labels: Labels) -> tuple[Array, Array]:
    """Return means (n, 6) in label half-ranges and uncalibrated sigmas of the mixture, of displacements (n, 2 m) px."""
    x: Array = np.broadcast_to(displacements.astype(np.float64), (len(layers[0][0]), *displacements.shape))
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if i + 1 < len(layers):
            x = x / (1.0 + np.exp(-np.maximum(x, -80.0)))
    return mixed(x[..., :6], np.clip(x[..., 6:], *LOG_PRECISION_BOUNDS), labels)


def tune(
    old: Model, layers: Layers, displacements: NDArray[np.float32], target: Array, settings: AdaptSettings
) -> Layers:
    """Fine-tune layers to labelled displacements, regularised towards the given ones.

    Args:
        old: its displacement model scales the inputs.
        layers: initial layers.
        displacements: (n, 2 m) px.
        target: (n, 6) in label half-ranges.
        settings: of the training.

    Raises:
        TrainingError: the loss is not finite.
    """
    model = displacement_model_of(old)
    features = features_of(model)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        tuner = _Tuner(layers, features, model, settings)
        tuner.fit(torch.from_numpy(displacements), torch.from_numpy(target.astype(np.float32)))
    return tuner.layers()


class _Tuner:
    """Trainable changes of weights, initially zero."""

    def __init__(self, layers: Layers, features: Array, model: DisplacementModel, settings: AdaptSettings) -> None:
        self.settings = settings
        self.old = [(torch.from_numpy(w).float(), torch.from_numpy(b).float()) for w, b in layers]
        self.features = torch.from_numpy(features).float()
        self.mean = torch.from_numpy(model.mean).float()
        self.jitter = Jitter(model.reference, settings.shift_px, settings.turn_rad, settings.zoom)
        networks, _, units = layers[0][0].shape
        shapes = [(networks, features.shape[1], units), *(w.shape for w, _ in layers[1:])]
        self.weights = [torch.zeros(shape, requires_grad=True) for shape in shapes]
        self.biases = [torch.zeros(b.shape, requires_grad=True) for _, b in layers]
        # Typical magnitude of a layer's weights, by which changes are scaled.
        self.usual = [1.0 / math.sqrt(shape[1]) for shape in shapes]

    def fit(self, inputs: Tensor, targets: Tensor) -> None:
        settings = self.settings
        optimizer = torch.optim.Adam([*self.weights, *self.biases], lr=settings.learning_rate)
        networks = len(self.old[0][0])
        for step in range(settings.steps):
            for group in optimizer.param_groups:
                rise = min(1.0, (step + 1) / (0.1 * settings.steps))
                group["lr"] = settings.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))
            chosen = torch.randint(len(inputs), (networks, min(settings.batch_size, len(inputs))))
            outputs = self._outputs(self.jitter(inputs[chosen]))
            off = functional.smooth_l1_loss(outputs[..., :6], targets[chosen], beta=0.02, reduction="none")
            held = sum(((w / usual) ** 2).mean() for w, usual in zip(self.weights, self.usual, strict=True))
            loss = off.sum(-1).mean() + settings.hold * held
            if not torch.isfinite(loss):
                raise TrainingError("the loss is not finite", hint="check the labels of the new images")
            optimizer.zero_grad(set_to_none=True)
            (loss * networks).backward()  # type: ignore[no-untyped-call]
            optimizer.step()

    def layers(self) -> Layers:
        """Return the old weights plus the changes, in the format of a model file."""
        found: Layers = []
        for i, ((weight, bias), change, shift) in enumerate(zip(self.old, self.weights, self.biases, strict=True)):
            moved = self.features @ change if i == 0 else change
            found.append((_doubles(weight + moved), _doubles(bias + shift)))
        return found

    def _outputs(self, displacements: Tensor) -> Tensor:
        x = torch.baddbmm(self.old[0][1] + self.biases[0], displacements, self.old[0][0])
        x = x + torch.bmm((displacements - self.mean) @ self.features, self.weights[0])
        rest = zip(self.old[1:], self.weights[1:], self.biases[1:], strict=True)
        for (weight, bias), change, shift in rest:
            x = functional.dropout(functional.silu(x), self.settings.dropout)
            x = torch.baddbmm(bias + shift, x, weight + change)
        return x


def _doubles(tensor: Tensor) -> Array:
    doubles: Array = tensor.detach().numpy().astype(np.float64)
    return doubles
