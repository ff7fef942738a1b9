"""Few-shot adaptation of a marker estimator to another sensor of its kind. Needs the extra ``train``.

Two such sensors differ in camera, mount, skin and in the convention of their labels: rotation, mirror, sign of the
shear. The camera is estimated from the markers alone. Then outputs are mapped rather than weights changed: Gaussian
processes take the old networks' outputs to the new labels (``markers.transfer``). Contacts that were left out judge
them beside three rivals: the mean of the labels, an affine map of the old outputs, and networks trained from scratch on
the new contacts alone. The better of the processes and the new networks is written, unless one of the simple rivals
beats both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from touchcell.drivers.replay.dataset import read_rest, read_split
from touchcell.geometry.types import Array
from touchcell.perception.calibration.marked_data import evenly
from touchcell.perception.calibration.transfer_fit import (
    Convention,
    OldSensor,
    Transfer,
    find_convention,
    fit_transfer,
    old_sensor,
    with_sigma,
)
from touchcell.perception.errors import ModelError, TrainingError
from touchcell.perception.markers.camera_check import transferred_check
from touchcell.perception.markers.detection import Discs, detect_markers
from touchcell.perception.markers.estimator import displacement_model_of, matcher_of
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.markers.layers import layers_of, mixed
from touchcell.perception.markers.matching import DisplacementModel, MarkerMatcher
from touchcell.perception.markers.zero_frame import similarity
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.labels import CONTACT_NAMES, contact_from_xi, shear_direction, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Header, Labels, Model, load_model, save_model, touchcell_version
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.contact_network import Alignment
from touchcell.perception.networks.displacement_network import DisplacementNetwork, Jitter, displacement_loss
from touchcell.perception.networks.marker_training import LabelledDiscs, preprocessing_and_size
from touchcell.perception.networks.sigma_scaling import calibrate

_SHALLOW, _LOOKED_AT = 10, 200
_FEWEST = 10
_MATCHED = 0.5
_MOST_PROCESS_CONTACTS = 400
_FOLDS, _FEW = 4, 120
_RIDGE = 0.01
_TAIL_SCALE = 0.6  # Of models that were calibrated on thousands of contacts.
_SECTORS = 8
# A real second sensor has correlations of 0.96, 1.00 and 0.67; of ten images at least 0.87, 0.98 and 0.30.
_LEAST_SIMILAR_DEPTH, _LEAST_SIMILAR_TILT, _LEAST_SIMILAR_SHEAR = 0.6, 0.7, (0.25, 0.4)
_MANY = 24  # Contacts, from which on the second limit of shear holds.
_LEAST_DEPTH_RATIO, _LEAST_TILT_RATIO = 0.05, 0.05
_USEFUL = 0.8
_DOUBTFUL, _FAR = 12.0, 5.0

Method = Literal["transfer", "scratch"]


@dataclass(frozen=True)
class AdaptSettings:
    """Settings of the training from scratch that the transfer is compared with.

    Attributes:
        steps: of the training on sixty images or more; a quarter of them on fewer.
        most_steps: upper bound of the steps, which grow with the number of images.
        batch_size: contacts per step and network.
        learning_rate: at its peak; it falls as a half cosine.
        weight_decay: of AdamW.
        noise: standard deviation added to scaled inputs.
        shift_px, turn_rad, zoom: standard deviations of the jitter.
        seed: of everything random.
    """

    steps: int = 1200
    most_steps: int = 6000
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    noise: float = 0.02
    shift_px: float = 0.5
    turn_rad: float = 0.0022
    zoom: float = 0.00125
    seed: int = 0


@dataclass(frozen=True)
class Adapted:
    """Result of an adaptation.

    Attributes:
        model: for the new sensor.
        method: of the better candidate, which the model holds.
        left_out_mae: (6,) errors of each candidate on contacts that it was not fitted to, mm and degrees, named as
            ``CONTACT_NAMES``.
        convention: of the new labels.
        images, matched: number of images, and of those with reliable markers.
        missing: one sentence for each region of contacts without images.
        no_better: components that are estimated no better than by their mean.
        doubtful: images whose depth or tilt, estimated without them, is many times farther off the label than usual.
    """

    model: Model
    method: Method
    left_out_mae: dict[str, Array]
    convention: Convention
    images: int
    matched: int
    missing: tuple[str, ...]
    no_better: tuple[str, ...]
    doubtful: tuple[str, ...]


def adapt(
    model: Path, data: Path, out: Path, *, frames: int | None = None, settings: AdaptSettings | None = None
) -> Adapted:
    """Write ``out``, a model for the sensor that took ``data/train``, with the data set's image out of contact.

    Args:
        model: model file of kind markers.
        data: data set; ``train`` is used.
        out: ``NAME.safetensors``.
        frames: number of images, chosen evenly over the depths; None for all.
        settings: None for the defaults.

    Raises:
        ModelError: the model is of another kind, or was adapted already.
        DataError: the data set is damaged.
        TrainingError: fewer than ten images can be matched to the old sensor's markers, or no candidate is better than
            the mean of the labels and an affine map; nothing is written.
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
    by_depth = np.argsort(split.contact_mm_deg[:, 2], kind="stable")
    chosen = by_depth[evenly(len(by_depth), len(by_depth) if frames is None else frames)]
    split = replace(split, images=tuple(split.images[i] for i in chosen), contact_mm_deg=split.contact_mm_deg[chosen])
    images = list(split.read())
    preprocessing, size = preprocessing_and_size(images)
    dataset = LabelledDiscs(
        [detect_markers(preprocessing.reduce(image), size) for image in images],
        xi_from_contact(split.contact_mm_deg),
    )
    names = [path.name for path in split.images]
    adapted = adapt_to(old, dataset, preprocessing=preprocessing, size=size, settings=settings, names=names)
    rest = read_rest(data)
    # A cell's contact gate compares with it.
    reference = None if rest is None else preprocessing.reduce(rest)
    adapted = replace(adapted, model=replace(adapted.model, reference=reference))
    save_model(adapted.model, out)
    return adapted


