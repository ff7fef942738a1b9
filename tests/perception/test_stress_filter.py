"""For any input the filter stays valid: no NaN, covariances positive definite, errors bounded, or a typed error."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest

from tests.helpers.compiled import extension
from tests.helpers.filter_stress import BLOCK, DRIFT_PER_STEP, SIGMA, STEP_NS, ExactFilter, LongRun, long_run
from touchcell.errors import TouchcellError
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
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter

Filter = PoseFilter | MovingSurfaceFilter
CONTACT = se3.inverse(se3.from_euler_mm_deg([1.0, -0.5, 3.0, 5.0, -8.0, 2.0]))
DRIFT = np.diag((DRIFT_PER_STEP * SIGMA) ** 2) / (STEP_NS * 1e-9)


def still() -> PoseFilter:
    return PoseFilter(DRIFT)


def moving() -> MovingSurfaceFilter:
    return MovingSurfaceFilter(DRIFT, isotropic_noise(1e-3, 0.03), isotropic_noise(1e-3, 0.03))


FILTERS = pytest.mark.parametrize("make", [still, moving])


@pytest.fixture(params=["plain", "compiled"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    name: str = request.param
    kernels: Any = _plain_gaussian if name == "plain" else extension("touchcell.geometry._se3c")
    monkeypatch.setattr(gaussian, "_kernels", kernels)
    return name


def require_sound(g: PoseGaussian) -> None:
    assert np.isfinite(g.mean).all()
    np.testing.assert_array_equal(g.covariance, g.covariance.T)
    np.linalg.cholesky(g.covariance)


def spread(rng: np.random.Generator, sigma: float) -> Array:
    """A random covariance with standard deviations of about ``sigma``."""
    A = rng.normal(size=(6, 6))
    return np.asarray(sigma**2 * (A @ A.T / 6.0 + 0.3 * np.eye(6)))


def require_bounded(run: LongRun, steps: int) -> None:
    assert run.steps == steps
    assert run.orthogonality < 1e-9
    assert np.isfinite(run.covariance).all()
    np.linalg.cholesky(run.covariance)
    # 6 for a perfect filter; the surface's walk is pulled back once per block, which neither model includes.
    assert 4.0 < run.nees < 7.0
    assert run.worst_nees < 80.0


@FILTERS
def test_ten_thousand_steps(make: Callable[[], Filter]) -> None:
    require_bounded(long_run(make(), BLOCK, seed=1), BLOCK)


@pytest.mark.stress
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(("make", "share"), [(still, 1), (moving, 10)])
def test_many_steps_of_make_stress(make: Callable[[], Filter], share: int, capsys: pytest.CaptureFixture[str]) -> None:
    """STRESS_STEPS, ten million by default, and a tenth of that for the slower filter."""
    steps = max(BLOCK, int(os.environ.get("STRESS_STEPS", "10_000_000")) // share)
    twentieth = max(1, steps // BLOCK // 20)

    def show(done: int) -> None:
        if done // BLOCK % twentieth == 0 or done == steps:
            with capsys.disabled():
                print(f"  {done:>10,} of {steps:,} filter steps, {make.__name__} surface", flush=True)

    require_bounded(long_run(make(), steps, seed=2, progress=show), steps)


SIGMAS = [float(s) for s in np.geomspace(1e-12, 1e6, 10)]


@pytest.mark.parametrize(("prior_sigma", "observed_sigma"), list(itertools.product(SIGMAS, SIGMAS)))
def test_sigmas_of_eighteen_orders(backend: str, prior_sigma: float, observed_sigma: float) -> None:
    rng = np.random.default_rng(7)
    offset = min(prior_sigma, observed_sigma, 0.3) * rng.normal(size=6)
    prior = PoseGaussian(CONTACT, spread(rng, prior_sigma))
    observation = PoseGaussian(se3.compose(se3.exp(offset), CONTACT), spread(rng, observed_sigma))
    moved = compound(se3.exp(np.full(6, 0.1)), prior, spread(rng, prior_sigma))
    require_sound(moved)
    fused, record = fuse(prior, observation)
    require_sound(fused)
    assert 0.0 <= record.nis < 100.0
    for given in (prior, observation):
        # Narrower than either, and within reach of both.
        excess = np.linalg.eigvals(np.linalg.solve(given.covariance, fused.covariance))
        assert excess.real.max() < 1.0 + 1e-3
        assert mahalanobis_squared(given, fused.mean) < 100.0


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("kind", ["still", "moving"])
def test_filters_of_eighteen_orders(kind: str, sigma: float) -> None:
    """Noise and motion of one size: consistent where a standard deviation is small, valid where it exceeds a turn."""
    drift = isotropic_noise(sigma, sigma)
    pose_filter: Filter = PoseFilter(drift) if kind == "still" else MovingSurfaceFilter(drift, drift, drift)
    rng = np.random.default_rng(13)
    S, nees = np.eye(6) * sigma**2, []
    reach = min(sigma, 1e-3)
    for k in range(200):
        T_base_s = se3.exp(rng.normal(0.0, [0.01] * 3 + [0.2] * 3))
        truth = se3.inverse(T_base_s)
        observed = PoseGaussian(se3.compose(se3.exp(reach * rng.normal(size=6)), truth), S)
        state = pose_filter.update(observed, T_base_s, k * STEP_NS)
        require_sound(state.belief)
        assert state.nis is None or 0.0 <= state.nis < 60.0
        nees.append(mahalanobis_squared(state.belief, truth))
    assert max(nees) < 60.0
    if sigma <= 1e-3:
        assert 0.5 < np.mean(nees[20:]) < 10.0


def test_axes_of_any_two_precisions_side_by_side(backend: str) -> None:
    """Standard deviations from 1e-12 to 1e6 in one covariance: valid, or refused as not positive definite."""
    rng, sound = np.random.default_rng(8), 0
    for _ in range(300):
        variances = 10.0 ** rng.uniform(-24.0, 12.0, (2, 6))
        try:
            prior, observation = (PoseGaussian(CONTACT, np.diag(v)) for v in variances)
            fused, record = fuse(compound(se3.exp(np.array([0, 0, 1e-3, 0, 0, 0.1])), prior), observation)
        except (NotPositiveDefinite, NotConverged):
            continue
        assert np.isfinite(fused.mean).all()
        assert np.isfinite(record.nis)
        assert np.isfinite(mahalanobis_squared(fused, observation.mean))
        sigma = np.sqrt(np.diagonal(fused.covariance))
        # In units of the standard deviations, rounding alone may reach below zero.
        assert np.linalg.eigvalsh(fused.covariance / np.outer(sigma, sigma)).min() > -1e-14
        sound += 1
    assert sound > 0


@pytest.mark.parametrize("condition", [1e8, 1e12, 1e14])
@FILTERS
def test_condition_of_1e14(backend: str, make: Callable[[], Filter], condition: float) -> None:
    """A filter with such covariances from a turning sensor continues, or raises a typed error."""
    rng = np.random.default_rng(9)
    pose_filter, refused = make(), 0
    for k in range(60):
        axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
        S = axes @ np.diag(1e-4 * np.geomspace(1.0, 1.0 / condition, 6)) @ axes.T
        S = 0.5 * (S + S.T)
        e = axes @ (np.sqrt(1e-4 * np.geomspace(1.0, 1.0 / condition, 6)) * rng.normal(size=6))
        T_base_s = se3.exp(rng.normal(0.0, [0.01] * 3 + [0.2] * 3))
        truth = se3.compose(se3.inverse(T_base_s), CONTACT)
        try:
            state = pose_filter.update(PoseGaussian(se3.compose(se3.exp(e), truth), S), T_base_s, k * STEP_NS)
        except (NotPositiveDefinite, NotConverged):
            refused += 1
            continue
        require_sound(state.belief)
        assert np.abs(se3.log(se3.compose(truth, se3.inverse(state.belief.mean)))).max() < 0.1
    assert refused < 6


ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, np.pi / 2, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi]


@pytest.mark.parametrize("angle", ANGLES)
@FILTERS
def test_rotations_at_0_and_pi_change_nothing(make: Callable[[], Filter], angle: float) -> None:
    """Left perturbations are independent of a fixed rotation of the surface frame: every angle gives equal results."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    turn = se3.exp(np.concatenate([[0.01, 0.02, -0.03], angle * axis]))
    plain, turned = make(), make()
    rng = np.random.default_rng(10)
    for k in range(30):
        T_base_s = se3.exp(rng.normal(0.0, [0.01] * 3 + [0.3] * 3))
        observed = se3.compose(se3.inverse(T_base_s), se3.exp(SIGMA * rng.normal(size=6)))
        S = spread(rng, 0.01)
        a = plain.update(PoseGaussian(observed, S), T_base_s, k * STEP_NS).belief
        b = turned.update(PoseGaussian(se3.compose(observed, turn), S), T_base_s, k * STEP_NS).belief
        np.testing.assert_allclose(b.mean, se3.compose(a.mean, turn), atol=1e-12)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-9, atol=1e-18)
        sigma = np.full(6, 1e-3)
        require_sound(gaussian.from_exponential(se3.log(se3.compose(observed, turn)), np.diag(sigma**2)))


