"""The compiled kernels against OpenCV and plain NumPy, and the arguments that they refuse."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tests.helpers.compiled import extension
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception import kernels
from touchcell.perception.errors import ArrayError, KernelsMissing
from touchcell.perception.markers.matching import disc_density

_kernelsc = extension("touchcell.perception._kernelsc")

GREY = st.one_of(st.integers(0, 255), st.sampled_from([0, 1, 127, 128, 254, 255]))


def images(largest: int = 70) -> st.SearchStrategy[ImageArray]:
    """Noise, few grey levels, or nearly one colour, of any shape; sometimes a view into a larger frame."""
    shapes = st.tuples(st.integers(1, largest), st.integers(1, largest))

    def drawn(shape: tuple[int, int], seed: int, levels: int, view: bool) -> ImageArray:
        rng = np.random.default_rng(seed)
        frame = rng.integers(0, 256, (shape[0] + 4, shape[1] + 6)) // levels * levels
        cut = frame.astype(np.uint8)[1 : shape[0] + 1, 2 : shape[1] + 2]
        return cut if view else np.ascontiguousarray(cut)

    return st.builds(drawn, shapes, st.integers(0, 9999), st.sampled_from([1, 5, 64, 255]), st.booleans())


@given(images())
@settings(max_examples=150)
def test_median_is_opencvs(image: ImageArray) -> None:
    np.testing.assert_array_equal(kernels.median_5(image), cv2.medianBlur(np.ascontiguousarray(image), 5))


def test_median_of_all_columns_of_zeros_and_ones() -> None:
    """By the zero-one principle these 6^5 windows prove the exchange network for all numbers."""
    ones = np.stack(np.meshgrid(*[np.arange(6)] * 5, indexing="ij"), axis=-1).reshape(-1, 5)
    windows = (np.arange(5)[None, :, None] >= 5 - ones[:, None, :]).astype(np.uint8)
    image = np.ascontiguousarray(windows.transpose(1, 0, 2).reshape(5, -1))
    medians = kernels.median_5(image)[2, 2::5]
    np.testing.assert_array_equal(medians, windows.sum(axis=(1, 2)) >= 13)


@given(
    images(),
    st.integers(1, 127).map(lambda half: 2 * half + 1),
    st.floats(-300.0, 300.0) | st.sampled_from([-5.0, 0.0, 0.5, -0.5, 5.0]),
    st.booleans(),
)
@settings(max_examples=150)
@example(np.full((40, 50), 255, np.uint8), 255, 0.0, True)
@example(np.zeros((1, 1), np.uint8), 3, -1.0, False)
def test_threshold_is_opencvs(image: ImageArray, block_px: int, offset: float, of_median_5: bool) -> None:
    found = kernels.threshold(image, block_px, offset, of_median_5=of_median_5)
    image = np.ascontiguousarray(image)
    blurred = cv2.medianBlur(image, 5) if of_median_5 else image
    expected = cv2.adaptiveThreshold(blurred, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block_px, offset)
    if block_px < 129:
        np.testing.assert_array_equal(found, expected)
    else:
        # OpenCV multiplies by a rounded inverse of the area, which for large blocks can be wrong near one half.
        assert np.mean(found != expected) < 0.01


@given(images(200), st.integers(2, 9) | st.sampled_from([16, 32, 64]))
@settings(max_examples=100)
def test_area_means_are_opencvs(image: ImageArray, factor: int) -> None:
    size = (max(1, image.shape[0] // factor), max(1, image.shape[1] // factor))
    whole = np.resize(image, (size[0] * factor, size[1] * factor))
    expected = cv2.resize(whole, size[::-1], interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(kernels.area_means(whole, size), expected.reshape(size))


@given(images(200), st.floats(0.02, 1.0), st.floats(0.02, 1.0), st.booleans())
@settings(max_examples=150)
def test_area_means_of_any_size_are_opencvs(image: ImageArray, down: float, across: float, binary: bool) -> None:
    if binary:
        image = np.where(image > 127, np.uint8(255), np.uint8(0))
    size = (max(1, round(down * image.shape[0])), max(1, round(across * image.shape[1])))
    expected = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(kernels.area_means(image, size), expected.reshape(size))


@pytest.mark.parametrize(
    ("shape", "size"), [((440, 440), (128, 128)), ((440, 445), (128, 128)), ((430, 430), (99, 101))]
)
def test_area_means_of_frames_are_opencvs(shape: tuple[int, int], size: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (480, 640)).astype(np.uint8)[3:, 5:]
    frame = noise[: shape[0], : shape[1]]
    for image in (frame, np.where(frame > 200, np.uint8(255), np.uint8(0))):
        expected = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_array_equal(kernels.area_means(image, size), expected)


def test_area_means_round_halves_to_even() -> None:
    squares = np.zeros((5, 16), np.uint8)
    squares[:, 0] = [8, 24, 40, 7, 9]
    image = np.ascontiguousarray(squares.reshape(5, 4, 4).transpose(1, 0, 2).reshape(4, 20))
    np.testing.assert_array_equal(kernels.area_means(image, (1, 5)), [[0, 2, 2, 0, 1]])


@given(images(), st.integers(0, 255), st.integers(1, 30), st.integers(1, 300), st.integers(1, 40))
@settings(max_examples=150)
def test_discs_are_opencvs_components(image: ImageArray, level: int, smallest: int, more: int, longest: int) -> None:
    white = np.where(image > level, image, np.uint8(0))
    centres, areas = kernels.discs(white, smallest, smallest + more, longest)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(np.ascontiguousarray(white), connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA]
    sides = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    fits = (area >= smallest) & (area <= smallest + more) & (sides <= longest)
    expected = np.column_stack([centroids[1:][fits], area[fits]])
    found = np.column_stack([centres, areas])
    np.testing.assert_array_equal(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])


def points(least: int = 1, most: int = 40) -> st.SearchStrategy[Array]:
    """Positions of a few whole pixels, with many equal distances, or anywhere."""
    shapes = st.tuples(st.integers(least, most), st.just(2))
    coarse = hnp.arrays(np.float64, shapes, elements=st.integers(-8, 8).map(float))
    return coarse | hnp.arrays(np.float64, shapes, elements=st.floats(-600.0, 600.0, width=32))


def paired(places: Array, others: Array) -> tuple[Array, Array, Array]:
    """Reference for ``kernels.pair`` in plain NumPy."""
    square = ((others[None] - places[:, None]) ** 2)[..., 0] + ((others[None] - places[:, None]) ** 2)[..., 1]
    partner = square.argmin(axis=1)
    nearest = square[np.arange(len(places)), partner]
    order = np.lexsort([np.arange(len(places)), nearest, partner])
    owns = np.zeros(len(places), bool)
    owns[order] = np.append(True, np.diff(partner[order]) > 0)
    return partner, nearest, owns


@given(points(), points())
@settings(max_examples=100)
def test_pairs_are_those_of_all_distances(places: Array, others: Array) -> None:
    for found, expected in zip(kernels.pair(places, others), paired(places, others), strict=True):
        np.testing.assert_array_equal(found, expected)


def problem(seed: int, modes: int, markers: int) -> tuple[np.random.Generator, Array, Array]:
    """A basis of orthonormal rows and the undeformed positions of a grid of markers."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(2 * markers, modes)))[0].T
    side = math.isqrt(markers - 1) + 1
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:markers]
    return rng, 20.0 * grid.ravel().astype(np.float64), basis