def adapt_to(
    old: Model,
    dataset: LabelledDiscs,
    *,
    preprocessing: Preprocessing,
    size: MarkerSize,
    settings: AdaptSettings | None = None,
    names: Sequence[str] = (),
) -> Adapted:
    """Return the model for another sensor, from discs in memory. Arguments as of the model; raises as ``adapt``.

    ``names`` are the images', for ``Adapted.doubtful``; without them these are numbers.
    """
    settings = settings or AdaptSettings()
    camera, displacements, matched = align_camera(old, dataset)
    if matched.sum() < _FEWEST:
        raise TrainingError(f"{int(matched.sum())} images could be matched, {_FEWEST} are needed", hint="give more")
    contacts = contact_from_xi(dataset.xi[matched])
    candidates = _Candidates(old, displacements[matched], contacts, settings)
    used = [names[i] if names else f"image {i}" for i in range(len(matched)) if matched[i]]
    refuse_outliers(contacts, used)
    convention = find_convention(candidates.outputs, contacts)
    refuse_unlike(candidates.outputs, contacts, convention)
    method, left_out = candidates.judged()
    update: dict[str, object] = {"input_size": preprocessing.output_size, "size": size}
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    labels, tensors = candidates.labels, dict(old.tensors)
    check, check_tensors = transferred_check(
        displacement_model_of(old), architecture.rings, displacements[matched].astype(np.float64)
    )
    update["camera_check"] = check
    tensors |= check_tensors
    sigma_scale, sigma_power, transfer = (1.0,) * 6, (1.0,) * 6, None
    if method == "transfer":
        fitted = candidates.transfer()
        transfer = fitted.spec
        tensors |= {name: np.ascontiguousarray(each, dtype=np.float32) for name, each in fitted.tensors.items()}
    else:
        trained, scale, power = candidates.scratch()
        tensors |= trained
        sigma_scale, sigma_power = tuple(scale.tolist()), tuple(power.tolist())
    model = Model(
        Header(
            touchcell_version=touchcell_version(),
            architecture=architecture.model_copy(update=update),
            preprocessing=preprocessing,
            labels=labels,
            sigma_scale=sigma_scale,
            sigma_power=sigma_power,
            tail_scale=_TAIL_SCALE,
            camera=camera,
            transfer=transfer,
            network_labels=None if transfer is None else old.header.labels,
            training_data=old.header.training_data,
            training={
                **old.header.training,
                "adapted_images": len(dataset.frames),
                "adapted_images_matched": int(matched.sum()),
                "adapted_by": method,
                **{f"left_out_mae_{name}": each.tolist() for name, each in left_out.items()},
                **{f"adapted_{key}": value for key, value in asdict(settings).items()},
            },
        ),
        tensors,
    )
    mean = left_out["mean"]
    return Adapted(
        model=model,
        method=method,
        left_out_mae=left_out,
        convention=convention,
        images=len(dataset.frames),
        matched=int(matched.sum()),
        missing=missing_contacts(contacts),
        no_better=tuple(
            name for name, error, limit in zip(CONTACT_NAMES, left_out[method], mean, strict=True) if error >= limit
        ),
        doubtful=tuple(used[i] for i in candidates.doubtful(method)),
    )


