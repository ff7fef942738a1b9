"""Inner loops of perception, in C: arrays in, new arrays out.

Each raises ``ArrayError`` where an argument has another shape or type than documented, or is not finite. Without the
compiled extension the image filters use OpenCV, with bit-identical results, and the others raise ``KernelsMissing``.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchcell.compiled import extension
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import ArrayError, KernelsMissing

_TILE = 8
_MOST_OFFSET = 256.0
_MOST_BASIS = 1.0 + 1e-6
_SETTLED_PX = 0.05
_FACTORS = (4, 8, 16, 32, 64)


_FOUND = extension("touchcell.perception._kernelsc")


def _compiled() -> ModuleType:
    if _FOUND is None:
        raise KernelsMissing
    return _FOUND


def _in_rows(image: ImageArray) -> ImageArray:
    return image if image.strides[-1] == 1 else np.ascontiguousarray(image)


def compiled() -> bool:
    """Return True if the compiled extension is installed."""
    return _FOUND is not None


def first_block(image: ImageArray, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return 3x3 convolution, 2x2 maximum and ReLU of a grey image: (features, height / 2, width / 2), rounded down.

    Three times as fast as ONNX Runtime, which stores the image's features four times before it takes the maximum.

    Args:
        image: uint8 (height, width), 2 px or more each; zero beyond its border.
        weight: (features, 9), for grey levels.
        bias: (features,).
    """
    height, width = image.shape
    features = np.empty((len(bias), height // 2, width // 2), np.float32)
    _compiled().first_block(_in_rows(image), weight, bias, features)
    return features


def median_5(image: ImageArray) -> ImageArray:
    """Return the median of 5x5 pixels of a grey image, its border replicated; takes half the time of OpenCV's."""
    import cv2

    if _FOUND is None:
        return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), 5), np.uint8)
    medians = np.empty(image.shape, np.uint8)
    _FOUND.median_5(_in_rows(image), medians)
    return medians


def threshold(image: ImageArray, block_px: int, offset: float, *, of_median_5: bool) -> ImageArray:
    """Return 255 where a grey pixel exceeds the mean of its neighbourhood less ``offset``, 0 elsewhere.

    Args:
        image: uint8 (height, width).
        block_px: side of the square neighbourhood, odd, 3 to 255; the image's border is replicated.
        offset: grey levels.
        of_median_5: take the medians of 5x5 pixels first, without storing the whole filtered image.
    """
    import cv2

    if _FOUND is None:
        image = median_5(image) if of_median_5 else np.ascontiguousarray(image)
        mean, binary = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY
        return np.asarray(cv2.adaptiveThreshold(image, 255, mean, binary, block_px, offset), np.uint8)
    white = np.empty(image.shape, np.uint8)
    whole = max(-_MOST_OFFSET, min(math.ceil(offset), _MOST_OFFSET))
    _FOUND.threshold(_in_rows(image), of_median_5, block_px, whole, white)
    return white


