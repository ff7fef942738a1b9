"""Check of an image against the contact that a network estimates from it. NumPy and the compiled kernels only.

A contact moves each marker to a place that a polynomial of the network's six means predicts. Mean shift finds the
marker next to it, without detecting or matching discs. What is left, the field of the markers' distances from where
they are expected, is small and smooth for images of the model's own sensor. An image is refused where markers are
missing, where light is elsewhere, and where that field is too large, too rough, or that of a camera that has moved.

Missing markers are drawn in where the field predicts them, and the network estimates again: it has seen no dead pin.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception import kernels
from touchcell.perception.models.architecture import CHECK, ImageCheckSpec
from touchcell.perception.models.preprocessing import Preprocessing

TURNS = 3
STRONGEST = 20
_FARTHEST = 1.15
_LEAST_SEEN = 0.7
_ALL_SEEN = 0.985
_REFINED = 6
_STEP = 1e-3
_DEPTH = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_WELL_SEEN = 0.85
_OTHER_DEPTHS = (-0.6, -0.4, -0.2, 0.2, 0.4, 0.6)
_CONTACT_SD = 0.3
_ROBUST = 3
_WIDE_PX = 4.0
_NOISE_PX = 0.7
_NEIGHBOURS = 9
_STRAY = 0.3
_FEW, _MANY = 0.015, 0.5
_FACTORS = np.array(list(itertools.combinations_with_replacement(range(7), 3))).T
_OTHER = "the image does not show the model's sensor as its camera would"
_TORN = "the markers do not move as those of one tip"


@dataclass(frozen=True, slots=True)
class SeenMarkers:
    """Markers of one image.

    Attributes:
        expected: (m, 2) px of the crop, where the estimated contact moves them.
        off: (m, 2) px of the crop, from there to where they are; where not seen, as the others' field has it.
        seen: (m,) whether it is as bright as a marker, and near its neighbours' field.
        light: share of the image's light that lies at markers.
    """

    expected: Array
    off: Array
    seen: NDArray[np.bool_]
    light: float


def terms_of(mean: Array) -> Array:
    """Return the (..., 84) monomials up to the third degree of means (..., 6), limited to about the taught range."""
    limited = np.clip(mean, -_FARTHEST, _FARTHEST)
    factors = np.concatenate([np.ones((*limited.shape[:-1], 1)), limited], axis=-1)
    first, second, third = _FACTORS
    terms: Array = factors[..., first] * factors[..., second] * factors[..., third]
    return terms


def px_of_crop(preprocessing: Preprocessing) -> Array:
    """Return the (2,) size along u and v of a pixel of the preprocessed image, px of the crop."""
    left, top, right, bottom = preprocessing.region
    height, width = preprocessing.output_size
    return np.array([(right - left) / width, (bottom - top) / height])


class ImageCheck:
    """Test of preprocessed images against a network's means.

    Args:
        spec: limits.
        tensors: of the model file.
        preprocessing: of the model.
    """

    def __init__(
        self, spec: ImageCheckSpec, tensors: Mapping[str, NDArray[np.float32]], preprocessing: Preprocessing
    ) -> None:
        own = {name.removeprefix(CHECK): each for name, each in tensors.items() if name.startswith(CHECK)}
        self._spec = spec
        self._px = px_of_crop(preprocessing)
        self._mean, self._sd = own["mean"], own["sd"].astype(np.float64)
        self._modes = own["modes"].astype(np.float64)
        self._terms = own["terms"].astype(np.float64)
        self._rows = np.ascontiguousarray(np.concatenate([own["modes"], own["filters"]]).T)
        self._limits = np.array(spec.limits)
        rest = own["rest"].astype(np.float64)
        apart = np.linalg.norm(rest[:, None] - rest[None], axis=2)
        neighbours = np.ascontiguousarray(np.argsort(apart, axis=1)[:, 1 : 1 + _NEIGHBOURS], np.int64)
        nearest = np.take_along_axis(apart, neighbours[:, :1], axis=1)
        self._follow = kernels.Follower(
            own["terms"],
            own["rest"].ravel(),
            neighbours,
            self._px,
            radius_px=spec.radius_px,
            turns=TURNS,
            least_level=spec.least_level,
            stray_px=_STRAY * float(np.median(nearest)),
        )

    def find(self, image: ImageArray, mean: NDArray[np.float32], before: SeenMarkers | None = None) -> SeenMarkers:
        """Return the markers of a preprocessed image, of which a network made the six means ``mean``.

        ``before`` are those found in this image from means that were farther off.
        """
        terms = terms_of(mean.astype(np.float64)).astype(np.float32)
        found = self._follow(image, terms)
        if np.count_nonzero(found.seen) >= _ALL_SEEN * len(found.seen):
            off = found.off if found.seen.all() else np.where(found.seen[:, None], found.off, found.around)
            return SeenMarkers(found.expected, off, found.seen, found.light)
        enough = _WELL_SEEN * len(found.seen) if before is None else float(np.count_nonzero(before.seen))
        return self._refined(image, mean.astype(np.float64), found, enough)

    def _refined(self, image: ImageArray, mean: Array, found: kernels.Followed, enough: float) -> SeenMarkers:
        """Return the markers found from where another contact near ``mean`` and the modes put them, which sees more."""
        first, contact = found.expected, mean
        found, contact, around = self._settled(image, found, contact)
        if np.count_nonzero(found.seen) < enough:
            # Missing light looks like another depth, from which a search ends among the wrong markers.
            others = [mean + off * _DEPTH for off in _OTHER_DEPTHS]
            starts = [(self._follow(image, terms_of(other).astype(np.float32)), other) for other in others]
            start = max(starts, key=lambda each: np.count_nonzero(each[0].seen))
            again = self._settled(image, *start)
            if np.count_nonzero(again[0].seen) > np.count_nonzero(found.seen):
                found, contact, around = again
        off = np.where(found.seen[:, None], found.off, around) + found.expected - first
        return SeenMarkers(first, off, found.seen, found.light)

    def _settled(
        self, image: ImageArray, found: kernels.Followed, contact: Array
    ) -> tuple[kernels.Followed, Array, Array]:
        """Find markers and explain them by turns, while more are seen. Return them, contact (6,), field (m, 2) px."""
        around = found.around
        for _ in range(_REFINED):
            moved, field = self._explained(contact, found.off, found.seen)
            again = self._follow(image, terms_of(moved).astype(np.float32), field)
            if np.count_nonzero(again.seen) <= np.count_nonzero(found.seen):
                break
            found, contact, around = again, moved, field
        return found, contact, around

    def _explained(self, contact: Array, off: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the contact (6,) and, with it, the field (m, 2) px of modes that explain the seen markers best."""
        modes = len(self._sd)
        places = terms_of(np.concatenate([contact[None], contact + _STEP * np.eye(6)])) @ self._terms
        rows = np.concatenate([self._modes, (places[1:] - places[0]) / _STEP])
        ridge = np.square(_NOISE_PX / np.concatenate([self._sd, np.full(6, _CONTACT_SD)]))
        left = off.ravel() - self._mean
        weight = np.repeat(seen, 2).astype(np.float64)
        for _ in range(_ROBUST):
            found = _fitted(rows, left, weight, ridge)
            weight = np.repeat(seen, 2) / (1.0 + np.square((left - found @ rows) / _WIDE_PX))
        return contact + found[modes:], (self._mean + found[:modes] @ self._modes).reshape(-1, 2)

    def refusal(self, found: SeenMarkers) -> str:
        """Return why an image with these markers cannot be used; empty where it can."""
        if np.count_nonzero(found.seen) < _LEAST_SEEN * len(found.seen) or found.light < self._spec.least_light:
            return _OTHER
        excess = self.measure(found) - self._limits
        if (excess[2:] > 0.0).any():
            return self._spec.changes[int(np.argmax(excess[2:]))]
        return _TORN if (excess > 0.0).any() else ""

    def measure(self, found: SeenMarkers) -> Array:
        """Return size and roughness of the field, then how much of each change of the camera it shows."""
        filters = self._rows.shape[1] - len(self._sd)
        off = found.off
        if np.count_nonzero(found.seen) < _ALL_SEEN * len(found.seen):
            # Of the missing ones, what the modes make of the others: whatever else is assumed of them looks rough.
            off = np.where(found.seen[:, None], off, self._field(off, found.seen))
        return kernels.measure_field(off, self._mean, self._rows, self._sd, STRONGEST, filters)

    def mended(self, image: ImageArray, found: SeenMarkers) -> ImageArray | None:
        """Return the image with its missing markers drawn in; None where next to none are missing, or too many."""
        lost = len(found.seen) - np.count_nonzero(found.seen)
        if not _FEW * len(found.seen) < lost < _MANY * len(found.seen):
            return None
        missing = np.flatnonzero(~found.seen)
        places = ((found.expected + found.off)[missing] + 0.5) / self._px - 0.5
        reach = int(np.ceil(self._spec.disc_px)) + 1
        v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, 1, -1)
        nearest = np.rint(places).astype(np.int64)
        off = places - nearest
        disc = np.clip(self._spec.disc_px + 0.5 - np.hypot(u - off[:, :1], v - off[:, 1:]), 0.0, 1.0)
        rows, columns = nearest[:, 1:] + v, nearest[:, :1] + u
        inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
        drawn = image.copy()
        np.maximum.at(drawn, (rows[inside], columns[inside]), np.rint(255.0 * disc[inside]).astype(np.uint8))
        return drawn

    def _field(self, off: Array, seen: NDArray[np.bool_]) -> Array:
        """Return the (m, 2) px most probable distances of all markers, given those of the seen ones."""
        known, ridge = np.repeat(seen, 2).astype(np.float64), np.square(_NOISE_PX / self._sd)
        coefficients = _fitted(self._modes, off.ravel() - self._mean, known, ridge)
        return (self._mean + coefficients @ self._modes).reshape(-1, 2)


def _fitted(rows: Array, values: Array, weight: Array, ridge: Array) -> Array:
    """Return (k,) how much of each of ``rows`` (k, n) explains ``values`` (n,) best, by weighted ridge regression."""
    weighted = rows * weight
    moments = weighted @ rows.T
    moments.flat[:: len(ridge) + 1] += ridge
    return np.asarray(np.linalg.solve(moments, weighted @ values))