def refuse_outliers(contacts: Array, names: Sequence[str]) -> None:
    """Raise TrainingError where a label of contacts (n, 6) is far from all others, with the image's name."""
    low, middle, high = np.quantile(contacts, [0.1, 0.5, 0.9], axis=0)
    off = np.abs(contacts - middle) / np.maximum(high - low, 1e-6)
    i, component = divmod(int(np.argmax(off)), off.shape[1])
    if off[i, component] > _FAR:
        raise TrainingError(
            f"{names[i]}: {CONTACT_NAMES[component]} of {contacts[i, component]:g} is far from all others",
            hint="check the row of this image",
        )


def refuse_unlike(outputs: Array, contacts: Array, convention: Convention) -> None:
    """Refuse labels that cannot be of these images, whatever their convention.

    Args:
        outputs: (n, 6) of the old networks, mm and degrees.
        contacts: (n, 6) labels.
        convention: in which they are most similar.

    Raises:
        TrainingError: the labels are in other units, or their depth, tilt or shear is unlike what the images show.
    """
    spread = contacts.std(axis=0) / np.maximum(outputs.std(axis=0), 1e-9)
    for name, ratio, least, unit in (
        ("depth", spread[2], _LEAST_DEPTH_RATIO, "mm"),
        ("tilt", float(np.hypot(*spread[3:5])) / math.sqrt(2.0), _LEAST_TILT_RATIO, "degrees"),
    ):
        if not least < ratio < 1.0 / least:
            raise TrainingError(
                f"the labels' {name} varies {ratio:.2g} times as much as the images show",
                hint=f"labels are in mm and degrees, {name} in {unit}",
            )
    depth = float(np.corrcoef(outputs[:, 2], contacts[:, 2])[0, 1])
    if depth < -_LEAST_SIMILAR_DEPTH:
        raise TrainingError(
            "the labels' depth is smaller where the images show deeper contacts",
            hint="depth (pose_z) is positive, and grows into the surface",
        )
    found = (
        ("depth", depth, _LEAST_SIMILAR_DEPTH),
        ("tilt", convention.tilt_explained, _LEAST_SIMILAR_TILT),
        ("shear", convention.shear_explained, _LEAST_SIMILAR_SHEAR[len(contacts) >= _MANY]),
    )
    unlike = [name for name, similar, least in found if similar < least]
    if unlike:
        figures = ", ".join(f"{name} {similar:.2f}" for name, similar, _ in found)
        raise TrainingError(
            f"the labels' {' and '.join(unlike)} cannot be what the images show (correlation: {figures})",
            hint="check which column is which, and which image belongs to which row",
        )


