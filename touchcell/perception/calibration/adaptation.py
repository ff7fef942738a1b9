"""Bringing a marker estimator to another sensor of its kind with a few labelled images. Needs the extra ``train``.

What differs between two such sensors is mostly where the camera looks from and how the labels' axes lie: six numbers
that are found first, so that the old networks see markers and labels as they were taught. The rest - mounts, stiffness,
skin - is left to a short training that holds on to the old weights.
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
from touchcell.perception.networks.marker_training import preprocessing_for

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_REFINED_WITH = 60
_TYPICAL_ERROR = 0.05
_SHALLOW = 5
_TRIED = 30
_FEWEST = 10
_MATCHED = 0.5


@dataclass(frozen=True)
class AdaptSettings:
    """How the networks are brought near.

    Attributes:
        steps: of the training.
        batch_size: contacts per step and network.
        learning_rate: at its peak; it falls as a half cosine.
        hold: how strongly weights are held to the old ones: the loss of one weight that is off by its layer's usual
            size, times the number of weights.
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
class FewShotDataset:
    """Discs of labelled images of the new sensor.

    Attributes:
        frames: of each image, in its preprocessed pixels.
        xi: (n, 6) log(T_s_f), m and rad.
    """

    frames: list[Discs]
    xi: Array


@dataclass(frozen=True)
class CameraAlignment:
    """How a new sensor's images and labels are brought to those of the old.

    Attributes:
        camera: from its pixels to the old sensor's.
        turn_rad: of its label axes about the sensor's axis, to the old sensor's.
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
        data: data set; ``train`` is learned from.
        out: ``NAME.safetensors``.
        frames: so many images, evenly chosen; None for all.
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
            hint="train one with `touchcell train --kind markers`, or this kind anew on the new sensor's images",
        )
    if old.header.camera is not None:
        raise ModelError(model, "was adapted already", key="camera", hint="adapt the model that it came from")
    split = read_split(data, "train")
    chosen = evenly(len(split.images), len(split.images) if frames is None else frames)
    images = [read_image(split.images[i]) for i in chosen]
    preprocessing = preprocessing_for(images[0])
    size = typical_size(preprocessing.reduce(images[0]))
    few = FewShotDataset(
        [detect_markers(preprocessing.reduce(image), size) for image in images],
        xi_from_contact(split.contact_mm_deg[chosen]),
    )
    adapted = adapt_to(old, few, preprocessing=preprocessing, size=size, settings=settings)
    save_model(adapted, out)
    return adapted


def adapt_to(
    old: Model,
    few: FewShotDataset,
    *,
    preprocessing: Preprocessing,
    size: MarkerSize,
    settings: AdaptSettings | None = None,
) -> Model:
    """The model for another sensor, from discs in memory. Arguments as of the model; raises as ``adapt``."""
    settings = settings or AdaptSettings()
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    brought = align_to_sensor(old, few)
    xi, displacements = few.xi[brought.matched], brought.displacements[brought.matched]
    layers, labels = _regained(layers_of(old), brought), old.header.labels
    target = labels.targets(about_z(brought.turn_rad, xi))
    # How far to go from the old weights, and how far to believe the sigmas, contacts tell that were left out.
    even = np.arange(len(xi)) % 2 == 0
    halves = [tune(old, layers, displacements[half], target[half], settings) for half in (even, ~even)]
    errors, standardised = [], []
    for share in _SHARES:
        off, by_sigma = [], []
        for half, trained in zip((~even, even), halves, strict=True):
            mean, sigma = outputs_of(_between(layers, trained, share), displacements[half], labels)
            off.append(np.abs(target[half] - mean))
            by_sigma.append(labels.aligned(target[half] - mean, mean) / sigma ** np.array(old.header.sigma_power))
        errors.append(float(np.concatenate(off).mean()))
        standardised.append(np.concatenate(by_sigma))
    best = int(np.argmin(errors))
    scale = np.sqrt(np.mean(standardised[best] ** 2, axis=0))
    tuned = _between(layers, tune(old, layers, displacements, target, settings), _SHARES[best]) if best else layers
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
            camera=brought.camera,
            label_turn_deg=math.degrees(brought.turn_rad),
            training_data=header.training_data,
            training={
                **header.training,
                "adapted_images": len(few.frames),
                "adapted_images_matched": int(brought.matched.sum()),
                "adapted_share": _SHARES[best],
                **{f"adapted_{key}": value for key, value in asdict(settings).items()},
            },
        ),
        tensors,
    )


def align_to_sensor(old: Model, few: FewShotDataset) -> CameraAlignment:
    """Find camera and label axes.

    A lattice looks the same after a sixth of a turn: of the six cameras that are possible, that one is right, together
    with its turn of the label axes, with which the old networks err least.
    """
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    matcher = matcher_of(old, architecture)
    there = matcher.model.reference
    # By how far |log| is, for want of a depth: the least deformed are the shallowest.
    depth = np.abs(few.xi[:, 2])
    fits = [fit_lattice(few.frames[i], architecture.rings) for i in np.argsort(depth)[:_SHALLOW]]
    here, rms = min(fits, key=lambda each: each[1])
    if not np.isfinite(rms):
        raise TrainingError(
            f"the shallowest images show no lattice of {architecture.rings} rings",
            hint="only a sensor of the same kind can be adapted to; give an image of hardly any contact",
        )
    layers = layers_of(old)
    some = np.linspace(0, len(few.frames) - 1, min(_TRIED, len(few.frames))).round().astype(int)
    best: tuple[float, CameraChange, float] | None = None
    for order in lattice_turns(architecture.rings):
        linear, off = similarity(here[order], there)
        centre = here.mean(axis=0)
        du, dv = there.mean(axis=0) - centre
        camera = CameraChange(
            zoom=abs(linear),
            turn_deg=float(np.degrees(np.angle(linear))),
            centre_px=(float(centre[0]), float(centre[1])),
            shift_px=(float(du), float(dv)),
            frames=1,
            rms_px=off,
        )
        displacements, matched = _seen_by(camera, matcher, [few.frames[i] for i in some])
        if matched.mean() < _MATCHED or matched.sum() < min(_FEWEST, len(some)):
            continue
        mean, _ = outputs_of(layers, displacements[matched], old.header.labels)
        predicted = xi_from_contact(old.header.labels.contacts(mean))
        turn, error = _label_turn(few.xi[some][matched], predicted)
        if best is None or error < best[0]:
            best = (error, camera, turn)
    if best is None:
        raise TrainingError(
            "the markers of too few images can be matched to the old sensor's",
            hint="only a sensor of the same kind can be adapted to; check threshold and crop",
        )
    _, camera, turn = best
    displacements, matched = _seen_by(camera, matcher, few.frames)
    if matched.sum() < _FEWEST:
        raise TrainingError(f"{int(matched.sum())} images could be matched, {_FEWEST} are needed", hint="give more")
    refined = _refined(old, layers, there, displacements[matched], few.xi[matched], turn)
    camera, turn = _composed(camera, refined), turn + float(refined[4])
    displacements, matched = _seen_by(camera, matcher, few.frames)
    return CameraAlignment(camera, turn, float(refined[5]), refined[6:], displacements, matched)


def _refined(
    old: Model, layers: Layers, there: Array, displacements: NDArray[np.float32], xi: Array, turn: float
) -> Array:
    """(12,) what makes the old networks err least: log zoom, turn, shift (2) px of the camera, turn of the label axes,
    gain of the displacements, offset (6) of the outputs in label half-ranges.

    One image of hardly any contact gives the camera to 0.3 %, which depth would feel.
    """
    some = np.linspace(0, len(xi) - 1, min(_REFINED_WITH, len(xi))).round().astype(int)
    middle = there.mean(axis=0)
    labels = old.header.labels
    moved = displacements[some].astype(np.float64).reshape(len(some), -1, 2)

    def residuals(x: Array) -> Array:
        linear = np.exp(x[0]) * np.array([[np.cos(x[1]), -np.sin(x[1])], [np.sin(x[1]), np.cos(x[1])]])
        seen = (there + moved - middle) @ linear.T + middle + x[2:4] - there
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
    """Labels (n, 6) about axes that are turned about the sensor's."""
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
    """Angle about z that brings labels xi (n, 6) to predictions, and the mean error that is left, mm or degrees."""
    a, b = (np.concatenate([_plane(each, 0) / 1e-3, _plane(each, 3) / np.radians(1.0)]) for each in (xi, predicted))
    turn = float(np.angle(np.vdot(a, b)))
    return turn, float(np.abs(a * np.exp(1j * turn) - b).mean())


