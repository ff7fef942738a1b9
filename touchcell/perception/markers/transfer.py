"""Contacts of a new sensor from the networks of an old one, by Gaussian processes. NumPy only.

A tip is nearly symmetric: when its markers turn or are reflected, shear and tilt turn or are reflected with them. So
the old networks are evaluated for the twelve symmetric copies of a marker field, and the mean of their results, turned
back, serves as a feature. The processes' covariance is a sum of one that is exactly symmetric - a vector is a sum of
the networks' shear and tilt vectors and of what rings of markers do, with coefficients that depend on depth and
magnitudes - and one without symmetry, of those features and the first principal components of the new sensor's
displacements, for what its mount and camera break of it. Exact inference as in Rasmussen & Williams 2006, chapter 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.markers.detection import lattice, ring_numbers, rings_of
from touchcell.perception.markers.layers import Layers, outputs_of
from touchcell.perception.models.labels import XI_UNITS
from touchcell.perception.models.model_file import Labels, Model
from touchcell.perception.models.transfer_spec import BANDS, BLOCKS, PAIRS, TransferSpec

SHEAR, TILT = 0, 3


@dataclass(frozen=True)
class Symmetry:
    """One of the twelve symmetries of a hexagonal lattice.

    Attributes:
        sixths: rotation by that many times 60 degrees, after the reflection.
        mirrored: reflected about the lattice's first direction.
        to: (m,) marker onto whose place each marker is mapped.
    """

    sixths: int
    mirrored: bool
    to: NDArray[np.intp]


def lattice_symmetries(rings: int) -> list[Symmetry]:
    """Return the twelve symmetries of a lattice, the identity first."""
    flat = lattice(rings) @ np.array([1.0, 1.0j])
    found = []
    for mirrored in (False, True):
        for sixths in range(6):
            moved = np.exp(1j * np.pi / 3 * sixths) * (flat.conj() if mirrored else flat)
            found.append(Symmetry(sixths, mirrored, np.abs(moved[:, None] - flat).argmin(axis=1)))
    return found


def symmetric_fields(displacements: Array, reference: Array, symmetries: Sequence[Symmetry]) -> NDArray[np.float32]:
    """Return the symmetric copies (copies, n, 2 m) px of marker displacements (n, 2 m) px from ``reference`` (m, 2)."""
    centre = reference.mean(axis=0)
    place = (reference - centre) @ np.array([1.0, 1.0j])
    rings = lattice(rings_of(len(reference))) @ np.array([1.0, 1.0j])
    first = np.exp(1j * np.angle(np.vdot(rings, place)))
    position = place + displacements.reshape(len(displacements), -1, 2) @ np.array([1.0, 1.0j])
    copies = np.empty((len(symmetries), *displacements.shape), np.float32)
    for copy, each in zip(copies, symmetries, strict=True):
        moved = np.exp(1j * np.pi / 3 * each.sixths) * (first**2 * position.conj() if each.mirrored else position)
        off = np.empty_like(moved)
        off[:, each.to] = moved
        off -= place
        copy[:, 0::2], copy[:, 1::2] = off.real, off.imag
    return copies


def turned_back(contacts: Array, each: Symmetry, image_turn: int, mirror_axes_rad: tuple[float, float]) -> Array:
    """Return contacts (n, 6) of a symmetric copy as contacts of the original."""
    back = contacts.copy()
    turn = np.exp(-1j * np.pi / 3 * each.sixths * image_turn)
    for first, axis in zip((SHEAR, TILT), mirror_axes_rad, strict=True):
        vector = turn * plane(contacts, first)
        set_plane(back, first, np.exp(2j * axis) * vector.conj() if each.mirrored else vector)
    if each.mirrored:
        back[:, 5] = -back[:, 5]
    return back


def plane(values: Array, first: int) -> NDArray[np.complex128]:
    """Return the vectors (n,) in columns ``first`` and the next, as complex numbers."""
    return (values[:, first] + 1j * values[:, first + 1]).astype(np.complex128)


def set_plane(values: Array, first: int, vectors: NDArray[np.complex128]) -> None:
    """Store complex vectors (n,) in columns ``first`` and the next."""
    values[:, first], values[:, first + 1] = vectors.real, vectors.imag


def symmetric_outputs(
    layers: Layers,
    fields: NDArray[np.float32],
    labels: Labels,
    symmetries: Sequence[Symmetry],
    image_turn: int,
    mirror_axes_rad: tuple[float, float],
) -> tuple[Array, Array]:
    """Return the networks' mean contacts over all copies, and their standard deviations for the first.

    Args:
        layers: of the networks.
        fields: (copies, n, 2 m) px.
        labels: of the networks.
        symmetries: of the copies.
        image_turn, mirror_axes_rad: as of ``TransferSpec``.

    Returns:
        (n, 6) mm and degrees, and (n, 6) along and across the shear, then z, alpha, beta, gamma.
    """
    copies, n, width = fields.shape
    mean, sigma = outputs_of(layers, fields.reshape(copies * n, width), labels)
    contacts = labels.contacts(mean).reshape(copies, n, 6)
    back = [turned_back(c, each, image_turn, mirror_axes_rad) for c, each in zip(contacts, symmetries, strict=True)]
    unit = labels.sigma_unit if labels.are_contacts else labels.sigma_unit / XI_UNITS
    return np.mean(back, axis=0), sigma[:n] * unit


def learned_features(spec: TransferSpec, tensors: dict[str, Array]) -> Features:
    """Return the inputs at the labelled contacts."""
    rings = tensors["transfer.rings"]
    return features(spec, tensors["transfer.outputs"], tensors["transfer.scores"], rings[..., 0] + 1j * rings[..., 1])


@dataclass(frozen=True)
class Features:
    """Inputs of the Gaussian processes.

    Attributes:
        invariants: (n, 5) depth, magnitudes of shear, tilt and torsion, and their relative direction.
        odd: (n, 2) that change sign in a mirror.
        vectors: (2, n, 4) that turn with the tip.
        outputs: (n, 6) standardised outputs of the networks.
        scores: (n, k) principal components of the displacements.
        ring_vectors: (2, n, 2 bands) ``ring_modes`` that turn with the tip.
        ring_scalars, ring_odd: (n, bands) those that stay, and those that change sign in a mirror.
    """

    invariants: Any
    odd: Any
    vectors: Any
    outputs: Any
    scores: Any
    ring_vectors: Any
    ring_scalars: Any
    ring_odd: Any


def ring_weights(reference: Array) -> NDArray[np.complex128]:
    """Return the (bands, 3, m) weights of the markers of a lattice (m, 2) px in ``ring_modes``."""
    place = (reference - reference.mean(axis=0)) @ np.array([1.0, 1.0j])
    around = np.exp(-1j * np.angle(place))
    number = ring_numbers(rings_of(len(reference)))
    bands = np.array_split(np.unique(number[number > 0]), min(BANDS, int(number.max())))
    inside = [np.isin(number, band) for band in bands]
    return np.array([[each * around**mode / each.sum() for mode in range(3)] for each in inside])


def ring_modes(displacements: NDArray[Any], weights: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return (n, bands, 3) px: how far marker displacements (n, 2 m) px shift, widen and turn, and bend bands of rings.

    The displacement u + i v along a ring is a Fourier series in the polar angle. When the markers turn with the tip,
    coefficient 0, the shift of the ring, turns with them; so does the conjugate of coefficient 2. Coefficient 1 stays:
    its real part is radial, its imaginary one tangential.

    Args:
        displacements: of the markers.
        weights: of ``ring_weights``.
    """
    moved = displacements.reshape(len(displacements), -1, 2) @ np.array([1.0, 1.0j])
    modes: NDArray[np.complex128] = np.einsum("nm,bkm->nbk", moved, weights)
    modes[:, :, 2] = modes[:, :, 2].conj()
    return modes