def align_camera(old: Model, dataset: LabelledDiscs) -> tuple[CameraChange, NDArray[np.float32], NDArray[np.bool_]]:
    """Estimate the camera from the markers alone, and match all images as the old camera would have seen them.

    Which of the lattice's six directions is the first makes no difference: the networks are evaluated for all.

    Returns:
        The camera, displacements (n, 2 m) px and reliable matches (n,).

    Raises:
        TrainingError: no lattice is found, or the markers of half of the images cannot be matched.
    """
    architecture = old.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    matcher = matcher_of(old, architecture)
    old_lattice = matcher.model.reference
    by_depth = np.argsort(contact_from_xi(dataset.xi)[:, 2])
    # Labels may be of other images; then a shallow contact is among the others.
    for some in (by_depth[:_SHALLOW], by_depth[_SHALLOW:]):
        fits = [fit_lattice(dataset.frames[i], architecture.rings) for i in some[:_LOOKED_AT]]
        lattice, rms = min(fits, key=lambda each: each[1], default=(old_lattice, np.inf))
        if np.isfinite(rms):
            break
    else:
        raise TrainingError(
            f"no lattice of {architecture.rings} rings found in the shallowest images",
            hint="only a sensor of the same kind can be adapted to; give an image of hardly any contact",
        )
    linear, off = similarity(lattice, old_lattice)
    centre = lattice.mean(axis=0)
    du, dv = old_lattice.mean(axis=0) - centre
    camera = CameraChange(
        zoom=abs(linear),
        turn_deg=float(np.degrees(np.angle(linear))),
        centre_px=(float(centre[0]), float(centre[1])),
        shift_px=(float(du), float(dv)),
        frames=1,
        rms_px=off,
    )
    displacements, matched = _seen_by(camera, matcher, dataset.frames)
    if matched.mean() < _MATCHED:
        raise TrainingError(
            f"the markers of {int(matched.sum())} of {len(matched)} images can be matched to the old sensor's",
            hint="only a sensor of the same kind can be adapted to; check threshold and crop",
        )
    return camera, displacements, matched