def change(basis: Array, weight: Array, off: Array, from_start: Array, ridge: Array) -> Array:
    weighted = basis * np.repeat(weight, 2)
    found: Array = np.linalg.solve(weighted @ basis.T + np.diag(ridge), weighted @ off.ravel() + ridge * from_start)
    return found


@given(st.integers(0, 999), st.integers(1, 26), st.integers(1, 5))
@settings(max_examples=60)
def test_markers_are_their_own_points_or_where_the_coefficients_put_them(seed: int, modes: int, step: int) -> None:
    rng, base, basis = problem(seed, modes, markers=40)
    coefficients = rng.normal(0.0, 5.0, modes)
    predicted = (base + coefficients @ basis).reshape(-1, 2)
    others = np.concatenate([predicted[rng.random(40) < 0.8], rng.uniform(-40.0, 160.0, (15, 2))])
    others += rng.normal(0.0, 1.5, others.shape)
    reach, spacing, margin, width, height = 3.0, 9.0, 4.0, 110.0, 90.0
    partner, square, owns = paired(predicted, others)
    seen = owns & (square < reach**2)
    alone = np.delete(others, partner[seen], axis=0)
    among = np.count_nonzero(paired(alone, predicted)[1] < spacing**2) if len(alone) else 0
    u, v = predicted.T
    in_view = (u >= margin) & (u <= width - 1.0 - margin) & (v >= margin) & (v <= height - 1.0 - margin)

    kernel = kernels.Modes(base, basis)
    found = kernel.find(coefficients, others, np.array([reach, spacing, margin, width, height]))
    np.testing.assert_array_equal(found.seen, seen)
    np.testing.assert_allclose(found.positions, np.where(seen[:, None], others[partner], predicted), atol=1e-9)
    counts = (np.count_nonzero(seen), among, np.count_nonzero(in_view | seen))
    assert (found.found, found.among, found.expected) == counts
    assert found.squares == pytest.approx(square[seen].sum(), abs=1e-9)
    np.testing.assert_allclose(kernel.squares_apart(coefficients, others, step), square[::step], atol=1e-9)