def area_means(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """Resize a grey image by averaging over the area of each new pixel, rounded.

    Args:
        image: uint8 (height, width).
        size: (height, width) of the result.
    """
    import cv2

    (height, width), (rows, columns) = image.shape, size
    factor = height // rows
    whole = height % rows == 0 and width % columns == 0
    other = whole and not (factor in _FACTORS and width == factor * columns)
    if _FOUND is None or other or rows > height or columns > width:
        return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    means = np.empty(size, np.uint8)
    if whole:
        _FOUND.shrink(_in_rows(image), factor, means)
    else:
        _FOUND.area_means(_in_rows(image), means)
    return means


def discs(image: ImageArray, smallest_px: int, largest_px: int, longest_side_px: int) -> tuple[Array, Array]:
    """Find connected components (8 neighbours) of non-zero pixels, in the order of their first pixels.

    Args:
        image: uint8 (height, width).
        smallest_px, largest_px: bounds on the area.
        longest_side_px: bound on width and height.

    Returns:
        (n, 2) centroids (u, v), px, and (n,) areas.
    """
    found = np.frombuffer(_compiled().discs(_in_rows(image), smallest_px, largest_px, longest_side_px))
    n = len(found) // 3
    return found[: 2 * n].reshape(n, 2), found[2 * n :]


def mean_shift(image: ImageArray, places: Array, radius_px: float, turns: int) -> tuple[Array, Array]:
    """Move places to the centroid of the brightness around them, repeatedly, until they stay within 0.05 px.

    Mean shift (Comaniciu & Meer 2002) with weights 1 - (distance / radius)^2; outside of the image everything is black.

    Args:
        image: uint8 (height, width).
        places: (m, 2) px, (u, v).
        radius_px: distance beyond which nothing counts, 0.5 to 256.
        turns: largest number of moves.

    Returns:
        (m, 2) px, and (m,) weighted mean grey levels there.
    """
    moved, levels = np.array(places, np.float64, order="C"), np.empty(len(places))
    if _FOUND is None:
        _shift_in_numpy(image, moved, levels, radius_px, turns)
    else:
        _FOUND.mean_shift(_in_rows(image), radius_px, turns, moved, levels)
    return moved, levels


def _shift_in_numpy(image: ImageArray, moved: Array, levels: Array, radius_px: float, turns: int) -> None:
    reach = math.ceil(radius_px) + 1
    dark = np.pad(image, 2 * reach)
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, 1, -1)
    left = np.arange(len(moved))
    levels[:] = 0.0
    inside = ((moved >= -radius_px) & (moved <= np.array(image.shape[::-1]) + radius_px)).all(axis=1)
    left = left[inside]
    for _ in range(turns):
        nearest = np.rint(moved[left]).astype(np.int64)
        du, dv = u - (moved[left] - nearest)[:, :1], v - (moved[left] - nearest)[:, 1:]
        weight = np.maximum(1.0 - (du * du + dv * dv) / radius_px**2, 0.0)
        light = weight * dark[nearest[:, 1:] + v + 2 * reach, nearest[:, :1] + u + 2 * reach]
        total = light.sum(axis=1)
        levels[left] = total / (0.5 * np.pi * radius_px**2)
        step = np.column_stack([(light * du).sum(axis=1), (light * dv).sum(axis=1)]) / np.maximum(total, 1e-9)[:, None]
        moved[left] += step
        left = left[np.hypot(*step.T) >= _SETTLED_PX]
        if not len(left):
            return