def _seen_by(
    camera: CameraChange, matcher: MarkerMatcher, frames: list[Discs]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    fields = [matcher.match(Discs(camera.points(discs.centres), discs.areas)) for discs in frames]
    displacements = np.stack([each.displacements.ravel() for each in fields]).astype(np.float32)
    return displacements, np.array([each.valid for each in fields])


def missing_contacts(contacts: Array) -> tuple[str, ...]:
    """Describe the regions without contacts, of contacts (n, 6), mm and degrees: depths, directions of shear and tilt.

    A gap counts where so many uniformly drawn contacts would rarely leave one.
    """
    n, found = len(contacts), []
    for column, name, unit in ((2, "depths", "mm"), (5, "torsions", "deg")):
        values = np.sort(contacts[:, column])
        usual = np.ptp(values) * min(0.5, (np.log(n) + 3.0) / n)
        found += [
            f"{name} between {low:.1f} and {high:.1f} {unit}" for low, high in pairwise(values) if high - low > usual
        ]
    for first, name in ((0, "shear"), (3, "tilt")):
        angle = np.degrees(np.arctan2(contacts[:, first + 1], contacts[:, first])) % 360.0
        empty = np.flatnonzero(np.bincount((angle * _SECTORS / 360.0).astype(int) % _SECTORS, minlength=_SECTORS) == 0)
        side = 360.0 / _SECTORS
        if n >= 2 * _SECTORS:
            found += [f"{name} towards {side * i:.0f} to {side * (i + 1):.0f} deg" for i in empty]
    return tuple(found)


class _Candidates:
    """Candidates for the new estimator, and their errors on contacts that they were not fitted to."""

    def __init__(
        self, old: Model, displacements: NDArray[np.float32], contacts: Array, settings: AdaptSettings
    ) -> None:
        architecture = old.header.architecture
        assert isinstance(architecture, MarkerArchitecture)
        self._architecture, self._settings = architecture, settings
        self._model = displacement_model_of(old)
        self._displacements, self._contacts = displacements, contacts
        self._old: OldSensor = old_sensor(
            layers_of(old), old.header.labels, self._model, old.tensors["bank"].astype(np.float64), architecture.rings
        )
        self.outputs, self._network_sigma = self._old.outputs(displacements)
        self.labels = _range(contacts)
        self._residual = np.full(contacts.shape, np.nan)
        self._process_sigma = np.full(contacts.shape, np.nan)
        self._scratch_mean = np.full(contacts.shape, np.nan)
        self._scratch_sigma = np.full(contacts.shape, np.nan)

    def judged(self) -> tuple[Method, dict[str, Array]]:
        """Return the better candidate and the (6,) errors of all. Raises TrainingError where neither is better."""
        n = len(self._contacts)
        folds = _FOLDS if n <= _FEW else 2
        part = np.random.default_rng(self._settings.seed).permutation(np.arange(n) % folds)
        off = {name: np.empty((n, 6)) for name in ("mean", "affine", "transfer", "scratch")}
        for fold in range(folds):
            left, kept = part == fold, part != fold
            truth = self._contacts[left]
            off["mean"][left] = np.median(self._contacts[kept], axis=0) - truth
            off["affine"][left] = _affine(self.outputs[kept], self._contacts[kept])(self.outputs[left]) - truth
            predicted = self._transferred(kept, left)
            off["transfer"][left] = predicted - truth
            off["scratch"][left] = self._trained(kept, left) - truth
        errors = {name: np.abs(each).mean(axis=0) for name, each in off.items()}
        relative = {name: float((each / errors["mean"]).mean()) for name, each in errors.items()}
        method: Method = "transfer" if relative["transfer"] <= relative["scratch"] else "scratch"
        # Of labels that say nothing, one candidate or other is a little better than their mean by chance.
        relative["mean"] *= _USEFUL
        simple = min(("mean", "affine"), key=lambda name: relative[name])
        if relative[method] >= relative[simple]:
            what = "predicting the mean of the labels" if simple == "mean" else "an affine map of the old outputs"
            raise TrainingError(
                f"nothing that was fitted is better on left-out contacts than {what}",
                hint="check the labels (columns, order, which image belongs to which row), or give more images",
            )
        return method, errors

    def doubtful(self, method: Method) -> NDArray[np.intp]:
        """Return the indices of contacts whose label is off the chosen candidate's estimate without them.

        By many times the usual error, and by more than the labels vary.
        """
        residual = self._residual
        if method == "scratch":
            residual = self._contacts - self.labels.contacts(self._scratch_mean)
        off = np.abs(residual[:, 2:5])
        guessed = np.abs(self._contacts - np.median(self._contacts, axis=0)).mean(axis=0)[2:5]
        far: NDArray[np.intp] = np.flatnonzero(
            (off > np.maximum(_DOUBTFUL * np.median(off, axis=0), guessed)).any(axis=1)
        )
        return far

    def transfer(self) -> Transfer:
        """Return the processes fitted to all contacts, with sigmas from the left-out ones."""
        chosen = _spread_out(self._contacts, _MOST_PROCESS_CONTACTS)
        fitted = fit_transfer(self._old, self.outputs[chosen], self._displacements[chosen], self._contacts[chosen])
        predicted = self._contacts - self._residual
        along = shear_direction(predicted)
        residual = self._residual.copy()
        residual[:, 0] = (along * self._residual[:, :2]).sum(axis=1)
        residual[:, 1] = along[:, 0] * self._residual[:, 1] - along[:, 1] * self._residual[:, 0]
        return with_sigma(fitted, residual, self._network_sigma, self._process_sigma)

    def scratch(self) -> tuple[dict[str, NDArray[np.float32]], Array, Array]:
        """Return tensors of networks trained on all contacts, and scale and power of their sigmas."""
        network = self._train(np.ones(len(self._contacts), bool))
        target = (self._contacts - self.labels.centre) / self.labels.half_range
        residual = self.labels.aligned(target - self._scratch_mean, self._scratch_mean)
        return network.folded(), *calibrate(residual, self._scratch_sigma)

    def _transferred(self, kept: NDArray[np.bool_], left: NDArray[np.bool_]) -> Array:
        chosen = np.flatnonzero(kept)[_spread_out(self._contacts[kept], _MOST_PROCESS_CONTACTS)]
        fitted = fit_transfer(self._old, self.outputs[chosen], self._displacements[chosen], self._contacts[chosen])
        predicted, self._process_sigma[left] = fitted(self.outputs[left], self._displacements[left])
        self._residual[left] = self._contacts[left] - predicted
        return predicted

    def _trained(self, kept: NDArray[np.bool_], left: NDArray[np.bool_]) -> Array:
        network = self._train(kept)
        with torch.inference_mode():
            inputs = torch.from_numpy(self._displacements[left]).expand(self._architecture.networks, -1, -1)
            outputs = network(inputs).numpy().astype(np.float64)
        mean, sigma = mixed(outputs[..., :6], outputs[..., 12:], self.labels)
        self._scratch_mean[left], self._scratch_sigma[left] = mean, sigma
        return self.labels.contacts(mean)

    def _train(self, kept: NDArray[np.bool_]) -> DisplacementNetwork:
        """Train networks on some contacts alone."""
        target = (self._contacts[kept] - self.labels.centre) / self.labels.half_range
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._settings.seed)
            network = DisplacementNetwork(self._model, self._architecture.hidden, self._architecture.networks)
            _fit(network, self._displacements[kept], target, self._model, Alignment(self.labels), self._settings)
        return network.eval()