def grown(
    base: Array, basis: Array, coefficients: Array, ridge: Array, others: Array, near: NDArray[np.int64]
) -> Array:
    """Reference for ``Modes.grow`` in plain NumPy, from coefficients that are the prior, within 4 px."""
    predicted = (base + coefficients @ basis).reshape(-1, 2)
    partner, square, owns = paired(predicted, others)
    seen = owns & (square < 16.0)
    off = np.where(seen[:, None], others[partner] - predicted, 0.0)
    for _ in range(6):
        count = np.append(seen, False)[near].sum(axis=1)
        mean = np.concatenate([off, np.zeros((1, 2))])[near].sum(axis=1) / np.maximum(count, 1)[:, None]
        partner, square, owns = paired(predicted + np.where(seen[:, None], off, 1.2 * mean), others)
        before = seen.sum()
        seen = owns & (square < 5.2**2) & (count >= 2)
        off = np.where(seen[:, None], others[partner] - predicted, 0.0)
        if seen.sum() <= before:
            break
    return coefficients + change(basis, seen.astype(np.float64), off, np.zeros(len(ridge)), ridge)


@given(st.integers(0, 999), st.integers(1, 26), st.floats(0.0, 0.4))
@settings(max_examples=60)
def test_a_match_grows_as_the_reference(seed: int, modes: int, stretch: float) -> None:
    rng, base, basis = problem(seed, modes, markers=60)
    grid = base.reshape(-1, 2)
    coefficients, ridge = rng.normal(0.0, 1.0, modes), 10.0 ** rng.uniform(-4.0, 2.0, modes)
    others = grid * [1.0 + stretch, 1.0] + rng.normal(0.0, 0.5, grid.shape)
    apart = np.linalg.norm(grid[:, None] - grid, axis=2)
    near = np.argsort(apart, axis=1)[:, 1:8]
    near = np.where(np.take_along_axis(apart, near, axis=1) < 30.0, near, len(grid))
    found = kernels.Modes(base, basis).grow(
        coefficients, coefficients, ridge, others, near, reach_px=4.0, onward=1.2, turns=6
    )
    # The moments are in single precision.
    np.testing.assert_allclose(found, grown(base, basis, coefficients, ridge, others, near), rtol=1e-5, atol=1e-4)


def test_a_basis_that_is_not_finite_is_refused() -> None:
    _, base, basis = problem(0, modes=3, markers=20)
    basis[1, 2] = np.nan
    with pytest.raises(ArrayError, match="finite"):
        kernels.Modes(base, basis)


@given(st.integers(1, 3), st.integers(1, 30), st.integers(1, 30))
@settings(max_examples=50)
def test_half_layers_are_products_of_rounded_weights_on_any_processor(networks: int, inputs: int, outputs: int) -> None:
    rng = np.random.default_rng(31 * inputs + outputs)
    weight, bias, x = (
        rng.normal(size=n).astype(np.float32)
        for n in ((networks, inputs, outputs), (networks, outputs), (networks, inputs))
    )
    layers = kernels.HalfLayers(weight, bias)(x)
    rounded = weight.astype(np.float16).astype(np.float64)
    np.testing.assert_allclose(layers, np.einsum("ni,nij->nj", x, rounded) + bias, rtol=1e-4, atol=1e-4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "_FOUND", SimpleNamespace(reads_halves=lambda: False, affine=_kernelsc.affine))
        np.testing.assert_array_equal(kernels.HalfLayers(weight, bias)(x), layers)