def features(spec: TransferSpec, outputs: Array, scores: Array, rings: NDArray[np.complex128]) -> Features:
    """Return the inputs of the processes.

    Args:
        spec: units and convention.
        outputs: (n, 6) of the networks, mm and degrees.
        scores: (n, k) px components of the displacements.
        rings: (n, bands, 3) px, of ``ring_modes``.
    """
    shear, tilt = plane(outputs, SHEAR) / spec.shear_unit_mm, 1j * plane(outputs, TILT) / spec.tilt_unit_deg
    torsion = outputs[:, 5] / spec.torsion_unit_deg
    depth = (outputs[:, 2] - spec.output_mean[2]) / spec.depth_unit_mm
    product = shear.conj() * tilt
    vectors = np.stack([shear, tilt, 1j * torsion * shear, 1j * torsion * tilt], axis=1)
    units = np.array(spec.ring_units_px).reshape(-1, 3)
    turning = np.exp(1j * spec.ring_turn_rad) * (rings if spec.image_turn > 0 else rings.conj())
    turning = turning.conj() if spec.mirrored else turning
    turning = (turning / units)[:, :, [0, 2]].reshape(len(rings), -1)
    staying = rings[:, :, 1] / units[:, 1]
    return Features(
        invariants=np.stack([depth, np.abs(shear), np.abs(tilt), np.abs(torsion), product.real], axis=1),
        odd=np.stack([torsion, product.imag], axis=1),
        vectors=np.stack([vectors.real, vectors.imag]),
        outputs=(outputs - np.array(spec.output_mean)) / np.array(spec.output_sd),
        scores=scores / spec.component_unit_px,
        ring_vectors=np.stack([turning.real, turning.imag]),
        ring_scalars=staying.real,
        ring_odd=staying.imag,
    )