@pytest.mark.parametrize("axis", range(3))
def test_a_frame_half_a_turn_off_is_fused_or_refused(backend: str, axis: int) -> None:
    w = np.zeros(6)
    for angle in (np.pi - 1e-9, np.pi):
        w[3 + axis] = angle
        prior = PoseGaussian(CONTACT, np.diag(SIGMA**2))
        try:
            fused, record = fuse(prior, PoseGaussian(se3.compose(se3.exp(w), CONTACT), np.diag(SIGMA**2)))
        except NotConverged:
            continue
        require_sound(fused)
        assert record.nis > 1e3


def test_float64_and_float32_against_mpmath() -> None:
    """Six updates: doubles agree with forty digits, and poses rounded to float32 cost as much as their rounding."""
    rng = np.random.default_rng(12)
    double, single, exact = still(), still(), ExactFilter(DRIFT)
    for k in range(6):
        T_base_s = se3.exp(rng.normal(0.0, [0.01] * 3 + [0.2] * 3))
        observed = se3.compose(se3.exp(SIGMA * rng.normal(size=6)), se3.inverse(T_base_s))
        S = np.diag(SIGMA) @ spread(rng, 1.0) @ np.diag(SIGMA)
        S = 0.5 * (S + S.T)
        belief = double.update(PoseGaussian(observed, S), T_base_s, k * STEP_NS).belief
        rounded = single.update(
            PoseGaussian(observed.astype(np.float32), S.astype(np.float32)),
            T_base_s.astype(np.float32),
            k * STEP_NS,
        ).belief
        with mpmath.workdps(40):
            exact.update(observed, S, T_base_s, k * STEP_NS)
            mean_error, covariance_error = exact.distances(belief)
            rounded_mean_error, rounded_covariance_error = exact.distances(rounded)
        # The iteration stops at 1e-6 standard deviations.
        assert mean_error < 2e-6
        assert covariance_error < 2e-6
        assert rounded_mean_error < 5e-3
        assert rounded_covariance_error < 5e-4