def settled(
    base: Array,
    basis: Array,
    coefficients: Array,
    start: Array,
    ridge: Array,
    others: Array,
    reach: float,
    least: float,
) -> Array:
    """Reference for ``Modes.settle`` in plain NumPy: 12 iterations or a shift below 0.1 px."""
    for _ in range(12):
        predicted = (base + coefficients @ basis).reshape(-1, 2)
        partner, square, owns = paired(predicted, others)
        close = owns & (square < reach**2)
        if close.sum() < len(start):
            break
        weight = close / (1.0 + square / (0.35 * reach) ** 2)
        step = change(basis, weight, others[partner] - predicted, start - coefficients, ridge)
        coefficients = coefficients + step
        if reach <= least and np.abs(step @ basis).max() < 0.1:
            break
        reach = max(least, min(0.8 * reach, 4.0 * math.sqrt(float(np.median(square[close])))))
    return coefficients


@given(st.integers(0, 999), st.floats(0.0, 20.0), st.floats(4.0, 15.0))
@settings(max_examples=60)
def test_settling_takes_the_iterations_of_the_reference(seed: int, far_px: float, reach: float) -> None:
    rng, base, basis = problem(seed, modes=6, markers=50)
    truth = rng.normal(0.0, far_px, 6)
    others = (base + truth @ basis).reshape(-1, 2) + rng.normal(0.0, 0.2, (50, 2))
    others = np.concatenate([others[rng.random(50) < 0.9], rng.uniform(-20.0, 160.0, (3, 2))])
    start = truth + rng.normal(0.0, 0.3 * far_px, 6)
    ridge = np.full(6, 0.01)
    begin = start + rng.normal(0.0, 1.0, 6)
    found = kernels.Modes(base, basis).settle(
        begin, start, ridge, others, reach_px=reach, least_reach_px=4.0, settled_px=0.1, turns=12
    )
    np.testing.assert_allclose(found, settled(base, basis, begin, start, ridge, others, reach, 4.0), atol=1e-7)


def test_settling_recovers_the_motion_and_is_deterministic() -> None:
    rng, base, basis = problem(5, modes=6, markers=331)
    truth = rng.normal(0.0, 30.0, 6)
    others = (base + truth @ basis).reshape(-1, 2)
    modes = kernels.Modes(base, basis)

    def found() -> Array:
        start, ridge = truth + 3.0, np.full(6, 1e-6)
        return modes.settle(start, start, ridge, others, reach_px=9.0, least_reach_px=6.0, settled_px=0.1, turns=12)

    np.testing.assert_allclose(found(), truth, atol=1e-3)
    np.testing.assert_array_equal(found(), found())


def test_density_is_distributed_over_four_cells() -> None:
    low = np.array([10.0, 20.0])
    centres = np.array([[[10.0 + 2.5 * 4.0, 20.0 + 1.5 * 4.0], [12.0 + 3.0, 22.0 + 1.0], [-50.0, 0.0]]])
    density = disc_density(centres, np.array([[1.0, 2.0, 1.0]]), low, 4.0, 5).reshape(5, 5)
    expected = np.zeros((5, 5))
    expected[1, 2] = 1.0
    expected[0, 0] += 2.0 * 0.25 * 0.75
    expected[0, 1] += 2.0 * 0.75 * 0.75
    expected[1, 0] += 2.0 * 0.25 * 0.25
    expected[1, 1] += 2.0 * 0.75 * 0.25
    np.testing.assert_allclose(density, expected, atol=1e-7)


@given(st.integers(0, 30), st.integers(0, 30))
@settings(max_examples=50)
def test_affine_is_a_matrix_product(inputs: int, outputs: int) -> None:
    rng = np.random.default_rng(31 * inputs + outputs)
    weight, bias, x = (rng.normal(size=n).astype(np.float32) for n in ((inputs, outputs), outputs, inputs))
    np.testing.assert_allclose(kernels.affine(weight, bias, x), x @ weight + bias, rtol=1e-4, atol=1e-4)


@given(st.integers(0, 40), st.integers(0, 70), st.integers(0, 999))
@settings(max_examples=50)
def test_distances_of_bytes_are_whole(count: int, length: int, seed: int) -> None:
    rows = np.random.default_rng(seed).integers(0, 256, (count + 1, length), dtype=np.uint8)
    expected = np.square(rows[1:].astype(np.int32) - rows[0]).sum(axis=1)
    np.testing.assert_array_equal(kernels.bytes_apart(np.ascontiguousarray(rows[1:]), rows[0]), expected)


