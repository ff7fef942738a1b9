"""Fit the Gaussian processes that transfer old networks to a new sensor. Needs the extra ``train`` (PyTorch)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.layers import Layers
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.markers.transfer import (
    SHEAR,
    TILT,
    Features,
    Symmetry,
    features,
    kernel,
    lattice_symmetries,
    learned_features,
    plane,
    process_results,
    reflected,
    ring_modes,
    ring_weights,
    symmetric_fields,
    symmetric_outputs,
    turned_back,
)
from touchcell.perception.models.model_file import Labels
from touchcell.perception.models.transfer_spec import BLOCKS, BlockSpec, TransferSpec

COMPONENTS = 12
_START = (0.7, -2.0, -2.0, 0.7, -2.0, -2.0, -2.0, 0.5, -0.7, 0.0, -1.2, -1.2, -0.5, -0.5)
_PRIOR_SD = (0.6, 1.0, 1.0, 0.6, 1.0, 1.0, 1.0, 0.6, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
# Of shear and torsion, of which labels of contacts that have slipped say little: learned from one half of a second real
# sensor's images (decision 72), and so believed more than the others.
_LEARNED = {
    "shear": (0.6, -2.4, -2.0, 0.7, -2.4, -1.8, -2.4, -0.45, 0.2, -0.5, -2.4, -0.8, 0.4, -0.65),
    "torsion": (0.3, -2.3, -1.2, 0.6, -2.6, -2.9, -2.6, 0.0, -0.5, -1.1, 0.0, -0.75, -0.6, -0.5),
}
_BELIEVED = 0.3
_STEPS = 80
_JITTER = 1e-5
_BANKED = 200
_CHOSEN = 20.0


@dataclass(frozen=True)
class OldSensor:
    """Networks of the old sensor and how their outputs turn with the markers.

    Attributes:
        layers: of the networks.
        labels: of the networks.
        reference: (m, 2) px, its lattice.
        symmetries: of the lattice.
        image_turn, mirror_axes_rad, ring_turn_rad: as of ``TransferSpec``.
    """

    layers: Layers
    labels: Labels
    reference: Array
    symmetries: tuple[Symmetry, ...]
    image_turn: Literal[-1, 1]
    mirror_axes_rad: tuple[float, float]
    ring_turn_rad: float

    def outputs(self, displacements: NDArray[Any]) -> tuple[Array, Array]:
        """Return ``symmetric_outputs`` for displacements (n, 2 m) px."""
        fields = symmetric_fields(displacements.astype(np.float64), self.reference, self.symmetries)
        return symmetric_outputs(
            self.layers, fields, self.labels, self.symmetries, self.image_turn, self.mirror_axes_rad
        )


def old_sensor(layers: Layers, labels: Labels, model: DisplacementModel, bank: Array, rings: int) -> OldSensor:
    """Find, from an old sensor's own contacts, how its networks' outputs turn when the markers are turned.

    Args:
        layers, labels: of the networks.
        model: of its displacements.
        bank: (b, k) coefficients of its contacts.
        rings: of its lattice.
    """
    some = bank[:: max(1, len(bank) // _BANKED)]
    displacements = model.mean + some @ model.basis
    symmetries = tuple(lattice_symmetries(rings))
    identity, sixth, mirror = symmetries[0], symmetries[1], symmetries[6]
    fields = symmetric_fields(displacements, model.reference, (identity, sixth, mirror))
    single = tuple(symmetric_outputs(layers, field[None], labels, (identity,), 1, (0.0, 0.0))[0] for field in fields)
    plain, turned, reflected_ = single
    errors = {
        sign: float(np.abs(turned_back(turned, sixth, sign, (0.0, 0.0)) - plain)[:, [SHEAR, TILT]].mean())
        for sign in (1, -1)
    }
    axes = [
        0.5 * float(np.angle(np.vdot(plane(reflected_, first).conj(), plane(plain, first)))) for first in (SHEAR, TILT)
    ]
    image_turn: Literal[-1, 1] = 1 if errors[1] <= errors[-1] else -1
    shift = ring_modes(displacements, ring_weights(model.reference))[:, :, 0].mean(axis=1)
    shift = shift if image_turn > 0 else shift.conj()
    turn = float(np.angle(np.vdot(shift, plane(plain, SHEAR))))
    return OldSensor(layers, labels, model.reference, symmetries, image_turn, (axes[0], axes[1]), turn)


@dataclass(frozen=True)
class Convention:
    """How a new sensor's labels relate to the old networks' outputs.

    Attributes:
        mirrored: in a mirror.
        shear_axes_rad, tilt_axes_rad: angles from the networks' vectors to the labels'.
        shear_explained, tilt_explained: correlation of the labels' shear and tilt with the outputs', as vectors.
    """

    mirrored: bool
    shear_axes_rad: float
    tilt_axes_rad: float
    shear_explained: float
    tilt_explained: float

    @property
    def shear_reversed(self) -> bool:
        """True if shear and tilt of the labels turned by angles more than a right angle apart."""
        return bool(np.cos(self.shear_axes_rad - self.tilt_axes_rad) < 0.0)


def find_convention(outputs: Array, contacts: Array) -> Convention:
    """Return the convention, mirrored or not, in which outputs (n, 6) are most similar to labels (n, 6), mm, deg."""
    found = []
    for mirrored in (False, True):
        angles, explained = [], []
        for first in (SHEAR, TILT):
            a, b = plane(reflected(outputs) if mirrored else outputs, first), plane(contacts, first)
            a, b = a - a.mean(), b - b.mean()
            product = complex(np.vdot(a, b))
            angles.append(float(np.angle(product)))
            explained.append(abs(product) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))
        found.append(Convention(mirrored, *angles, *explained))
    return max(found, key=lambda each: each.shear_explained + each.tilt_explained)


@dataclass(frozen=True)
class Transfer:
    """Fitted processes.

    Attributes:
        spec: their parameters.
        tensors: of the model file.
        reference: (m, 2) px, lattice of the old sensor.
    """

    spec: TransferSpec
    tensors: dict[str, Array]
    reference: Array

    def __call__(self, outputs: Array, displacements: NDArray[Any]) -> tuple[Array, Array]:
        """Return contacts (n, 6) and the processes' standard deviations (n, 6), mm and degrees."""
        scores = (displacements - self.tensors["transfer.mean"]) @ self.tensors["transfer.basis"].T
        rings = ring_modes(displacements, ring_weights(self.reference))
        at = features(self.spec, reflected(outputs) if self.spec.mirrored else outputs, scores, rings)
        learned = learned_features(self.spec, self.tensors)
        return process_results(self.spec, self.tensors, at, learned)