def _fit(
    network: DisplacementNetwork,
    displacements: NDArray[np.float32],
    target: Array,
    model: DisplacementModel,
    alignment: Alignment,
    settings: AdaptSettings,
) -> None:
    inputs, targets = torch.from_numpy(displacements), torch.from_numpy(target.astype(np.float32))
    n, networks = len(inputs), len(network.weights[0])
    steps = settings.steps if n >= 45 else settings.steps // 4
    steps = max(steps, min(settings.most_steps, 60 * n // settings.batch_size))
    jitter = Jitter(model.reference, settings.shift_px, settings.turn_rad, settings.zoom)
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    for step in range(steps):
        for group in optimizer.param_groups:
            rise = min(1.0, (step + 1) / (0.05 * steps))
            group["lr"] = settings.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        chosen = torch.randint(n, (networks, min(settings.batch_size, n)))
        loss = displacement_loss(network(jitter(inputs[chosen]), settings.noise), targets[chosen], alignment)
        if not torch.isfinite(loss):
            raise TrainingError("the loss is not finite", hint="check the labels of the new images")
        optimizer.zero_grad(set_to_none=True)
        (loss * networks).backward()  # type: ignore[no-untyped-call]
        optimizer.step()


def _affine(outputs: Array, contacts: Array) -> Callable[[Array], Array]:
    """Fit an affine map by ridge regression."""
    mean, sd, middle = outputs.mean(axis=0), outputs.std(axis=0) + 1e-9, contacts.mean(axis=0)
    x = (outputs - mean) / sd
    matrix = np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(6), x.T @ (contacts - middle))
    return lambda other: (other - mean) / sd @ matrix + middle


def _range(contacts: Array) -> Labels:
    """Return labels that span contacts (n, 6), and beyond by twice the mean distance of n uniformly drawn ones."""
    low, high = contacts.min(axis=0), contacts.max(axis=0)
    if (high - low < 1e-6).any():
        name = CONTACT_NAMES[int(np.argmin(high - low))]
        raise TrainingError(f"all labels have the same {name}", hint="collect contacts with varied values of it")
    margin = 2.0 * (high - low) / (len(contacts) - 1)
    return Labels.of_contacts(tuple((low - margin).tolist()), tuple((high + margin).tolist()))


def _spread_out(contacts: Array, most: int) -> NDArray[np.intp]:
    """Return the indices of at most so many contacts, evenly over the depths."""
    order = np.argsort(contacts[:, 2], kind="stable")
    chosen: NDArray[np.intp] = order[np.array(evenly(len(order), most))]
    return chosen
