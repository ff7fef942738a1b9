"""Check on the displacements of one image that the camera is the one a marker model was trained with. NumPy only.

A contact moves the markers in ways that the displacement model describes; a shifted, zoomed or turned camera moves them
in others as well, above all at the rim, which the tip's body holds. So the change of the camera is estimated from any
contact by generalised least squares: displacement = mean + contact + J (shift, zoom, turn) + noise, with the covariance
of contact and noise in the training set. On real images of another session the standard deviations are 0.3 px, 0.3 %
and 0.05 degrees.

A lattice has twelve symmetries, so a camera that is turned by a multiple of 60 degrees or mirrored gives as good a
match. What differs are the small offsets of the individual pins. Fisher's linear discriminant between the mean field
and each of its eleven symmetric copies detects them, where pins, mount and lens are irregular enough. In a file without
functionals those of its displacement model serve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception import kernels
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.markers.transfer import lattice_symmetries, symmetric_fields
from touchcell.perception.models.marker_architecture import CameraCheckSpec

_DISTINCT = 60.0
_LEAST_ALIKE = 0.5
_MOST_SHIFT = 0.32
_MOST_ZOOM = 0.03
_MOST_TURN_RAD = 0.035
_WIDE_PX = 20.0
_COMPONENTS = 80
_SPARE, _SPARE_FEW = 0.35, 0.5
_NOISE_FEW_PX = 0.4
_STRONG = 6
_ACCEPTED = 0.997
_OWN, _SPARE_OWN, _SPARE_OWN_FEW = 0.99, 1.2, 8.0
_TORN = "the markers do not move as those of one tip"
_NOISE_PX = 0.2
_LEAST_MISFIT_PX = 1e-6


@dataclass(frozen=True)
class CameraFinding:
    """What one image says of its camera.

    Attributes:
        shift_px: (2,) of the image, u and v.
        zoom: relative magnification less one.
        turn_rad: rotation of the image from u to v.
        symmetry: 0, or the number in ``lattice_symmetries`` of the one that fits better.
        refusal: why images of this camera cannot be used; empty where they can.
    """

    shift_px: tuple[float, float]
    zoom: float
    turn_rad: float
    symmetry: int
    refusal: str


class CameraCheck:
    """Test of marker displacements.

    Args:
        functionals: (15, 2 m) see ``CHECKED``; zero rows belong to symmetries that cannot be distinguished.
        mean: (2 m,) px, mean displacement.
        spacing_px: of the lattice.
        tear: test for torn images; None for none.
    """

    def __init__(
        self, functionals: NDArray[np.float32], mean: Array, spacing_px: float, tear: TearCheck | None = None
    ) -> None:
        self._tear = tear
        self._mean = mean
        self._rows = np.ascontiguousarray(functionals.T)
        self._nothing = np.zeros(len(functionals), np.float32)
        self._most_shift_px = _MOST_SHIFT * spacing_px
        self._distinct = functionals[4:].any(axis=1)

    @property
    def knows_turns(self) -> bool:
        """True if a camera that is turned by a multiple of 60 degrees, or mirrored, can be detected."""
        return bool(self._distinct.all())

    def __call__(self, displacements: Array, seen: NDArray[np.bool_]) -> CameraFinding:
        """Check displacements (2 m,) px of one image, of which the markers ``seen`` (m,) were found."""
        off = (displacements - self._mean).astype(np.float32)
        found = kernels.affine(self._rows, self._nothing, off)
        u, v, zoom, turn = found[:4].tolist()
        likeness = np.where(self._distinct, found[4:], -np.inf)
        most = int(np.argmax(likeness))
        symmetry = most + 1 if likeness[most] > _LEAST_ALIKE else 0
        refusal = self._refusal(u, v, zoom, turn, symmetry)
        if not refusal and self._tear is not None and self._tear.excess(displacements, seen) > 0.0:
            refusal = _TORN
        return CameraFinding((u, v), zoom, turn, symmetry, refusal)

    def _refusal(self, u: float, v: float, zoom: float, turn: float, symmetry: int) -> str:
        if math.hypot(u, v) > self._most_shift_px:
            return f"the camera's image is shifted by {u:.0f}, {v:.0f} px"
        if abs(zoom) > _MOST_ZOOM:
            return f"the camera's image is zoomed by {100 * zoom:.1f} %"
        if abs(turn) > _MOST_TURN_RAD:
            return f"the camera is turned by {math.degrees(turn):.1f} deg"
        return describe_symmetry(symmetry)


class TearCheck:
    """Test whether the markers of one image can belong to a single contact.

    Args:
        basis: (k, 2 m) orthonormal rows, principal components of contacts.
        mean: (2 m,) px, mean displacement.
        strength: (l, 2 m) rows whose products with a displacement have the norm that ``spec`` calls strength.
        spec: accepted misfit.
    """

    def __init__(
        self, basis: NDArray[np.float32], mean: Array, strength: NDArray[np.float32], spec: CameraCheckSpec
    ) -> None:
        self._mean, self._spec, self._components = mean, spec, len(basis)
        self._rows = np.ascontiguousarray(np.concatenate([basis, strength]).T)
        self._nothing = np.zeros(self._rows.shape[1], np.float32)

    def excess(self, displacements: Array, seen: NDArray[np.bool_]) -> float:
        """Return the logarithm of the misfit over the largest accepted one; positive for a torn image."""
        off = displacements - self._mean
        products = kernels.affine(self._rows, self._nothing, off.astype(np.float32)).astype(np.float64)
        within, strong = products[: self._components], products[self._components :]
        # The components are orthonormal: what they leave is the difference of the squares.
        beyond = max(float(off @ off - within @ within), 0.0)
        misfit = max(math.sqrt(2.0 * beyond / len(off)), _LEAST_MISFIT_PX)
        visible = max(np.count_nonzero(seen) / len(seen), 0.1)
        usual = self._spec.misfit[0] + self._spec.misfit[1] * math.sqrt(float(strong @ strong))
        return math.log(misfit / math.sqrt(visible)) - usual - self._spec.most


def _strength_and_misfit(off: Any, basis: Any, strength: Any) -> tuple[Array, Array]:
    """Return the Mahalanobis norm of the first modes, and the root mean square px per marker beyond the components."""
    beyond = off - np.einsum("nk,kj->nj", np.einsum("nj,kj->nk", off, basis), basis)
    norm = np.linalg.norm(np.einsum("nj,kj->nk", off, strength), axis=1)
    return norm, np.maximum(np.sqrt(2.0 * np.square(beyond).mean(axis=1)), _LEAST_MISFIT_PX)


def strength_rows(model: DisplacementModel) -> NDArray[np.float32]:
    """Return the rows that ``TearCheck`` takes: the first modes, each over its standard deviation."""
    rows: NDArray[np.float32] = (model.basis[:_STRONG] / model.sd[:_STRONG, None]).astype(np.float32)
    return rows


def describe_symmetry(symmetry: int) -> str:
    """Return what a camera with a symmetry of ``lattice_symmetries`` is: empty for the first."""
    if symmetry == 0:
        return ""
    turn = 60 * (symmetry % 6)
    if symmetry >= 6:
        return "the camera is mirrored"
    return f"the camera is turned by about {turn if turn <= 180 else turn - 360} deg"


def fit_functionals(
    reference: Array, rings: int, mean: Array, covariances: list[tuple[Array, Array]], noise_px: float
) -> NDArray[np.float32]:
    """Return the functionals (15, 2 m) of a ``CameraCheck``.

    Args:
        reference: (m, 2) px, lattice of the undeformed tip.
        rings: of the lattice.
        mean: (2 m,) px, mean displacement of the sensor's contacts.
        covariances: parts of the displacements' covariance, each as rows (k, 2 m) and standard deviations (k,).
        noise_px: of each coordinate beyond them.
    """
    place = reference - reference.mean(axis=0)
    ones, zeros = np.ones(len(place)), np.zeros(len(place))
    change = np.stack(
        [
            np.column_stack([ones, zeros]).ravel(),
            np.column_stack([zeros, ones]).ravel(),
            place.ravel(),
            np.column_stack([-place[:, 1], place[:, 0]]).ravel(),
        ]
    )
    factors = [sd[:, None] * rows for rows, sd in covariances]
    inverse = _Inverse(np.concatenate(factors), noise_px)
    weighted = inverse(change)
    similarity = np.linalg.solve(change @ weighted.T, weighted)
    # Symmetries are told apart whatever small change the camera has.
    size = np.linalg.norm(change, axis=1) / np.sqrt(len(place))
    free = _Inverse(np.concatenate([*factors, _WIDE_PX * change / size[:, None]]), noise_px)
    copies = symmetric_fields(mean[None], reference, lattice_symmetries(rings))[1:, 0].astype(np.float64) - mean
    toward = free(copies)
    apart = (copies * toward).sum(axis=1)
    discriminant = np.where(apart[:, None] > _DISTINCT, toward / np.maximum(apart, 1e-9)[:, None], 0.0)
    return np.concatenate([similarity, discriminant]).astype(np.float32)


class _Inverse:
    """Products with the inverse of noise^2 I + F^T F, by the Woodbury identity."""

    def __init__(self, factors: Array, noise_px: float) -> None:
        self._factors, self._variance = factors, noise_px**2
        self._small = np.linalg.inv(self._variance * np.eye(len(factors)) + factors @ factors.T)

    def __call__(self, rows: Array) -> Array:
        product: Array = (rows - (rows @ self._factors.T) @ self._small @ self._factors) / self._variance
        return product


def limited_functionals(
    functionals: NDArray[np.float32], mean: Array, displacements: Array, spacing_px: float
) -> NDArray[np.float32]:
    """Return functionals that accept a sensor's own contacts: what few contacts cannot distinguish refuses none.

    With few contacts many a component of how the skin moves is unknown, and is taken for a change of the camera.

    Args:
        functionals: (15, 2 m) see ``fit_functionals``.
        mean: (2 m,) px, mean displacement.
        displacements: (n, 2 m) px of contacts that they were not learned from.
        spacing_px: of the lattice.
    """
    spare = _SPARE_OWN + _SPARE_OWN_FEW / len(displacements)
    found = (displacements - mean) @ functionals.T
    shift = np.hypot(found[:, 0], found[:, 1])
    limited = functionals.copy()
    for rows, size, most in (
        (slice(0, 2), shift, _MOST_SHIFT * spacing_px),
        (slice(2, 3), np.abs(found[:, 2]), _MOST_ZOOM),
        (slice(3, 4), np.abs(found[:, 3]), _MOST_TURN_RAD),
    ):
        limited[rows] *= min(1.0, most / max(spare * float(np.quantile(size, _OWN)), 1e-12))
    alike = np.quantile(found[:, 4:], _OWN, axis=0)
    limited[4:][spare * alike > _LEAST_ALIKE] = 0.0
    return limited


def learn_check(
    model: DisplacementModel, rings: int, displacements: Array
) -> tuple[CameraCheckSpec, dict[str, NDArray[np.float32]]]:
    """Return the camera check, and its tensors, of a sensor of many known displacements (n, 2 m) px."""
    off = displacements - model.mean
    # Components describe the contacts that they were learned from better than any others.
    learned, others = off[::2], off[1::2]
    rows, sd = principal(learned, min(_COMPONENTS, len(learned) // 10 + 1))
    functionals = fit_functionals(model.reference, rings, model.mean, [(rows, sd)], _NOISE_PX)
    functionals = limited_functionals(functionals, model.mean, displacements[1::2], model.spacing_px)
    basis = rows.astype(np.float32)
    tensors = {"camera.mean": model.mean.astype(np.float32), "camera.functionals": functionals, "camera.basis": basis}
    return misfit_of(model, others, basis, _SPARE), tensors


def transferred_check(
    model: DisplacementModel, rings: int, displacements: Array
) -> tuple[CameraCheckSpec, dict[str, NDArray[np.float32]]]:
    """Return the check of a sensor of which only some contacts are known, and its tensors.

    Args:
        model: of another sensor of the same kind.
        rings: of the lattice.
        displacements: (n, 2 m) px of the sensor's own contacts, as the other one's camera would have seen them.
    """
    mean = displacements.mean(axis=0, dtype=np.float64)
    off = displacements - mean
    parts = [(model.basis, model.sd), principal(off, min(_COMPONENTS, len(off) // 2))]
    functionals = fit_functionals(model.reference, rings, mean, parts, _NOISE_FEW_PX)
    functionals = limited_functionals(functionals, mean, displacements, model.spacing_px)
    basis = model.basis.astype(np.float32)
    tensors = {"camera.mean": mean.astype(np.float32), "camera.functionals": functionals, "camera.basis": basis}
    return misfit_of(model, off, basis, _SPARE_FEW), tensors


def misfit_of(model: DisplacementModel, off: Array, basis: NDArray[np.float32], spare: float) -> CameraCheckSpec:
    """Return the accepted misfit of displacements (n, 2 m) px from their mean: few of these exceed it.

    Args:
        model: whose first modes are the strength of a contact.
        off: (n, 2 m) px.
        basis: (k, 2 m) components of contacts.
        spare: added to the largest excess, in its logarithm: noise, dust and dead pins raise the misfit.
    """
    strength, misfit = _strength_and_misfit(off, basis, strength_rows(model))
    terms = np.column_stack([np.ones(len(off)), strength])
    line = np.linalg.lstsq(terms, np.log(misfit), rcond=None)[0]
    excess = np.log(misfit) - terms @ line
    most = float(np.quantile(excess, _ACCEPTED)) + spare
    return CameraCheckSpec(components=len(basis), misfit=(float(line[0]), float(line[1])), most=most)


def principal(rows: Array, most: int) -> tuple[Array, Array]:
    """Return the first principal directions (k, 2 m) of centred rows (n, 2 m), and their standard deviations (k,)."""
    n, width = rows.shape
    if n > width:
        values, vectors = np.linalg.eigh(rows.T @ rows / n)
        chosen = slice(None, -min(most, width) - 1, -1)
        return np.ascontiguousarray(vectors[:, chosen].T), np.sqrt(np.maximum(values[chosen], 0.0))
    _, sizes, right = np.linalg.svd(rows, full_matrices=False)
    return right[:most], sizes[:most] / np.sqrt(max(n, 1))
