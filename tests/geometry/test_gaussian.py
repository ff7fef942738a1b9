"""touchcell.geometry.gaussian against sampling, exact identities and mpmath; both backends."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.compiled import extension
from touchcell.geometry import _plain_gaussian, gaussian, se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.gaussian import (
    NotConverged,
    NotPositiveDefinite,
    PoseGaussian,
    compound,
    fuse,
    mahalanobis_squared,
)
from touchcell.geometry.types import Array

SEEDS = st.integers(0, 10_000)


@pytest.fixture(params=["plain", "compiled"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    name: str = request.param
    kernels: Any = _plain_gaussian if name == "plain" else extension("touchcell.geometry._se3c")
    monkeypatch.setattr(gaussian, "_kernels", kernels)
    return name


def random_covariance(rng: np.random.Generator, sigma: float) -> Array:
    A = rng.normal(size=(6, 6))
    return sigma**2 * (A @ A.T / 6.0 + 0.2 * np.eye(6))


def random_gaussian(rng: np.random.Generator, sigma: float, near: Array | None = None) -> PoseGaussian:
    if near is None:
        return PoseGaussian(se3.exp(rng.normal(size=6)), random_covariance(rng, sigma))
    return PoseGaussian(se3.compose(se3.exp(sigma * rng.normal(size=6)), near), random_covariance(rng, sigma))


def ill_conditioned(rng: np.random.Generator, condition: float) -> Array:
    Q, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    S = Q @ np.diag(1e-2 * np.geomspace(1.0, 1.0 / condition, 6)) @ Q.T
    return 0.5 * (S + S.T)


def relative(found: Array, expected: Array) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def sampled_covariance(poses: Array, mean: Array) -> Array:
    e = se3.log(se3.compose(poses, se3.inverse(mean)))
    return e.T @ e / len(e)


def perturbations(rng: np.random.Generator, S: Array, count: int) -> Array:
    return rng.normal(size=(count, 6)) @ np.linalg.cholesky(S).T


def test_from_exponential_matches_sampling(backend: str) -> None:
    rng = np.random.default_rng(0)
    xi = np.array([0.3, -0.2, 0.5, 0.7, -1.1, 0.4])
    S = random_covariance(rng, 0.01)
    g = gaussian.from_exponential(xi, S)
    samples = se3.exp(xi + perturbations(rng, S, 200_000))
    assert np.array_equal(g.mean, se3.exp(xi))
    assert relative(g.covariance, sampled_covariance(samples, g.mean)) < 1e-2
    # Without the Jacobian it would be far off, so the comparison is meaningful.
    assert relative(S, g.covariance) > 0.2


def test_inverse_matches_sampling(backend: str) -> None:
    rng = np.random.default_rng(1)
    g = random_gaussian(rng, 0.05)
    samples = se3.inverse(se3.compose(se3.exp(perturbations(rng, g.covariance, 200_000)), g.mean))
    found = gaussian.inverse(g)
    assert relative(found.covariance, sampled_covariance(samples, found.mean)) < 1e-2


@given(seed=SEEDS)
def test_inverse_keeps_every_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = random_gaussian(rng, 0.3)
    T = se3.compose(se3.exp(0.3 * rng.normal(size=6)), g.mean)
    assert np.isclose(mahalanobis_squared(gaussian.inverse(g), se3.inverse(T)), mahalanobis_squared(g, T), rtol=1e-9)
    assert np.allclose(gaussian.inverse(gaussian.inverse(g)).covariance, g.covariance, rtol=0.0, atol=1e-12)


@given(seed=SEEDS)
def test_compound_without_noise_keeps_every_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = random_gaussian(rng, 0.3)
    U = se3.exp(rng.normal(size=6))
    T = se3.compose(se3.exp(0.3 * rng.normal(size=6)), g.mean)
    moved = compound(U, g)
    assert np.isclose(mahalanobis_squared(moved, se3.compose(U, T)), mahalanobis_squared(g, T), rtol=1e-9)


def test_compound_adds_noise_on_the_left(backend: str) -> None:
    rng = np.random.default_rng(2)
    g = random_gaussian(rng, 0.1)
    U, Q = se3.exp(rng.normal(size=6)), random_covariance(rng, 0.1)
    Ad = se3.adjoint(U)
    moved = compound(U, g, Q)
    assert np.allclose(moved.covariance, Ad @ g.covariance @ Ad.T + Q, rtol=1e-12, atol=1e-15)
    assert np.allclose(moved.mean, U @ g.mean, atol=1e-15)


def test_fourth_order_follows_sampling_where_the_second_does_not(backend: str) -> None:
    rng = np.random.default_rng(3)
    g = PoseGaussian(se3.exp(rng.normal(size=6)), 0.5**2 * np.eye(6))
    Q = 0.5**2 * np.eye(6)
    U = se3.exp([0.2, -0.1, 0.3, 0.4, -0.3, 0.2])
    moved = se3.compose(U, se3.compose(se3.exp(perturbations(rng, g.covariance, 400_000)), g.mean))
    samples = se3.compose(se3.exp(perturbations(rng, Q, 400_000)), moved)
    truth = sampled_covariance(samples, U @ g.mean)
    assert relative(compound(U, g, Q, order=4).covariance, truth) < 1.5e-2
    assert relative(compound(U, g, Q, order=2).covariance, truth) > 3e-2


def test_fourth_order_agrees_with_pytransform3d() -> None:
    uncertainty = pytest.importorskip("pytransform3d.uncertainty")
    rng = np.random.default_rng(4)
    g = random_gaussian(rng, 0.3)
    U, Q = se3.exp(rng.normal(size=6)), random_covariance(rng, 0.3)
    swap = np.r_[3:6, 0:3]

    def swapped(S: Array) -> Array:
        return S[np.ix_(swap, swap)]

    _, expected = uncertainty.concat_globally_uncertain_transforms(g.mean, swapped(g.covariance), U, swapped(Q))
    assert np.allclose(swapped(compound(U, g, Q, order=4).covariance), expected, rtol=1e-9, atol=1e-12)


def test_noise_may_leave_axes_out(backend: str) -> None:
    g = PoseGaussian(np.eye(4), np.eye(6))
    Q = np.diag([1.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    assert np.allclose(compound(np.eye(4), g, Q).covariance, np.eye(6) + Q, atol=1e-15)
    assert np.allclose(compound(np.eye(4), g, np.zeros((6, 6))).covariance, np.eye(6), atol=1e-15)
    rank_one = np.outer([1, 2, 3, 0, 1, 2], [1, 2, 3, 0, 1, 2]).astype(float)
    assert np.allclose(compound(np.eye(4), g, rank_one).covariance, np.eye(6) + rank_one, atol=1e-15)


@pytest.mark.parametrize(
    "noise",
    [
        -np.eye(6),
        np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3]),
        np.eye(6) + 1.5 * np.eye(6)[::-1],
        np.diag([0.0] * 6) + 0.1 * np.eye(6)[::-1],
        np.full((6, 6), np.nan),
        np.triu(np.ones((6, 6))),
    ],
)
def test_compound_refuses_noise_that_is_not_a_covariance(backend: str, noise: Array) -> None:
    with pytest.raises(NotPositiveDefinite) as caught:
        compound(np.eye(4), PoseGaussian(np.eye(4), 10.0 * np.eye(6)), noise)
    assert (caught.value.function, caught.value.argument) == ("compound", "noise")


def test_compound_refuses_other_invalid_arguments(backend: str) -> None:
    g = PoseGaussian(np.eye(4), np.eye(6))
    for arguments, argument in (
        ((np.full((4, 4), np.nan), g), "T"),
        ((np.stack([np.eye(4)] * 2), g), "T"),
        ((np.eye(4), g, np.eye(3)), "noise"),
        ((np.eye(4), g, np.eye(6), 3), "order"),
    ):
        with pytest.raises(GeometryError) as caught:
            compound(*arguments)
        assert (caught.value.function, caught.value.argument) == ("compound", argument)


def test_fusing_equal_means_adds_information(backend: str) -> None:
    rng = np.random.default_rng(5)
    g1 = random_gaussian(rng, 0.1)
    g2 = PoseGaussian(g1.mean, random_covariance(rng, 0.2))
    fused, record = fuse(g1, g2)
    assert record.iterations == 0
    assert record.nis < 1e-20
    expected = np.linalg.inv(np.linalg.inv(g1.covariance) + np.linalg.inv(g2.covariance))
    assert np.allclose(fused.covariance, expected, rtol=1e-10, atol=1e-15)


def test_fusion_matches_importance_sampling(backend: str) -> None:
    # Noise of the estimate: 3e-3 standard deviations; leaving J^-1 out would miss by 5e-2.
    rng = np.random.default_rng(6)
    g1 = random_gaussian(rng, 0.04)
    g2 = random_gaussian(rng, 0.04, near=g1.mean)
    fused, _ = fuse(g1, g2)
    wide = 2.0 * fused.covariance
    e = perturbations(rng, wide, 400_000)
    poses = se3.compose(se3.exp(e), fused.mean)

    def half_square(samples: Array, S: Array) -> Array:
        return 0.5 * np.sum(np.linalg.solve(np.linalg.cholesky(S), samples.T) ** 2, axis=0)

    exponent = half_square(e, wide)
    for g in (g1, g2):
        exponent -= half_square(se3.log(se3.compose(poses, se3.inverse(g.mean))), g.covariance)
    weight = np.exp(exponent - exponent.max())
    weight /= weight.sum()
    mean = weight @ e
    whitened = np.linalg.solve(np.linalg.cholesky(fused.covariance), mean)
    assert np.linalg.norm(whitened) < 1.5e-2
    assert relative(fused.covariance, (e - mean).T @ ((e - mean) * weight[:, None])) < 1.5e-2


@given(seed=SEEDS, sigma=st.sampled_from([0.01, 0.1, 0.3]))
def test_fusion_is_symmetric_and_tightens(seed: int, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    g1 = random_gaussian(rng, sigma)
    g2 = random_gaussian(rng, sigma, near=g1.mean)
    one, _ = fuse(g1, g2, tolerance=1e-9)
    other, _ = fuse(g2, g1, tolerance=1e-9)
    assert mahalanobis_squared(one, other.mean) < 1e-14
    assert np.allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-7 * sigma**2)
    assert np.array_equal(one.covariance, one.covariance.T)
    assert np.trace(np.linalg.solve(one.covariance, g1.covariance)) >= 6.0


@given(seed=SEEDS)
def test_fusion_ends_at_the_optimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g1 = random_gaussian(rng, 0.2)
    g2 = random_gaussian(rng, 0.2, near=g1.mean)
    fused, _ = fuse(g1, g2)

    def cost(T: Array) -> float:
        return mahalanobis_squared(g1, T) + mahalanobis_squared(g2, T)

    lowest = cost(fused.mean)
    for x in 1e-3 * perturbations(rng, fused.covariance, 10):
        assert cost(se3.compose(se3.exp(x), fused.mean)) > lowest


def test_backends_fuse_equally() -> None:
    compiled = extension("touchcell.geometry._se3c")
    rng = np.random.default_rng(7)
    for _ in range(50):
        g1 = random_gaussian(rng, 0.1)
        g2 = random_gaussian(rng, 0.1, near=g1.mean)
        arguments = (g1.mean, g1.covariance, g2.mean, g2.covariance, 1e-6, 50)
        T, S, iterations, nis = compiled.fuse(*arguments)
        T_plain, S_plain, iterations_plain, nis_plain = _plain_gaussian.fuse(*arguments)  # type: ignore[misc]
        assert iterations == iterations_plain
        assert np.isclose(nis, nis_plain, rtol=1e-10)
        assert np.allclose(T, T_plain, atol=1e-12)
        assert np.allclose(S, S_plain, rtol=1e-9, atol=1e-12)


def test_innovation_is_normalised(backend: str) -> None:
    rng = np.random.default_rng(8)
    g1 = random_gaussian(rng, 0.1)
    g2 = random_gaussian(rng, 0.1, near=g1.mean)
    e = se3.log(se3.compose(g1.mean, se3.inverse(g2.mean)))
    G = se3.left_jacobian_inverse(e)
    expected = e @ np.linalg.solve(G @ g1.covariance @ G.T + g2.covariance, e)
    assert np.isclose(fuse(g1, g2)[1].nis, expected, rtol=1e-10)


def test_innovations_of_consistent_pairs_are_chi_squared() -> None:
    rng = np.random.default_rng(9)
    S1, S2 = random_covariance(rng, 0.05), random_covariance(rng, 0.03)
    truth = se3.exp(rng.normal(size=6))
    found = []
    for e1, e2 in zip(perturbations(rng, S1, 2000), perturbations(rng, S2, 2000), strict=True):
        g1 = PoseGaussian(se3.compose(se3.exp(-e1), truth), S1)
        g2 = PoseGaussian(se3.compose(se3.exp(-e2), truth), S2)
        found.append(fuse(g1, g2)[1].nis)
    # Mean 6, variance 12: three standard errors.
    assert abs(np.mean(found) - 6.0) < 3.0 * np.sqrt(12.0 / 2000)
    assert abs(np.mean(np.array(found) > 12.59) - 0.05) < 0.015


def test_means_almost_half_a_turn_apart_meet_in_the_middle(backend: str) -> None:
    g1 = PoseGaussian(np.eye(4), 0.01 * np.eye(6))
    g2 = PoseGaussian(se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 3.1]), 0.01 * np.eye(6))
    fused, record = fuse(g1, g2)
    assert np.allclose(se3.log(fused.mean), [0.0, 0.0, 0.0, 0.0, 0.0, 1.55], atol=1e-6)
    assert record.iterations < 50


def test_far_apart_and_tilted_still_converges(backend: str) -> None:
    rng = np.random.default_rng(10)
    g1 = random_gaussian(rng, 0.3)
    g2 = PoseGaussian(se3.compose(se3.exp([0.5, 0.2, -0.4, 1.2, -1.4, 1.0]), g1.mean), random_covariance(rng, 0.3))
    one, _ = fuse(g1, g2)
    other, _ = fuse(g2, g1)
    assert mahalanobis_squared(one, other.mean) < 1e-8


def test_not_converged_raises(backend: str) -> None:
    g1 = PoseGaussian(np.eye(4), np.eye(6))
    g2 = PoseGaussian(se3.exp([1.0, 0.0, 0.0, 0.0, 0.5, 1.0]), np.eye(6))
    with pytest.raises(NotConverged) as caught:
        fuse(g1, g2, max_iterations=1)
    assert caught.value.iterations == 1
    for tolerance in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(GeometryError) as refused:
            fuse(g1, g2, tolerance=tolerance)
        assert refused.value.argument == "tolerance"


@pytest.mark.parametrize("condition", [1e8, 1e12, 1e14])
def test_ill_conditioned_covariances_against_mpmath(backend: str, condition: float) -> None:
    rng = np.random.default_rng(11)
    rounding = condition * float(np.finfo(float).eps)  # error of storing such a covariance
    for _ in range(5):
        S1, S2 = ill_conditioned(rng, condition), ill_conditioned(rng, condition)
        mean = se3.exp(rng.normal(size=6))
        offset = perturbations(rng, 0.5 * (S1 + S2), 1)[0]
        g1, g2 = PoseGaussian(mean, S1), PoseGaussian(se3.compose(se3.exp(offset), mean), S2)
        fused, _ = fuse(g1, g2)
        step, covariance_error = _exact_check(g1, g2, fused)
        assert step < 1e-6 + 0.1 * rounding
        assert covariance_error < rounding


def _exact_check(g1: PoseGaussian, g2: PoseGaussian, fused: PoseGaussian) -> tuple[float, float]:
    """Return the remaining Gauss-Newton step at the fused mean and the error of the covariance, both exact.

    The step is in standard deviations; the error is the largest entry after whitening by the exact covariance.
    """
    with mpmath.workdps(60):
        information, gradient = mpmath.zeros(6), mpmath.zeros(6, 1)
        for g in (g1, g2):
            e = se3.log(se3.compose(fused.mean, se3.inverse(g.mean)))
            G = mpmath.matrix(se3.left_jacobian_inverse(e).tolist())
            weight = G.T * mpmath.matrix(g.covariance.tolist()) ** -1
            information += weight * G
            gradient += weight * mpmath.matrix(e.tolist())
        root = mpmath.cholesky(information)
        step = mpmath.norm(mpmath.lu_solve(root, gradient))
        whitened = root.T * mpmath.matrix(fused.covariance.tolist()) * root
        return float(step), float(max(abs(entry) for entry in (whitened - mpmath.eye(6))))


def test_accepts_what_converts(backend: str) -> None:
    g = PoseGaussian(np.eye(4).tolist(), np.eye(6, dtype=np.float32))  # type: ignore[arg-type]
    assert g.mean.dtype == g.covariance.dtype == np.float64


def test_is_a_read_only_copy(backend: str) -> None:
    mean, covariance = np.eye(4), np.eye(6)
    g = PoseGaussian(mean, covariance)
    mean[0, 3] = covariance[0, 0] = 7.0
    assert g.mean[0, 3] == 0.0
    assert g.covariance[0, 0] == 1.0
    for array in (g.mean, g.covariance):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 2.0


def test_rounding_is_symmetrised(backend: str) -> None:
    S = np.eye(6)
    S[0, 3] = 1e-8
    assert PoseGaussian(np.eye(4), S).covariance[0, 3] == PoseGaussian(np.eye(4), S).covariance[3, 0] == 5e-9


def asymmetric(size: float) -> Array:
    S = np.eye(6)
    S[2, 4] = size
    return S


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((6, 6)),
        -np.eye(6),
        np.ones((6, 6)),
        np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]),
        np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-9]),
        np.diag([1.0, 1.0, 1.0, 1.0, 1.0, np.nan]),
        np.full((6, 6), np.nan),
        np.diag([np.inf] * 6),
        np.diag([1e200] * 6),
        np.diag([1e-200] * 6),
        asymmetric(1e-3),
        asymmetric(np.nan),
        asymmetric(np.inf),
        np.eye(6) + 1.01 * np.eye(6)[::-1],
    ],
    ids=repr,
)
def test_refuses_invalid_covariances(backend: str, bad: Array) -> None:
    with pytest.raises(NotPositiveDefinite) as caught:
        PoseGaussian(np.eye(4), bad)
    assert (caught.value.function, caught.value.argument) == ("PoseGaussian", "covariance")
    with pytest.raises(NotPositiveDefinite) as caught:
        gaussian.from_exponential(np.zeros(6), bad)
    assert (caught.value.function, caught.value.argument) == ("from_exponential", "covariance_xi")


def test_refuses_wrong_shapes_and_poses(backend: str) -> None:
    for arguments, argument in (
        ((np.eye(3), np.eye(6)), "mean"),
        ((np.stack([np.eye(4)]), np.eye(6)), "mean"),
        ((2.0 * np.eye(4), np.eye(6)), "mean"),
        ((np.eye(4), np.eye(5)), "covariance"),
        ((np.eye(4), np.stack([np.eye(6)])), "covariance"),
        ((np.eye(4), 1j * np.eye(6)), "covariance"),
    ):
        with pytest.raises(GeometryError) as caught:
            PoseGaussian(*arguments)
        assert (caught.value.function, caught.value.argument) == ("PoseGaussian", argument)
    for xi in (np.zeros(5), np.zeros((2, 6)), np.full(6, np.nan)):
        with pytest.raises(GeometryError):
            gaussian.from_exponential(xi, np.eye(6))
    with pytest.raises(GeometryError) as caught:
        mahalanobis_squared(PoseGaussian(np.eye(4), np.eye(6)), np.zeros((4, 4)))
    assert caught.value.function == "mahalanobis_squared"