BAD = [np.nan, np.inf, -np.inf, 1e300]


@pytest.mark.parametrize("bad", BAD)
@FILTERS
def test_non_finite_input_is_refused(make: Callable[[], Filter], bad: float) -> None:
    """Every entry of every argument in turn: a typed error, and the state is unchanged."""
    S = np.diag(SIGMA**2)
    fresh, used = make(), make()
    used.update(PoseGaussian(CONTACT, S), np.eye(4), 0)
    before = used.state
    for i in range(16):
        pose = np.array(CONTACT)
        pose.flat[i] = bad
        with pytest.raises(GeometryError):
            PoseGaussian(pose, S)
        for pose_filter in (fresh, used):
            with pytest.raises(GeometryError):
                pose_filter.update(PoseGaussian(CONTACT, S), pose, STEP_NS)
        with pytest.raises(GeometryError):
            used.predict(pose, STEP_NS)
    for i in range(36):
        covariance = np.array(S)
        covariance.flat[i] = bad
        with pytest.raises(NotPositiveDefinite):
            PoseGaussian(CONTACT, covariance)
        with pytest.raises(NotPositiveDefinite):
            gaussian.from_exponential(np.zeros(6), covariance)
        with pytest.raises(NotPositiveDefinite):
            PoseFilter(covariance)
    for i in range(6):
        xi = np.zeros(6)
        xi[i] = bad
        with pytest.raises(GeometryError):
            gaussian.from_exponential(xi, S)
    assert fresh.state is None
    assert used.state is before


@FILTERS
def test_a_refused_frame_leaves_the_filter_unchanged(make: Callable[[], Filter]) -> None:
    pose_filter = make()
    S = np.diag(SIGMA**2)
    pose_filter.update(PoseGaussian(CONTACT, S), np.eye(4), STEP_NS)
    before = pose_filter.state
    with pytest.raises((TouchcellError, ValueError)):
        pose_filter.update(PoseGaussian(CONTACT, S), np.eye(4), 0)
    assert pose_filter.state is before


@FILTERS
def test_years_without_a_frame(make: Callable[[], Filter]) -> None:
    """Certainty is lost, and the result is a covariance or a typed error, never a non-finite number."""
    pose_filter = make()
    S = np.diag(SIGMA**2)
    pose_filter.update(PoseGaussian(CONTACT, S), np.eye(4), 0)
    for t_s in (1e-9, 1.0, 1e3, 1e6, 1e9):
        try:
            predicted = pose_filter.predict(np.eye(4), round(t_s * 1e9))
        except NotPositiveDefinite:
            continue
        require_sound(predicted)
        assert (np.diagonal(predicted.covariance) >= SIGMA**2 * (1 - 1e-9)).all()
