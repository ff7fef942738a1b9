"""Matching of an image's discs to the markers of the lattice.

A single marker's displacement is ambiguous, as markers move further than half their spacing. All together have few
degrees of freedom: a linear model with some two dozen coefficients leaves less than a pixel. So the coefficients are
estimated together with the matching, alternately: predict the markers, pair each with its nearest disc, fit again. From
a near start (the previous frame) this converges in two or three iterations. Without one a small network estimates the
coefficients from the density of discs; when that fails, learned contacts with a similar density are tried.

Pairing and fitting are in C (``kernels.py``); this module decides where to start and what to accept. Other products
are written as ``einsum``, which stays on its thread: a linear algebra library would spread products of this size
over all cores, and wait for a busy core far longer than the product takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception import kernels
from touchcell.perception.markers.detection import Discs

_FIT_SD_PX = 0.7
_TURNS = 12
_SETTLED_PX = 0.1
_CONVINCING = 0.965
_COMPLETE = 0.96  # Of 900 real images 87 scored between this and 0.985; growing gained none of them a marker.
_EXPLAINED = 0.985
_DEAD_PINS = 0.8  # Of the least score: a fifth of the pins may be missing.
_DEAD_RMS = 0.5
_STILL_THERE = 0.6
_BANKED_AT_ONCE = 128
_NEAR = 0.3  # Largest accepted error of a first guess, in spacings; failed ones are off by more.
_ALIKE = 6
_MOST_STARTS = 2
_RINGS_GROWN = 6
_NEIGHBOURS = 7
_ONWARD = 1.2
_SAMPLED = 4  # Where to start is judged by one marker in four.


@dataclass(frozen=True, slots=True)
class DisplacementModel:
    """Linear model of the joint displacements of a sensor's markers.

    Attributes:
        reference: (m, 2) px, markers of the undeformed tip.
        mean: (2 m,) px, mean displacement (u, v, u, v, ...).
        basis: (k, 2 m) orthonormal rows, in order of decreasing variance.
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
        """Median distance of a reference marker from its nearest neighbour, px."""
        distances = np.linalg.norm(self.reference[:, None] - self.reference[None], axis=2)
        np.fill_diagonal(distances, np.inf)
        nearest = np.sort(distances.min(axis=1))
        # np.median would import numpy.ma, a twentieth of what it takes to start an estimator.
        return 0.5 * float(nearest[(len(nearest) - 1) // 2] + nearest[len(nearest) // 2])

    def positions(self, coefficients: Array) -> Array:
        """Return (..., m, 2) px of coefficients (..., k)."""
        flat: Array = self.base + np.einsum("...k,kj->...j", coefficients, self.basis)
        return flat.reshape(*flat.shape[:-1], -1, 2)

    @classmethod
    def fit(cls, reference: Array, displacements: Array, seen: NDArray[np.bool_], modes: int) -> DisplacementModel:
        """Fit principal components to displacements with missing values.

        Args:
            reference: (m, 2) px.
            displacements: (n, m, 2) px; those of unseen markers serve as a first guess.
            seen: (n, m).
            modes: number of components kept, at most n - 1.
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
    """Positions of all markers of a lattice in one image.

    Attributes:
        positions: (m, 2) px; of unseen markers as the displacement model fills them in.
        displacements: (m, 2) px from the reference.
        seen: (m,) markers that have a disc of their own.
        coefficients: (k,) px, of the displacement model.
        score: markers seen over those expected in view, or over the discs among them where these are more; 1 is best.
        rms_px: of the seen markers from the displacement model.
        explained: fraction of the discs among the markers that belong to one.
        valid: the match is reliable.
    """

    positions: Array
    displacements: Array
    seen: NDArray[np.bool_]
    coefficients: Array
    score: float
    rms_px: float
    explained: float
    valid: bool


@dataclass(frozen=True, slots=True)
class FirstGuess:
    """A network with one hidden layer from the density of discs to the coefficients of a displacement model.

    Attributes:
        low: (2,) px, corner of the grid.
        cell_px: side of a cell of the grid.
        hidden_weight, hidden_bias: (grid * grid, hidden), (hidden,).
        weight, bias: (k, hidden), (k,); outputs are in standard deviations of the coefficients.
        sd: (k,) px, standard deviation of its errors.
    """

    low: Array
    cell_px: float
    hidden_weight: NDArray[np.float32]
    hidden_bias: NDArray[np.float32]
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    sd: Array

    def density(self, centres: Array) -> NDArray[np.float32]:
        """Return its input (..., grid * grid), the density of discs (..., n, 2)."""
        grid = math.isqrt(len(self.hidden_weight))
        batch = centres.reshape(-1, *centres.shape[-2:])
        density = disc_density(batch, np.ones(batch.shape[:2]), self.low, self.cell_px, grid)
        return density.reshape(*centres.shape[:-2], -1)


def disc_density(centres: Array, weights: Array, low: Array, cell_px: float, grid: int) -> NDArray[np.float32]:
    """Return the density of discs in each cell of a grid, each distributed bilinearly over the four nearest cells.

    Args:
        centres: (b, n, 2) px.
        weights: (b, n), zero for an absent disc.
        low: (2,) px, corner of the grid.
        cell_px: side of a cell.
        grid: cells along each side.

    Returns:
        (b, grid * grid).
    """
    density = kernels.density(centres, weights, low, cell_px, grid)
    return density.reshape(len(centres), -1).astype(np.float32)


class MarkerMatcher:
    """Match the discs of consecutive frames to markers.

    Args:
        model: displacement model of the markers.
        guess: initial value for frames without a near previous frame.
        image_size: (height, width) px.
        bank: (b, k) learned coefficients, one or more. Those with the most similar discs are tried where the guess
            fails.
        least_score: a match below this is not accepted.
        most_rms_px: a match above this is not accepted.
    """

    def __init__(
        self,
        model: DisplacementModel,
        guess: FirstGuess,
        image_size: tuple[int, int],
        *,
        bank: Array,
        least_score: float = 0.9,
        most_rms_px: float = 2.0,
    ) -> None:
        self.model = model
        self._guess = guess
        self._hidden = kernels.HalfLayers(guess.hidden_weight[None], guess.hidden_bias[None])
        self._bank = bank
        self._least_score = least_score
        self._most_rms_px = most_rms_px
        self._base = model.base
        self._modes = kernels.Modes(model.base, model.basis)
        self._spacing_px = model.spacing_px
        self._reach = 0.3 * self._spacing_px
        height, width = image_size
        self._view = np.array([self._reach, self._spacing_px, 0.5 * self._spacing_px, width, height], np.float64)
        apart = np.linalg.norm(model.reference[:, None] - model.reference[None], axis=2)
        nearest = np.argsort(apart, axis=1)[:, 1 : _NEIGHBOURS + 1]
        # Markers of the rim have fewer neighbours: the number of markers is the index of a missing one.
        is_near = np.take_along_axis(apart, nearest, axis=1) < 1.5 * self._spacing_px
        self._neighbours = np.where(is_near, nearest, len(apart))
        # Far from the training contacts, a guess is off by more than its own standard deviation.
        self._guess_sd = np.hypot(3.0 * guess.sd, 0.1 * model.sd)
        # All at once would briefly take 100 MB, which a process does not return to the system.
        parts = (bank[i : i + _BANKED_AT_ONCE] for i in range(0, len(bank), _BANKED_AT_ONCE))
        places = (model.base + each @ model.basis for each in parts)
        self._bank_density = np.concatenate(
            [_in_bytes(guess.density(each.reshape(len(each), -1, 2))) for each in places]
        )

    def match(self, discs: Discs, previous: MarkerField | None = None) -> MarkerField:
        """Match the discs of one image.

        Args:
            discs: discs detected in the image.
            previous: result for the previous frame, if any; an invalid one is not used.
        """
        if not len(self.model.reference) // 4 <= len(discs) <= 4 * len(self.model.reference):
            return self._nothing()
        centres = discs.centres
        if previous is not None and previous.valid and self._is_near(previous, centres):
            field = self._refine(previous.coefficients, centres, self.model.sd, near=True)
            if _convincing(field):
                return field
        tried: list[MarkerField] = []
        for start, prior_sd in self._starts(centres):
            tried.append(self._refine(start, centres, prior_sd))
            # Of 2000 real images 21 scored between this and _CONVINCING; other starts gained none of them 0.01.
            if tried[-1].valid:
                break
        best = max(tried, key=quality)
        return replace(best, valid=True) if not best.valid and self._lacks_pins(best) else best

    def _lacks_pins(self, field: MarkerField) -> bool:
        """Return True if all discs belong to markers, and only some markers have no disc: pins that broke off.

        A wrong match leaves discs without a marker.
        """
        found = float(field.seen.mean())
        explained = field.explained >= _EXPLAINED and field.rms_px <= _DEAD_RMS * self._most_rms_px
        return explained and field.score >= _DEAD_PINS * self._least_score and found >= 0.5

    def _is_near(self, previous: MarkerField, centres: Array) -> bool:
        """Return True if most markers of the previous frame still have a disc close by."""
        square = self._modes.squares_apart(previous.coefficients, centres, _SAMPLED)
        return bool(np.count_nonzero(square < self._reach**2) > _STILL_THERE * len(square))

    def match_from(self, discs: Discs, starts: Iterable[Array]) -> MarkerField:
        """Return the best of the matches that start from other contacts' coefficients (k,), possibly far off."""
        prior_sd = 0.4 * self.model.sd
        return max((self._refine(start, discs.centres, prior_sd) for start in starts), key=quality)

    def _starts(self, centres: Array) -> Iterator[tuple[Array, Array]]:
        """Yield initial coefficients (k,) for a match, the most promising first, with their uncertainties (k,).

        Each is first tried with a single iteration: a start that fails costs ten times as much.
        """
        density = self._guess.density(centres)
        guess = self._guessed(density)
        off = self._off(guess, centres)
        if off < _NEAR * self._spacing_px:
            yield guess, self._guess_sd
        similar = self._most_similar(density)
        offs = [self._off(start, centres) for start in similar]
        order = np.argsort(offs)[:_MOST_STARTS]
        if _NEAR * self._spacing_px <= off <= offs[order[0]]:
            yield guess, self._guess_sd
        for i in order:
            yield similar[i], 0.4 * self.model.sd

    def _guessed(self, density: NDArray[np.float32]) -> Array:
        """Return the first guess's (k,) coefficients of a density (grid * grid,)."""
        hidden = np.maximum(self._hidden(density[None])[0], 0.0)
        guess: Array = (np.einsum("ij,j->i", self._guess.weight, hidden) + self._guess.bias) * self.model.sd
        return guess

    def _off(self, coefficients: Array, centres: Array) -> float:
        """Return the median distance px of the predicted markers from their nearest discs."""
        square = self._modes.squares_apart(coefficients, centres, _SAMPLED)
        middle = (len(square) - 1) // 2, len(square) // 2
        return math.sqrt(0.5 * float(np.partition(square, middle)[list(middle)].sum()))

    def _most_similar(self, density: NDArray[np.float32]) -> Array:
        """Return (s, k) coefficients of the learned contacts whose disc density is most similar to this image's."""
        apart = kernels.bytes_apart(self._bank_density, _in_bytes(density))
        if len(apart) <= _ALIKE:
            return self._bank
        return self._bank[np.argpartition(apart, _ALIKE)[:_ALIKE]]

    def _refine(self, start: Array, centres: Array, prior_sd: Array, *, near: bool = False) -> MarkerField:
        ridge = (_FIT_SD_PX / prior_sd) ** 2
        coefficients = self._settle(start, start, ridge, centres, self._reach if near else 2.0 * self._reach)
        field = self._field(coefficients, centres)
        if near or (field.valid and field.score >= _COMPLETE) or field.seen.mean() < 0.5:
            return field
        # Where a part of the rim is off by half a spacing, the correct part is extended to it.
        grown = self._grow(coefficients, start, ridge, centres)
        again = self._field(self._settle(grown, start, ridge, centres, self._reach), centres)
        return max(field, again, key=quality)

    def _settle(self, coefficients: Array, start: Array, ridge: Array, centres: Array, reach: float) -> Array:
        return self._modes.settle(
            coefficients,
            start,
            ridge,
            centres,
            reach_px=reach,
            least_reach_px=self._reach,
            settled_px=_SETTLED_PX,
            turns=_TURNS,
        )

    def _grow(self, coefficients: Array, start: Array, ridge: Array, centres: Array) -> Array:
        """Return the coefficients after markers without a disc were searched for where their neighbours predict."""
        return self._modes.grow(
            coefficients,
            start,
            ridge,
            centres,
            self._neighbours,
            reach_px=self._reach,
            onward=_ONWARD,
            turns=_RINGS_GROWN,
        )

    def _field(self, coefficients: Array, centres: Array) -> MarkerField:
        sighted = self._modes.find(coefficients, centres, self._view)
        found = sighted.found
        rms = math.sqrt(sighted.squares / found) if found else math.inf
        score = found / max(sighted.expected, found + sighted.among, 1)
        return MarkerField(
            positions=sighted.positions,
            displacements=sighted.positions - self.model.reference,
            seen=sighted.seen,
            coefficients=coefficients,
            score=score,
            rms_px=rms,
            explained=found / max(found + sighted.among, 1),
            valid=score >= self._least_score and rms <= self._most_rms_px and found >= len(sighted.seen) // 2,
        )

    def _nothing(self) -> MarkerField:
        positions = self._base.reshape(-1, 2)
        coefficients = np.zeros(len(self.model.sd))
        shift = positions - self.model.reference
        return MarkerField(positions.copy(), shift, np.zeros(len(shift), bool), coefficients, 0.0, np.inf, 0.0, False)


def _in_bytes(density: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Quantise densities to a hundredth of a disc, in a quarter of the memory."""
    rounded: NDArray[np.uint8] = np.minimum(100.0 * density + 0.5, 255.0).astype(np.uint8)
    return rounded


def _convincing(field: MarkerField) -> bool:
    return field.valid and field.score >= _CONVINCING


def quality(field: MarkerField) -> tuple[bool, float]:
    """Return a sort key of matches of one image; greater is better."""
    return field.valid, field.score - 0.05 * min(field.rms_px, 20.0)


def pair(places: Array, points: Array, reach: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the (m,) nearest point to each place, and whether it is within reach and nearest to no other place.

    Args:
        places: (m, 2) px.
        points: (n, 2) px.
        reach: px.
    """
    nearest, square, own = kernels.pair(places, points)
    return nearest, own & (square < reach * reach)