BASIS = np.ones((6, 8)), np.ones((6, 8), np.float32)
GOOD: dict[Callable[..., object], tuple[object, ...]] = {
    _kernelsc.median_5: (np.zeros((4, 5), np.uint8), np.zeros((4, 5), np.uint8)),
    _kernelsc.threshold: (np.zeros((4, 5), np.uint8), True, 3, 0.0, np.zeros((4, 5), np.uint8)),
    _kernelsc.shrink: (np.zeros((8, 12), np.uint8), 4, np.zeros((2, 3), np.uint8)),
    _kernelsc.area_means: (np.zeros((8, 12), np.uint8), np.zeros((3, 5), np.uint8)),
    _kernelsc.discs: (np.zeros((4, 5), np.uint8), 1, 9, 9),
    _kernelsc.pair: (np.zeros((3, 2)), np.zeros((4, 2)), np.zeros(3, np.int64), np.zeros(3), np.zeros(3, bool)),
    _kernelsc.grow: (
        *(*BASIS, np.ones(6), np.zeros(2), np.zeros(2), np.ones(2), np.zeros((4, 2))),
        *(np.full((3, 2), 3), 5.0, 1.2, 6, np.zeros(2)),
    ),
    _kernelsc.squares_apart: (*BASIS, np.ones(6), np.zeros(2), np.zeros((4, 2)), 1, np.zeros(3)),
    _kernelsc.find_markers: (
        *(*BASIS, np.ones(6), np.zeros(2), np.zeros((4, 2)), np.ones(5)),
        *(np.zeros((3, 2)), np.zeros(3, bool)),
    ),
    _kernelsc.settle: (
        *(*BASIS, np.ones(6), np.zeros(2), np.ones(2), np.zeros((4, 2))),
        *(5.0, 2.0, 0.1, 12, np.zeros(2)),
    ),
    _kernelsc.density: (np.zeros((2, 3, 2)), np.zeros((2, 3)), np.zeros(2), 4.0, np.zeros((2, 5, 5))),
    _kernelsc.bytes_apart: (np.zeros((3, 5), np.uint8), np.zeros(5, np.uint8), np.zeros(3, np.int32)),
    _kernelsc.affine: (*(np.zeros(shape, np.float32) for shape in ((2, 3), 3, 2)), np.zeros(3, np.float32)),
}
if _kernelsc.reads_halves():
    halves = np.zeros((2, 1, 1, 64), np.float16), *(np.zeros(shape, np.float32) for shape in ((2, 8), (2, 5), (2, 8)))
    GOOD[_kernelsc.affine_of_halves] = halves
SHAPES = st.sampled_from([(), (0,), (1,), (2,), (3,), (6,), (2, 3), (4, 5), (6, 8), (0, 2), (3, 0), (4, 2), (2, 3, 2)])
TYPES = st.sampled_from([np.uint8, np.int64, np.float32, np.float64, np.bool_, np.complex128])


@pytest.mark.parametrize("kernel", GOOD, ids=lambda kernel: kernel.__name__)
@settings(max_examples=60)
@given(data=st.data())
def test_other_arrays_are_refused_or_computed(kernel: Callable[..., object], data: st.DataObject) -> None:
    arguments = list(GOOD[kernel])
    kernel(*arguments)
    at = data.draw(st.integers(0, len(arguments) - 1))
    strange = [np.nan, np.inf, -1, 1e300, None, "x", [1.0]]
    arrays = st.builds(lambda shape, kind: np.ones(shape, kind), SHAPES, TYPES)
    arguments[at] = data.draw(arrays | st.sampled_from(strange), label="argument")
    try:
        kernel(*arguments)
    except (ArrayError, TypeError):
        return
    given_in, other = GOOD[kernel][at], arguments[at]
    if isinstance(given_in, np.ndarray):
        # Other lengths may be valid, other types and ranks never.
        assert isinstance(other, np.ndarray)
        assert (other.dtype, other.ndim) == (given_in.dtype, given_in.ndim)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf, 1e10])
@pytest.mark.parametrize(
    ("kernel", "at"),
    [
        *((kernel, at) for kernel, at in [(_kernelsc.pair, 0), (_kernelsc.pair, 1)]),
        *((_kernelsc.grow, at) for at in range(2, 7)),
        *((_kernelsc.squares_apart, at) for at in range(2, 5)),
        *((_kernelsc.find_markers, at) for at in range(2, 6)),
        *((_kernelsc.settle, at) for at in range(2, 6)),
        *((_kernelsc.density, at) for at in range(3)),
    ],
)
def test_non_finite_arguments_are_refused_by_name(kernel: Callable[..., object], at: int, poison: float) -> None:
    arguments = list(GOOD[kernel])
    array = np.array(arguments[at])
    array.flat[-1] = poison
    arguments[at] = array
    with pytest.raises(ArrayError, match="finite") as caught:
        kernel(*arguments)
    assert caught.value.function == kernel.__name__