def kernel(block: str, p: Any, a: Features, b: Features, xp: Any = np) -> Any:
    """Return the prior covariance of a block's functions at ``a`` (rows) and ``b`` (columns).

    Args:
        block: of ``BLOCKS``; the two components of a pair are stacked.
        p: (14,) logarithms: length and amplitude, and slope, of the outputs and of the components; constant; length,
            amplitude and constant of the invariant functions; amplitude of those of other vectors; noise; amplitude and
            constant of those of the rings.
        a, b: inputs.
        xp: NumPy, or PyTorch where ``p`` is differentiated.
    """
    ringed = _bell(xp, a.invariants, b.invariants, p[7], p[12]) + xp.exp(2 * p[13])
    plain = _bell(xp, a.outputs, b.outputs, p[0], p[1]) + _slope(xp, a.outputs, b.outputs, p[2])
    plain = plain + _bell(xp, a.scores, b.scores, p[3], p[4]) + _slope(xp, a.scores, b.scores, p[5]) + xp.exp(2 * p[6])
    own = _bell(xp, a.invariants, b.invariants, p[7], p[8]) + xp.exp(2 * p[9])
    other = _bell(xp, a.invariants, b.invariants, p[7], p[10])
    if block == "depth":
        return (
            plain + own + _slope(xp, a.invariants, b.invariants, p[10]) + ringed * _dot(a.ring_scalars, b.ring_scalars)
        )
    if block == "torsion":
        torsion, product = (a.odd[:, i, None] * b.odd[None, :, i] for i in (0, 1))
        return plain + torsion * own + product * other + ringed * _dot(a.ring_odd, b.ring_odd)
    rows = []
    for i in (0, 1):
        row = []
        for j in (0, 1):
            value = plain if i == j else 0.0
            for number in range(4):
                common = own if number == PAIRS.index(block) else other
                value = value + a.vectors[i, :, number, None] * b.vectors[j, None, :, number] * common
            value = value + ringed * _dot(a.ring_vectors[i], b.ring_vectors[j])
            row.append(value)
        rows.append(xp.concatenate(row, 1))
    return xp.concatenate(rows, 0)


def _dot(a: Any, b: Any) -> Any:
    return a @ b.T / a.shape[1]


def _bell(xp: Any, a: Any, b: Any, length: Any, amplitude: Any) -> Any:
    square = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2.0 * a @ b.T
    return xp.exp(2 * amplitude) * xp.exp(-0.5 * square / (xp.exp(2 * length) * a.shape[1]))


def _slope(xp: Any, a: Any, b: Any, amplitude: Any) -> Any:
    return xp.exp(2 * amplitude) * (a @ b.T) / a.shape[1]