def block_changes(one: ImageArray, other: ImageArray, blocks: int) -> Array:
    """Return (blocks, blocks) mean absolute differences of two grey images of one size, at least ``blocks`` px wide."""
    means = np.empty((blocks, blocks))
    if _FOUND is not None:
        _FOUND.block_changes(_in_rows(one), _in_rows(other), means)
        return means
    rows, columns = (np.arange(blocks + 1) * side // blocks for side in one.shape)
    difference = np.abs(one.astype(np.int16) - other)
    sums = np.add.reduceat(np.add.reduceat(difference, rows[:-1], axis=0, dtype=np.int64), columns[:-1], axis=1)
    return np.asarray(sums / np.outer(np.diff(rows), np.diff(columns)))


class Followed(NamedTuple):
    """Markers next to where they are expected.

    Attributes:
        expected: (m, 2) px of the crop.
        off: (m, 2) px, distances of the places found from there.
        around: (m, 2) px, means of the bright neighbours' distances.
        seen: (m,) whether there is light, and the distance is like the neighbours'.
        light: share of the image's light at bright places, in units of their mean grey levels.
    """

    expected: Array
    off: Array
    around: Array
    seen: NDArray[np.bool_]
    light: float


class Follower:
    """Search for markers where a polynomial of six numbers expects them.

    Args:
        weight: (84, 2 m) px of the crop, of the terms.
        rest: (2 m,) px, beside them.
        neighbours: (m, k) numbers of each marker's neighbours.
        px: (2,) size along u and v of a pixel of the image, px of the crop.
        radius_px, turns: of the mean shift, px of the image.
        least_level: grey level of a place that is bright.
        stray_px: largest distance from the neighbours' mean, px of the crop.
    """

    def __init__(
        self,
        weight: NDArray[np.float32],
        rest: NDArray[np.float32],
        neighbours: NDArray[np.int64],
        px: Array,
        *,
        radius_px: float,
        turns: int,
        least_level: float,
        stray_px: float,
    ) -> None:
        self._weight, self._rest, self._neighbours, self._px = weight, rest, neighbours, px
        self._radius_px, self._turns, self._least_level, self._stray_px = radius_px, turns, least_level, stray_px
        self._limits = np.array([*px, radius_px, turns, least_level, stray_px], np.float64)
        self._nothing = np.zeros((len(neighbours), 2))

    def __call__(self, image: ImageArray, terms: NDArray[np.float32], field: Array | None = None) -> Followed:
        """Search in a uint8 (height, width) image, ``field`` (m, 2) px from where the 84 ``terms`` put the markers."""
        field = self._nothing if field is None else field
        if _FOUND is None:
            return self._in_numpy(image, terms, field)
        m = len(field)
        expected, off, around = np.empty((m, 2)), np.empty((m, 2)), np.empty((m, 2))
        seen = np.empty(m, np.bool_)
        light = _FOUND.follow(
            _in_rows(image),
            terms,
            self._weight,
            self._rest,
            field,
            self._neighbours,
            self._limits,
            expected,
            off,
            around,
            seen,
        )
        return Followed(expected, off, around, seen, light)

    def _in_numpy(self, image: ImageArray, terms: NDArray[np.float32], field: Array) -> Followed:
        expected = affine(self._weight, self._rest, terms).astype(np.float64).reshape(-1, 2)
        starts = (expected + field + 0.5) / self._px - 0.5
        places, levels = mean_shift(image, starts, self._radius_px, self._turns)
        off = (places + 0.5) * self._px - 0.5 - expected
        bright = levels >= self._least_level
        count = np.maximum(bright[self._neighbours].sum(axis=1), 1)
        around: Array = np.where(bright[:, None], off, 0.0)[self._neighbours].sum(axis=1) / count[:, None]
        seen = bright & (np.square(off - around).sum(axis=1) < self._stray_px**2)
        light = float(levels[bright].sum()) / max(float(image.sum(dtype=np.int64)), 1.0)
        return Followed(expected, off, around, seen, light)


def measure_field(
    off: Array, mean: NDArray[np.float32], rows: NDArray[np.float32], sd: Array, strongest: int, filters: int
) -> Array:
    """Return size and roughness of a field of distances, then its products with filters: (2 + filters,).

    Args:
        off: (m, 2) px.
        mean: (2 m,) px, subtracted first.
        rows: (2 m, modes + filters), orthonormal modes and filters as columns.
        sd: (modes,) standard deviations of the modes.
        strongest: so many modes make the size, in root mean square standard deviations.
        filters: how many.
    """
    if _FOUND is None:
        left = off.ravel() - mean
        products = np.einsum("i,ij->j", left, rows)
        modes = products[: len(sd)]
        size = np.sqrt(np.square(modes / sd)[:strongest].mean())
        rough = np.sqrt(max(float(left @ left - modes @ modes), 0.0) / len(off))
        return np.concatenate([[size, rough], products[len(sd) :]])
    measured = np.empty(2 + filters)
    _FOUND.measure_field(off, mean, rows, sd, strongest, measured)
    return measured


def pair(places: Array, points: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Return the nearest point to each place, its squared distance, and whether no other place is nearer to that point.

    Args:
        places: (m, 2), one or more.
        points: (n, 2), one or more.

    Returns:
        (m,) each; among equals the first.
    """
    m = len(places)
    partner, square, owns = np.empty(m, np.int64), np.empty(m), np.empty(m, np.bool_)
    _compiled().pair(np.ascontiguousarray(places), np.ascontiguousarray(points), partner, square, owns)
    return partner, square, owns


class Sighting(NamedTuple):
    """Markers beside the points of an image.

    Attributes:
        positions: (m, 2) px, each marker's own point, or where the coefficients put it.
        seen: (m,) whether it has a point of its own.
        found: how many have one.
        among: points that are no marker's own although a marker is near.
        expected: markers that are seen or should be in view.
        squares: sum of squared distances of the seen ones from their points, px^2.
    """

    positions: Array
    seen: NDArray[np.bool_]
    found: int
    among: int
    expected: int
    squares: float


class Modes:
    """Displacement modes of the markers, laid out for the searches and fits of a matcher.

    Args:
        base: (2 m,) px, markers (u, v, u, v, ...) with all coefficients zero.
        basis: (k, 2 m), one orthonormal row per mode.
    """

    def __init__(self, base: Array, basis: Array) -> None:
        if not (np.abs(basis) <= _MOST_BASIS).all():
            raise ArrayError("Modes", "basis", "is not finite, or larger than 1")
        modes, coordinates = basis.shape
        self._base = np.ascontiguousarray(base)
        self._modes = modes
        self._basis = np.zeros((coordinates, -(-modes // _TILE) * _TILE))
        self._basis[:, :modes] = basis.T
        self._rough = self._basis.astype(np.float32)

    def squares_apart(self, coefficients: Array, points: Array, step: int) -> Array:
        """Return px^2, squared distances of each ``step`` of the markers from the nearest point.

        Args:
            coefficients: (k,) px.
            points: (n, 2) px, one or more.
            step: 1 for all markers.
        """
        squares = np.empty((len(self._base) // 2 - 1) // step + 1)
        _compiled().squares_apart(
            self._basis, self._rough, self._base, coefficients, np.ascontiguousarray(points), step, squares
        )
        return squares

    def find(self, coefficients: Array, points: Array, view: Array) -> Sighting:
        """Return the markers of (k,) coefficients beside points (n, 2) px.

        Args:
            coefficients: (k,) px.
            points: (n, 2) px, one or more.
            view: (5,) px: a marker's own point is within the first; points within the second of a marker count as
                ``among``; a marker is in view if it lies the third inside an image of the fourth's width, the
                fifth's height.
        """
        m = len(self._base) // 2
        positions, seen = np.empty((m, 2)), np.empty(m, np.bool_)
        counts = _compiled().find_markers(
            self._basis, self._rough, self._base, coefficients, np.ascontiguousarray(points), view, positions, seen
        )
        return Sighting(positions, seen, *counts)

    def grow(
        self,
        coefficients: Array,
        start: Array,
        ridge: Array,
        points: Array,
        neighbours: NDArray[np.int64],
        *,
        reach_px: float,
        onward: float,
        turns: int,
    ) -> Array:
        """Return the (k,) coefficients after markers without a point were searched for where their neighbours are.

        Args:
            coefficients: (k,) px, initial value.
            start: (k,) px, prior.
            ridge: (k,) weight of the prior.
            points: (n, 2) px.
            neighbours: (m, j) numbers of each marker's neighbours; m for none.
            reach_px: limit on the distance of a first pair; 1.3 of it for those found later.
            onward: a marker is searched for so many times its neighbours' mean displacement away.
            turns: largest number of searches.
        """
        change = np.empty(self._modes)
        _compiled().grow(
            self._basis,
            self._rough,
            self._base,
            coefficients,
            np.ascontiguousarray(start),
            ridge,
            np.ascontiguousarray(points),
            neighbours,
            reach_px,
            onward,
            turns,
            change,
        )
        return coefficients + change

    def settle(
        self,
        coefficients: Array,
        start: Array,
        ridge: Array,
        points: Array,
        *,
        reach_px: float,
        least_reach_px: float,
        settled_px: float,
        turns: int,
    ) -> Array:
        """Return the (k,) coefficients after alternately pairing markers with points and fitting, until convergence.

        Args:
            coefficients: (k,) px, initial value.
            start: (k,) px, prior.
            ridge: (k,) weight of the prior.
            points: (n, 2) px.
            reach_px: initial limit on the distance of a pair.
            least_reach_px: final limit.
            settled_px: shifts below this count as converged.
            turns: largest number of iterations.
        """
        settled = np.array(coefficients, dtype=np.float64)
        _compiled().settle(
            self._basis,
            self._rough,
            self._base,
            np.ascontiguousarray(start),
            ridge,
            np.ascontiguousarray(points),
            reach_px,
            least_reach_px,
            settled_px,
            turns,
            settled,
        )
        return settled


def density(centres: Array, weights: Array, low: Array, cell_px: float, grid: int) -> Array:
    """Return the density of points in each cell of a grid, each distributed bilinearly over four cells.

    Args:
        centres: (b, n, 2) px.
        weights: (b, n).
        low: (2,) px, corner of the grid.
        cell_px: side of a cell.
        grid: cells along each side.

    Returns:
        (b, grid, grid), rows along v.
    """
    result = np.zeros((len(centres), grid, grid))
    _compiled().density(np.ascontiguousarray(centres), np.ascontiguousarray(weights), low, cell_px, result)
    return result


def bytes_apart(rows: NDArray[np.uint8], one: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return (b,) squared distances of rows (b, n) from another row (n,), n at most 32768."""
    apart = np.empty(len(rows), np.int32)
    _compiled().bytes_apart(rows, one, apart)
    return apart


def affine(weight: NDArray[np.float32], bias: NDArray[np.float32], x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return x W + b computed on the calling thread: (outputs,) of a weight (inputs, outputs)."""
    if _FOUND is None:
        return np.asarray(np.einsum("i,ij->j", x, weight) + bias, np.float32)
    result = np.empty(len(bias), np.float32)
    _FOUND.affine(weight, bias, x, result)
    return result


class HalfLayers:
    """Layers of networks side by side, x W + b each, with weights rounded to half precision.

    The time of a layer is that of reading its weights, and half precision halves it; it is off by 2^-11 of each weight.
    A processor that does not read half precision gets the same results from the same weights, in single precision.

    Args:
        weight: (networks, inputs, outputs), each within +-65504.
        bias: (networks, outputs).
    """

    def __init__(self, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> None:
        networks, inputs, self._outputs = weight.shape
        into, out = -(-inputs // _TILE), -(-self._outputs // _TILE)
        padded = np.zeros((networks, into * _TILE, out * _TILE), np.float16)
        padded[:, :inputs, : self._outputs] = weight
        self._bias = np.zeros((networks, out * _TILE), np.float32)
        self._bias[:, : self._outputs] = bias
        self._halves = _FOUND is not None and _FOUND.reads_halves()
        if self._halves:
            tiles = padded.reshape(networks, into, _TILE, out, _TILE).transpose(0, 1, 3, 2, 4)
            self._weight: NDArray[np.floating] = np.ascontiguousarray(tiles).reshape(networks, into, out, _TILE**2)
        else:
            self._weight = padded.astype(np.float32)

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (networks, outputs) of inputs (networks, inputs)."""
        result = np.empty_like(self._bias)
        if self._halves and _FOUND is not None:
            _FOUND.affine_of_halves(self._weight, self._bias, x, result)
        else:
            padded = np.zeros((len(x), self._weight.shape[1]), np.float32)
            padded[:, : x.shape[1]] = x
            for weight, bias, each, to in zip(self._weight, self._bias, padded, result, strict=True):
                to[:] = affine(weight, bias, each)
        return result[:, : self._outputs]
