"""Which disc of an image is which marker of the lattice.

A marker's displacement says little by itself, as markers move further than half their spacing. All together move in few
ways: a linear model with some two dozen coefficients leaves less than a pixel. So the coefficients are found, and the
markers with them, by turns: predict the markers, pair each with its nearest disc where both agree, fit anew. From a near
start (the frame before) this converges in two or three turns. Without one a small network looks at where the discs
are dense, and guesses the coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.types import Array
from perception.markers import Discs

_FIT_SD_PX = 0.7
_TURNS = 12
_SETTLED_PX = 0.05
_CONVINCING = 0.965
_MOST_STARTS = 8


@dataclass(frozen=True, slots=True)
class DisplacementModel:
    """The ways in which the markers of a sensor move together.

    Attributes:
        reference: (m, 2) px, markers of the undeformed tip.
        mean: (2 m,) px, mean displacement (u, v, u, v, ...).
        basis: (k, 2 m) orthonormal rows, the widest way first.
        sd: (k,) px, standard deviations of the coefficients.
    """

    reference: Array
    mean: Array
    basis: Array
    sd: Array

    @property
    def base(self) -> Array:
        """(2 m,) px, marker positions with all coefficients zero."""
        base: Array = self.reference.ravel() + self.mean
        return base

    @property
    def spacing_px(self) -> float:
        """Median distance of a reference marker from its nearest neighbour."""
        distances = np.linalg.norm(self.reference[:, None] - self.reference[None], axis=2)
        np.fill_diagonal(distances, np.inf)
        return float(np.median(distances.min(axis=1)))

    def positions(self, coefficients: Array) -> Array:
        """(..., m, 2) px of coefficients (..., k)."""
        flat = self.base + coefficients @ self.basis
        return flat.reshape(*flat.shape[:-1], -1, 2)

    @classmethod
    def fit(cls, reference: Array, displacements: Array, seen: NDArray[np.bool_], modes: int) -> DisplacementModel:
        """Principal components of displacements of which some are missing.

        Args:
            reference: (m, 2) px.
            displacements: (n, m, 2) px; those of unseen markers are taken for a first guess.
            seen: (n, m).
            modes: how many components are kept, at most n - 1.
        """
        flat = displacements.reshape(len(displacements), -1).astype(np.float64)
        known = np.repeat(seen, 2, axis=1)
        filled = flat.copy()
        for _ in range(3):
            mean = filled.mean(axis=0)
            centred = filled - mean
            # The matrix of 2m x 2m moments is smaller than thousands of frames.
            values, vectors = np.linalg.eigh(centred.T @ centred / len(flat))
            basis = vectors[:, ::-1][:, : min(modes, len(flat) - 1)].T
            filled = np.where(known, flat, mean + (centred @ basis.T) @ basis)
        sd = np.sqrt(np.maximum(values[::-1][: len(basis)], 1e-12))
        return cls(reference, mean, np.ascontiguousarray(basis), sd)


@dataclass(frozen=True, slots=True)
class MarkerField:
    """Where all markers of a lattice are in one image.

    Attributes:
        positions: (m, 2) px; of unseen markers as the displacement model fills them in.
        displacements: (m, 2) px from the reference.
        seen: (m,) markers that have a disc of their own.
        coefficients: (k,) px, of the displacement model.
        score: markers seen over those expected in view, or over the discs among them where these are more; 1 is best.
        rms_px: of the seen markers from the displacement model.
        valid: the match can be believed.
    """

    positions: Array
    displacements: Array
    seen: NDArray[np.bool_]
    coefficients: Array
    score: float
    rms_px: float
    valid: bool


@dataclass(frozen=True, slots=True)
class FirstGuess:
    """A network with one hidden layer from the density of discs to the coefficients of a displacement model.

    Attributes:
        low: (2,) px, corner of the square that is looked at.
        cell_px: side of a cell of its grid.
        hidden_weight, hidden_bias: (hidden, grid * grid), (hidden,).
        weight, bias: (k, hidden), (k,); outputs are in standard deviations of the coefficients.
        sd: (k,) px, how far its guesses are off.
    """

    low: Array
    cell_px: float
    hidden_weight: NDArray[np.float32]
    hidden_bias: NDArray[np.float32]
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    sd: Array

    def __call__(self, centres: Array) -> Array:
        """(k,) coefficients over their standard deviations, of discs (n, 2)."""
        grid = int(round(np.sqrt(self.hidden_weight.shape[1])))
        density = disc_density(centres[None], np.ones((1, len(centres))), self.low, self.cell_px, grid)[0]
        hidden = np.maximum(self.hidden_weight @ density + self.hidden_bias, 0.0)
        guess: Array = (self.weight @ hidden + self.bias).astype(np.float64)
        return guess


def disc_density(centres: Array, weights: Array, low: Array, cell_px: float, grid: int) -> NDArray[np.float32]:
    """How many discs lie in each cell of a grid, each shared bilinearly among the four cells around it.

    Args:
        centres: (b, n, 2) px.
        weights: (b, n), zero for a disc that is not there.
        low: (2,) px, where the grid begins.
        cell_px: side of a cell.
        grid: cells along each side.

    Returns:
        (b, grid * grid).
    """
    place = (centres - low) / cell_px - 0.5
    whole = np.floor(place)
    part = place - whole
    cell = whole.astype(np.intp)
    density = np.zeros(len(centres) * grid * grid)
    first = (np.arange(len(centres)) * grid * grid)[:, None]
    for right in (0, 1):
        for down in (0, 1):
            u, v = cell[..., 0] + right, cell[..., 1] + down
            inside = (u >= 0) & (u < grid) & (v >= 0) & (v < grid)
            share = np.abs(1 - right - part[..., 0]) * np.abs(1 - down - part[..., 1]) * weights * inside
            index = np.where(inside, first + v * grid + u, 0)
            density += np.bincount(index.ravel(), share.ravel(), len(density))
    return density.reshape(len(centres), -1).astype(np.float32)


class MarkerMatcher:
    """Matches the discs of one frame after the other.

    Args:
        model: how the markers move.
        guess: a start for frames without a near frame before them.
        image_size: (height, width) px.
        bank: (b, k) learned coefficients, of which those like the guess are tried when the guess leads nowhere.
        least_score: below this a match is not believed.
        most_rms_px: above this a match is not believed.
    """

    def __init__(
        self,
        model: DisplacementModel,
        guess: FirstGuess,
        image_size: tuple[int, int],
        *,
        bank: Array | None = None,
        least_score: float = 0.9,
        most_rms_px: float = 2.0,
    ) -> None:
        self.model = model
        self._guess = guess
        self._size = np.array(image_size[::-1], dtype=np.float64)
        self._bank = np.empty((0, len(model.sd))) if bank is None else bank
        self._least_score = least_score
        self._most_rms_px = most_rms_px
        self._base = model.base
        self._middle = model.base.reshape(-1, 2).mean(axis=0)
        self._spacing_px = model.spacing_px
        self._guess_sd = guess.sd

    def match(self, discs: Discs, previous: MarkerField | None = None) -> MarkerField:
        """Markers of the image in which ``discs`` were found.

        Args:
            discs: what was found in the image.
            previous: of the frame before, when there was one; an invalid one is not used.
        """
        if not len(self.model.reference) // 4 <= len(discs) <= 4 * len(self.model.reference):
            return self._nothing()
        centres = discs.centres
        search = _Nearest(centres, self._middle)
        if previous is not None and previous.valid:
            field = self._refine(previous.coefficients, centres, search, near=True)
            if field.valid and field.score >= _CONVINCING:
                return field
        guessed = self._guess(centres) * self.model.sd
        tried = [self._refine(guessed, centres, search)]
        for start in self._alike(guessed):
            if tried[-1].valid and tried[-1].score >= _CONVINCING:
                break
            tried.append(self._refine(start, centres, search))
        return max(tried, key=_quality)

    def _alike(self, guessed: Array) -> Iterator[Array]:
        """Learned contacts that are like a guess, the likest first, each unlike those before it."""
        left = self._bank
        for _ in range(_MOST_STARTS):
            if not len(left):
                return
            off = (((left - guessed) / self._guess_sd) ** 2).sum(axis=1)
            chosen = left[int(np.argmin(off))]
            yield chosen
            left = left[(((left - chosen) / self._guess_sd) ** 2).sum(axis=1) > 0.3 * left.shape[1]]

    def _refine(self, start: Array, centres: Array, search: _Nearest, *, near: bool = False) -> MarkerField:
        final_reach = 0.3 * self._spacing_px
        reach = final_reach if near else 0.6 * self._spacing_px
        modes = len(start)
        ridge = (_FIT_SD_PX / (self.model.sd if near else 3.0 * self._guess_sd)) ** 2
        coefficients = start
        predicted = (self._base + start @ self.model.basis).reshape(-1, 2)
        for _ in range(_TURNS):
            partner, square = search(predicted)
            paired = _own(partner, square, len(centres)) & (square < reach * reach)
            if paired.sum() < modes:
                break
            off = centres[partner] - predicted
            # A disc far from where its marker should be may be a neighbour's, and counts less.
            weight = paired / (1.0 + square / (0.35 * reach) ** 2)
            weighted = self.model.basis * np.repeat(weight, 2)
            moments = weighted @ self.model.basis.T
            moments[np.diag_indices(modes)] += ridge
            change = np.linalg.solve(moments, weighted @ off.ravel() + ridge * (start - coefficients))
            coefficients = coefficients + change
            shift = (change @ self.model.basis).reshape(-1, 2)
            predicted = predicted + shift
            if reach <= final_reach and float(np.abs(shift).max()) < _SETTLED_PX:
                break
            reach = max(final_reach, 0.8 * reach)
        return self._field(coefficients, predicted, centres, search, final_reach)

    def _field(
        self, coefficients: Array, predicted: Array, centres: Array, search: _Nearest, reach: float
    ) -> MarkerField:
        partner, square = search(predicted)
        paired = _own(partner, square, len(centres)) & (square < reach * reach)
        positions = predicted.copy()
        positions[paired] = centres[partner[paired]]
        left_over = np.ones(len(centres), bool)
        left_over[partner[paired]] = False
        among = 0
        if left_over.any():
            apart = centres[left_over][:, None] - predicted[None]
            among = int(((apart**2).sum(axis=2).min(axis=1) < self._spacing_px**2).sum())
        margin = 0.5 * self._spacing_px
        in_view = ((predicted >= margin) & (predicted <= self._size - 1.0 - margin)).all(axis=1)
        found = int(paired.sum())
        expected = max(int((in_view | paired).sum()), found + among, 1)
        rms = float(np.sqrt(square[paired].mean())) if found else np.inf
        score = found / expected
        return MarkerField(
            positions=positions,
            displacements=positions - self.model.reference,
            seen=paired,
            coefficients=coefficients,
            score=score,
            rms_px=rms,
            valid=score >= self._least_score and rms <= self._most_rms_px and found >= len(positions) // 2,
        )

    def _nothing(self) -> MarkerField:
        positions = self._base.reshape(-1, 2)
        coefficients = np.zeros(len(self.model.sd))
        shift = positions - self.model.reference
        return MarkerField(positions.copy(), shift, np.zeros(len(shift), bool), coefficients, 0.0, np.inf, False)


def _quality(field: MarkerField) -> tuple[bool, float]:
    return field.valid, field.score - 0.05 * min(field.rms_px, 20.0)


class _Nearest:
    """Nearest of some points, by one small matrix product: a tree takes longer to build."""

    def __init__(self, points: Array, middle: Array) -> None:
        # Near the origin, float32 keeps distances to a hundredth of a pixel.
        self._middle = middle
        from_middle = (points - middle).astype(np.float32)
        self._points = np.column_stack([-2.0 * from_middle, (from_middle**2).sum(axis=1)]).T.astype(np.float32)
        self._work: NDArray[np.float32] | None = None

    def __call__(self, places: Array) -> tuple[NDArray[np.intp], Array]:
        """(m,) index of the point nearest to each place (m, 2), and the squared distance."""
        if self._work is None:
            self._work = np.empty((len(places), self._points.shape[1]), np.float32)
        from_middle = (places - self._middle).astype(np.float32)
        np.matmul(np.column_stack([from_middle, np.ones(len(places), np.float32)]), self._points, out=self._work)
        nearest = self._work.argmin(axis=1)
        square = self._work[np.arange(len(places)), nearest] + (from_middle**2).sum(axis=1)
        return nearest, np.maximum(square, 0.0).astype(np.float64)


def _own(partner: NDArray[np.intp], square: Array, points: int) -> NDArray[np.bool_]:
    """(m,) whether each place is, of all that have the same nearest point, the nearest to it."""
    order = np.argsort(-square)
    owner = np.full(points, -1)
    owner[partner[order]] = order
    own: NDArray[np.bool_] = owner[partner] == np.arange(len(partner))
    return own


def pair(places: Array, points: Array, reach: float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """(m,) point nearest to each place, and whether it is within reach and nearest to no other place.

    Args:
        places: (m, 2) px.
        points: (n, 2) px.
        reach: px.
    """
    nearest, square = _Nearest(points, points.mean(axis=0))(places)
    return nearest, _own(nearest, square, len(points)) & (square < reach * reach)