def fit_transfer(old: OldSensor, outputs: Array, displacements: NDArray[Any], contacts: Array) -> Transfer:
    """Fit the processes to labelled contacts, their parameters by maximum a-posteriori evidence.

    Args:
        old: the old sensor.
        outputs: (n, 6) its networks', as ``OldSensor.outputs`` returns them.
        displacements: (n, 2 m) px, as the old camera would have seen them.
        contacts: (n, 6) labels, mm and degrees.

    Raises:
        TrainingError: the labels or outputs do not vary.
    """
    convention = find_convention(outputs, contacts)
    seen = reflected(outputs) if convention.mirrored else outputs
    mean = displacements.mean(axis=0, dtype=np.float64)
    centred = displacements - mean
    _, _, right = np.linalg.svd(centred, full_matrices=False)
    basis = right[: min(COMPONENTS, max(1, len(contacts) - 1))]
    scores = centred @ basis.T
    magnitude = {first: float(np.abs(plane(seen, first)).mean()) for first in (SHEAR, TILT)}
    if min(*magnitude.values(), float(seen.std(axis=0).min()), float(contacts.std(axis=0).min())) < 1e-9:
        raise TrainingError("labels or outputs of the old networks do not vary", hint="collect varied contacts")
    rings = ring_modes(displacements, ring_weights(old.reference))
    units = np.sqrt((np.abs(rings) ** 2).mean(axis=0)) + 1e-9
    placeholder = BlockSpec(kernel=_START, mean=0.0, unit=1.0)
    spec = TransferSpec(
        markers=len(old.reference),
        contacts=len(contacts),
        components=len(basis),
        image_turn=old.image_turn,
        mirror_axes_rad=old.mirror_axes_rad,
        mirrored=convention.mirrored,
        shear_axes_rad=convention.shear_axes_rad,
        tilt_axes_rad=convention.tilt_axes_rad,
        shear_unit_mm=magnitude[SHEAR] * 1.6,
        tilt_unit_deg=magnitude[TILT] * 1.3,
        torsion_unit_deg=float(seen[:, 5].std()),
        depth_unit_mm=float(seen[:, 2].std()),
        output_mean=_six(seen.mean(axis=0)),
        output_sd=_six(seen.std(axis=0)),
        component_unit_px=float(scores.std()),
        ring_turn_rad=old.ring_turn_rad,
        ring_units_px=tuple(units.ravel().tolist()),
        blocks=(placeholder,) * 4,
        network_share=(0.0,) * 6,
        process_share=(1.0,) * 6,
        floor=(0.0,) * 6,
    )
    learned = features(spec, seen, scores, rings)
    tensors = {
        "transfer.outputs": seen,
        "transfer.scores": scores,
        "transfer.rings": np.stack([rings.real, rings.imag], axis=-1),
        "transfer.mean": mean,
        "transfer.basis": basis,
    }
    blocks = []
    for name in BLOCKS:
        block, weights, inverse = _fit_block(name, learned, _targets(name, convention, contacts))
        blocks.append(block)
        tensors |= {f"transfer.{name}.weights": weights, f"transfer.{name}.inverse": inverse}
    return Transfer(spec.model_copy(update={"blocks": tuple(blocks)}), tensors, old.reference)