def _plane(xi: Array, first: int) -> NDArray[np.complex128]:
    return (xi[:, first] + 1j * xi[:, first + 1]).astype(np.complex128)


Layers = list[tuple[Array, Array]]
"""Weights (networks, before, units) and biases (networks, 1, units) of a model's networks, in order."""


def layers_of(model: Model) -> Layers:
    """The networks of a marker model."""
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    return [
        (model.tensors[f"layer{i}.weight"].astype(np.float64), model.tensors[f"layer{i}.bias"].astype(np.float64))
        for i in range(len(architecture.hidden) + 1)
    ]


def _regained(layers: Layers, brought: CameraAlignment) -> Layers:
    first, last = layers[0], layers[-1]
    shifted = (last[0], last[1] + np.concatenate([brought.offset, np.zeros(6)]))
    return [(brought.gain * first[0], first[1]), *layers[1:-1], shifted]


def _between(one: Layers, other: Layers, share: float) -> Layers:
    """Weights a share of the way from one to the other."""
    return [
        (weight + share * (to - weight), bias + share * (shift - bias))
        for (weight, bias), (to, shift) in zip(one, other, strict=True)
    ]


def outputs_of(layers: Layers, displacements: NDArray[np.float32], labels: Labels) -> tuple[Array, Array]:
    """Means (n, 6) in label half-ranges and uncalibrated sigmas of the mixture, of displacements (n, 2 m) px."""
    x: Array = np.broadcast_to(displacements.astype(np.float64), (len(layers[0][0]), *displacements.shape))
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if i + 1 < len(layers):
            x = x / (1.0 + np.exp(-np.maximum(x, -80.0)))
    return mixed(x[..., :6], np.clip(x[..., 6:], *LOG_PRECISION_BOUNDS), labels)


def tune(
    old: Model, layers: Layers, displacements: NDArray[np.float32], target: Array, settings: AdaptSettings
) -> Layers:
    """Layers whose means fit labelled displacements better and that stay near those given.

    Args:
        old: whose displacement model scales the inputs.
        layers: to begin with.
        displacements: (n, 2 m) px.
        target: (n, 6) in label half-ranges.
        settings: of the training.

    Raises:
        TrainingError: the loss is no number.
    """
    model = displacement_model_of(old)
    features = features_of(model)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        tuner = _Tuner(layers, features, model, settings)
        tuner.fit(torch.from_numpy(displacements), torch.from_numpy(target.astype(np.float32)))
    return tuner.layers()


class _Tuner:
    """Changes of weights, that begin at zero."""

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
        # The usual size of a layer's weights, from which a change is large or small.
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
                raise TrainingError("the loss is no number", hint="check the labels of the new images")
            optimizer.zero_grad(set_to_none=True)
            (loss * networks).backward()  # type: ignore[no-untyped-call]
            optimizer.step()

    def layers(self) -> Layers:
        """Old weights and changes together, as a model file has them."""
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