def test_non_contiguous_arrays_are_refused() -> None:
    for kernel, at in [(_kernelsc.pair, 0), (_kernelsc.settle, 0), (_kernelsc.affine, 0)]:
        arguments = list(GOOD[kernel])
        arguments[at] = np.asfortranarray(np.ones((6, 8)))[::2, ::2]
        with pytest.raises(ArrayError, match="order"):
            kernel(*arguments)
    with pytest.raises(ArrayError, match="side by side"):
        _kernelsc.discs(np.zeros((4, 10), np.uint8)[:, ::2], 1, 9, 9)
    read_only = np.zeros((4, 5), np.uint8)
    read_only.setflags(write=False)
    with pytest.raises(ArrayError):
        _kernelsc.median_5(np.zeros((4, 5), np.uint8), read_only)


def test_without_the_extension_images_stay_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)

    def reduced() -> list[ImageArray]:
        white = [kernels.threshold(image, 31, -5.0, of_median_5=median) for median in (False, True)]
        return [*white, kernels.median_5(image), kernels.area_means(image, (12, 16))]

    compiled = reduced()
    monkeypatch.setattr(kernels, "_FOUND", None)
    for found, expected in zip(reduced(), compiled, strict=True):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(KernelsMissing, match="C compiler"):
        kernels.discs(image, 1, 9, 9)


def test_mean_shift_moves_to_the_middle_of_a_disc_and_measures_its_light() -> None:
    v, u = np.mgrid[:40, :50]
    image = np.rint(255.0 * np.clip(2.5 - np.hypot(u - 20.3, v - 14.8), 0.0, 1.0)).astype(np.uint8)
    places, levels = kernels.mean_shift(image, np.array([[21.5, 14.0], [45.0, 35.0], [-900.0, 3.0]]), 3.0, 20)
    assert places[0] == pytest.approx([20.3, 14.8], abs=0.1)
    assert levels[0] > 100.0
    assert places[1:].tolist() == [[45.0, 35.0], [-900.0, 3.0]]
    assert levels[1:].tolist() == [0.0, 0.0]


@given(images(40), st.integers(0, 9999), st.floats(0.6, 9.0), st.integers(1, 5))
@settings(deadline=None)
def test_compiled_mean_shift_is_that_in_numpy(image: ImageArray, seed: int, radius: float, turns: int) -> None:
    starts = np.random.default_rng(seed).uniform(-12, 55, (7, 2))
    compiled, levels = kernels.mean_shift(image, starts, radius, turns)
    plain, plain_levels = starts.copy(), np.empty(7)
    kernels._shift_in_numpy(image, plain, plain_levels, radius, turns)
    assert compiled == pytest.approx(plain, abs=1e-2)
    assert levels == pytest.approx(plain_levels, abs=1e-2)


@given(images(40), st.integers(0, 9999), st.integers(1, 9))
def test_block_changes_are_the_means_of_each_block(image: ImageArray, seed: int, blocks: int) -> None:
    blocks = min(blocks, *image.shape)
    other = np.random.default_rng(seed).integers(0, 256, image.shape).astype(np.uint8)
    found = kernels.block_changes(image, other, blocks)
    rows, columns = (np.arange(blocks + 1) * side // blocks for side in image.shape)
    apart = np.abs(image.astype(int) - other)
    means = [[apart[a:b, c:d].mean() for c, d in pairwise(columns)] for a, b in pairwise(rows)]
    assert found == pytest.approx(np.array(means))


def test_neighbours_and_sizes_that_do_not_fit_are_refused() -> None:
    m = 5
    weight, rest, terms = np.zeros((84, 2 * m), np.float32), np.zeros(2 * m, np.float32), np.zeros(84, np.float32)
    numbers = {"radius_px": 2.0, "turns": 3, "least_level": 10.0, "stray_px": 2.0}
    image = np.zeros((20, 20), np.uint8)
    outside = np.full((m, 2), m, np.int64)
    with pytest.raises(ArrayError):
        kernels.Follower(weight, rest, outside, np.ones(2), **numbers)(image, terms)
    inside = np.zeros((m, 2), np.int64)
    with pytest.raises(ArrayError):
        kernels.Follower(weight, rest, inside, np.zeros(2), **numbers)(image, terms)
    with pytest.raises(ArrayError):
        kernels.Follower(weight, rest, inside, np.ones(2), **numbers)(image, terms[:80])
    with pytest.raises(ArrayError):
        kernels.block_changes(image, image[:10], 4)