def with_sigma(transfer: Transfer, residual: Array, network: Array, process: Array) -> Transfer:
    """Return the transfer with shares of the standard deviations fitted to residuals of left-out contacts.

    Args:
        transfer: fitted.
        residual: (n, 6) labels less predictions, along and across the shear, then z, alpha, beta, gamma; mm, degrees.
        network: (n, 6) standard deviations of the old networks.
        process: (n, 6) of the processes.
    """
    shares = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.4, 2.0, 2.8])
    floors = np.array([0.05, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0, 1.2])
    network_share, floor = np.zeros(6), np.zeros(6)
    for i in range(6):
        square = residual[:, i] ** 2
        rms = np.sqrt(square.mean())
        variance = (
            (shares[:, None, None] * network[:, i]) ** 2 + process[:, i] ** 2 + (floors[None, :, None] * rms) ** 2
        )
        cost = (np.log(variance) + square / variance).mean(axis=2)
        best = np.unravel_index(int(np.argmin(cost)), cost.shape)
        network_share[i], floor[i] = shares[best[0]], floors[best[1]] * rms
    # Shares and floors were chosen on these residuals, and the fewer they are, the smaller they come out.
    wider = np.sqrt(1.0 + _CHOSEN / len(residual))
    update = {
        "network_share": _six(wider * network_share),
        "process_share": _six(wider * np.ones(6)),
        "floor": _six(wider * floor),
    }
    return replace(transfer, spec=transfer.spec.model_copy(update=update))


def _targets(name: str, convention: Convention, contacts: Array) -> Array:
    """Return the targets of a block, the two components of a vector stacked, in the networks' axes."""
    if name == "depth":
        return contacts[:, 2]
    if name == "torsion":
        return contacts[:, 5]
    first, axes = (SHEAR, convention.shear_axes_rad) if name == "shear" else (TILT, convention.tilt_axes_rad)
    vector = plane(contacts, first) * np.exp(-1j * axes) * (1.0 if name == "shear" else 1j)
    return np.concatenate([vector.real, vector.imag])


def _fit_block(name: str, learned: Features, values: Array) -> tuple[BlockSpec, Array, Array]:
    mean = float(values.mean()) if name == "depth" else 0.0
    unit = float(np.sqrt(np.mean((values - mean) ** 2)))
    target = torch.from_numpy((values - mean) / unit)[:, None]
    inputs = Features(*(torch.from_numpy(np.ascontiguousarray(each)) for each in vars(learned).values()))
    start = torch.tensor(_LEARNED.get(name, _START), dtype=torch.double)
    sd = (_BELIEVED if name in _LEARNED else 1.0) * torch.tensor(_PRIOR_SD, dtype=torch.double)
    p = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([p])
    identity = torch.eye(len(target), dtype=torch.double)
    for step in range(_STEPS):
        for group in optimizer.param_groups:
            group["lr"] = 0.15 * (1.0 - step / _STEPS) + 0.01
        covariance = kernel(name, p, inputs, inputs, torch) + (torch.exp(2 * p[11]) + _JITTER) * identity
        lower = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(lower, target, upper=False)
        loss = 0.5 * white.square().sum() + lower.diagonal().log().sum() + 0.5 * ((p - start) / sd).square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = p.detach()
    covariance = kernel(name, found, inputs, inputs, torch) + (torch.exp(2 * found[11]) + _JITTER) * identity
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
    spec = BlockSpec(kernel=tuple(found.tolist()), mean=mean, unit=unit)
    return spec, (inverse @ target)[:, 0].numpy(), inverse.numpy()


def _six(values: Array) -> tuple[float, float, float, float, float, float]:
    a, b, c, d, e, f = (float(value) for value in values)
    return a, b, c, d, e, f