def process_results(
    spec: TransferSpec, tensors: dict[str, Array], at: Features, learned: Features
) -> tuple[Array, Array]:
    """Return posterior contacts (n, 6) in the labels' convention, and standard deviations (n, 6), mm and degrees."""
    n = len(at.outputs)
    contacts, sigma = np.empty((n, 6)), np.empty((n, 6))
    for name, block in zip(BLOCKS, spec.blocks, strict=True):
        p = np.array(block.kernel)
        across = kernel(name, p, at, learned)
        value = across @ tensors[f"transfer.{name}.weights"] * block.unit + block.mean
        explained = ((across @ tensors[f"transfer.{name}.inverse"]) * across).sum(axis=1)
        # Only the diagonal of the prior is needed: one input at a time.
        prior = np.concatenate([np.diagonal(kernel(name, p, one, one)) for one in _single(at)])
        rows = 2 if name in PAIRS else 1
        prior = prior.reshape(n, rows).T.ravel()
        spread = np.sqrt(np.maximum(prior - explained, 1e-12)) * block.unit
        if name == "depth":
            contacts[:, 2], sigma[:, 2] = value, spread
        elif name == "torsion":
            contacts[:, 5], sigma[:, 5] = value, spread
        else:
            first, axes = (SHEAR, spec.shear_axes_rad) if name == "shear" else (TILT, spec.tilt_axes_rad)
            vector = value[:n] + 1j * value[n:]
            set_plane(contacts, first, (vector if name == "shear" else -1j * vector) * np.exp(1j * axes))
            both = np.sqrt(0.5 * (spread[:n] ** 2 + spread[n:] ** 2))
            sigma[:, first] = sigma[:, first + 1] = both
    return contacts, sigma


def _single(at: Features) -> list[Features]:
    return [
        Features(
            at.invariants[i : i + 1],
            at.odd[i : i + 1],
            at.vectors[:, i : i + 1],
            at.outputs[i : i + 1],
            at.scores[i : i + 1],
            at.ring_vectors[:, i : i + 1],
            at.ring_scalars[i : i + 1],
            at.ring_odd[i : i + 1],
        )
        for i in range(len(at.outputs))
    ]


def reflected(outputs: Array) -> Array:
    """Return outputs (n, 6) of the networks as in a mirror along the second axis."""
    other = outputs.copy()
    set_plane(other, SHEAR, plane(outputs, SHEAR).conj())
    set_plane(other, TILT, -plane(outputs, TILT).conj())
    other[:, 5] = -outputs[:, 5]
    return other


class TransferredNetworks:
    """Networks of an old sensor with the Gaussian processes that transfer them to a new one.

    Args:
        model: with ``header.transfer``.
        reference: (m, 2) px, lattice of the old sensor.
    """

    def __init__(self, model: Model, layers: Layers, reference: Array) -> None:
        header = model.header
        assert header.transfer is not None
        assert header.network_labels is not None
        self._spec: TransferSpec = header.transfer
        self._labels, self._network_labels = header.labels, header.network_labels
        self._layers = layers
        self._reference = reference
        self._ring_weights = ring_weights(reference)
        self._symmetries = lattice_symmetries(rings_of(len(reference)))
        self._tensors = {
            name: tensor.astype(np.float64) for name, tensor in model.tensors.items() if name.startswith("transfer.")
        }
        self._learned = learned_features(self._spec, self._tensors)

    def __call__(self, displacements: NDArray[Any]) -> tuple[Array, Array]:
        """Return means (n, 6) in label half-ranges and standard deviations (n, 6) in units of the labels' sigmas.

        Args:
            displacements: (n, 2 m) px, as the old sensor's camera would have seen them.
        """
        spec = self._spec
        fields = symmetric_fields(displacements.astype(np.float64), self._reference, self._symmetries)
        outputs, network = symmetric_outputs(
            self._layers, fields, self._network_labels, self._symmetries, spec.image_turn, spec.mirror_axes_rad
        )
        scores = (displacements - self._tensors["transfer.mean"]) @ self._tensors["transfer.basis"].T
        rings = ring_modes(displacements, self._ring_weights)
        at = features(spec, reflected(outputs) if spec.mirrored else outputs, scores, rings)
        contacts, process = process_results(spec, self._tensors, at, self._learned)
        variance = combined_variance(spec.network_share, spec.process_share, spec.floor, network, process)
        labels = self._labels
        return (contacts - labels.centre) / labels.half_range, np.sqrt(variance) / labels.sigma_unit


def combined_variance(
    network_share: Sequence[float],
    process_share: Sequence[float],
    floor: Sequence[float],
    network: Array,
    process: Array,
) -> Array:
    """Return variances (n, 6), the weighted sum of those of networks and processes and a constant."""
    total: Array = (
        (np.array(network_share) * network) ** 2 + (np.array(process_share) * process) ** 2 + np.square(floor)
    )
    return total
