"""The moving-surface filter follows a moving surface without lag, is as good on a static one, and is consistent."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.gaussian import NotPositiveDefinite, PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter
from touchcell.perception.runtime.network_estimator import NetworkEstimator

STEP_NS = 33_000_000
CONTACT = se3.inverse(se3.from_euler_mm_deg([1.0, -0.5, 3.0, 5.0, -8.0, 2.0]))
OBSERVED = np.diag([0.3e-3, 0.3e-3, 0.1e-3, 0.01, 0.012, 0.02]) ** 2
TWIST_BASE = np.array([0.02, -0.01, 0.005, 0.05, -0.08, 0.1])
DRIFT = isotropic_noise(1e-3, 0.01)
ACCELERATION = isotropic_noise(5e-3, 0.02)
SPEED = isotropic_noise(0.03, 0.15)


def sensor_poses(n: int, seed: int) -> list[Array]:
    """Return poses of a sensor that wanders through the base frame, 0.4 m from its origin."""
    rng = np.random.default_rng(seed)
    poses = [se3.from_euler_mm_deg([400.0, 10.0, 100.0, 180.0, 0.0, 30.0])]
    for _ in range(n - 1):
        poses.append(se3.compose(poses[-1], se3.exp(rng.normal(0.0, [1e-3] * 3 + [0.02] * 3))))
    return poses


def contacts(poses: list[Array], twist_base: Array) -> list[Array]:
    """Return the true T_s_f of a surface that moves at a constant twist of the base frame."""
    T_base_f = se3.compose(poses[0], CONTACT)
    steps = [se3.exp(twist_base * (k * STEP_NS * 1e-9)) for k in range(len(poses))]
    return [se3.compose(se3.inverse(T), se3.compose(step, T_base_f)) for T, step in zip(poses, steps, strict=True)]


def moving_filter() -> MovingSurfaceFilter:
    return MovingSurfaceFilter(DRIFT, ACCELERATION, SPEED)


def error(true: Array, mean: Array) -> Array:
    return se3.log(se3.compose(true, se3.inverse(mean)))


def follow(pose_filter: PoseFilter | MovingSurfaceFilter, poses: list[Array], truth: list[Array]) -> Array:
    """Return (n, 6) errors of the filter on observations without error."""
    errors = []
    for k, (pose, true) in enumerate(zip(poses, truth, strict=True)):
        state = pose_filter.update(PoseGaussian(true, OBSERVED), pose, k * STEP_NS)
        errors.append(error(true, state.belief.mean))
    return np.array(errors)


def test_lag_behind_a_steadily_moving_surface_vanishes() -> None:
    poses = sensor_poses(150, 0)
    truth = contacts(poses, TWIST_BASE)
    lag_still = np.abs(follow(PoseFilter(DRIFT), poses, truth)[-1])
    moving = moving_filter()
    lag_moving = np.abs(follow(moving, poses, truth)[-1])
    assert np.linalg.norm(lag_still[:3]) > 4e-4
    assert np.linalg.norm(lag_moving[:3]) < 1e-6
    assert np.linalg.norm(lag_moving[3:]) < 1e-4 * np.linalg.norm(lag_still[3:])
    assert moving.motion is not None
    expected = se3.adjoint(se3.inverse(poses[-1])) @ TWIST_BASE
    np.testing.assert_allclose(moving.motion.twist, expected, atol=2e-5)


def test_prediction_carries_the_surface_on() -> None:
    poses = sensor_poses(160, 1)
    truth = contacts(poses, TWIST_BASE)
    moving = moving_filter()
    follow(moving, poses[:150], truth[:150])
    before = moving.state
    predicted = moving.predict(poses[-1], 159 * STEP_NS)
    assert moving.state is before
    assert np.abs(error(truth[-1], predicted.mean)).max() < 5e-5
    moved_m = TWIST_BASE[:3] * 10 * STEP_NS * 1e-9
    assert np.linalg.norm(moved_m) > 5e-3


def test_prediction_of_the_covariance_is_the_derivative_of_the_motion() -> None:
    quiet = np.diag([1e-30] * 6)
    moving = MovingSurfaceFilter(np.zeros((6, 6)), quiet, SPEED)
    poses = sensor_poses(3, 2)
    follow(moving, poses[:2], contacts(poses[:2], TWIST_BASE))
    state, motion = moving.state, moving.motion
    assert state is not None
    assert motion is not None
    dt = 1.5
    predicted = moving.predict(poses[2], state.t_ns + round(dt * 1e9))
    U = se3.inverse(poses[2]) @ state.T_base_sensor
    F = np.empty((6, 12))
    for i in range(12):
        ends = []
        for step in (1e-6, -1e-6):
            d = np.zeros(12)
            d[i] = step
            T = U @ se3.exp((motion.twist + d[6:]) * dt) @ se3.exp(d[:6]) @ state.belief.mean
            ends.append(error(T, predicted.mean))
        F[:, i] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(predicted.covariance, F @ motion.covariance @ F.T, rtol=1e-6, atol=1e-12)


def observe(true: Array, root: Array, rng: np.random.Generator) -> PoseGaussian:
    return PoseGaussian(se3.compose(se3.exp(root @ rng.normal(size=6)), true), OBSERVED)


def test_without_twist_noise_it_equals_the_static_filter() -> None:
    root, quiet = np.linalg.cholesky(OBSERVED), isotropic_noise(1e-9, 1e-9)
    rng = np.random.default_rng(5)
    poses = sensor_poses(60, 5)
    still, moving = PoseFilter(DRIFT), MovingSurfaceFilter(DRIFT, quiet, quiet)
    for k, true in enumerate(contacts(poses, np.zeros(6))):
        observation = observe(true, root, rng)
        expected = still.update(observation, poses[k], k * STEP_NS)
        got = moving.update(observation, poses[k], k * STEP_NS)
        np.testing.assert_allclose(got.belief.mean, expected.belief.mean, atol=1e-9)
        np.testing.assert_allclose(got.belief.covariance, expected.belief.covariance, rtol=1e-6, atol=1e-14)


def test_a_still_surface_costs_little_once_the_twist_is_known_to_be_small() -> None:
    root, errors = np.linalg.cholesky(OBSERVED), {"still": [], "moving": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses = sensor_poses(90, seed)
        filters = {
            "still": PoseFilter(DRIFT),
            "moving": MovingSurfaceFilter(DRIFT, isotropic_noise(1e-4, 2e-4), isotropic_noise(1e-3, 2e-3)),
        }
        for k, true in enumerate(contacts(poses, np.zeros(6))):
            observation = observe(true, root, rng)
            for name, pose_filter in filters.items():
                belief = pose_filter.update(observation, poses[k], k * STEP_NS).belief
                if k >= 30:
                    errors[name].append(error(true, belief.mean))
    rms = {name: np.sqrt(np.mean(np.square(rows), axis=0)) for name, rows in errors.items()}
    assert (rms["moving"] < 1.03 * rms["still"]).all()


def test_it_is_consistent() -> None:
    """Truth drawn from the model itself: NEES of pose and twist, and NIS, match their degrees of freedom."""
    runs, n, dt = 40, 60, STEP_NS * 1e-9
    root = np.linalg.cholesky(OBSERVED)
    nees, nis = [], []
    for seed in range(runs):
        rng = np.random.default_rng(1000 + seed)
        poses = sensor_poses(n, seed)
        T, twist = CONTACT, np.linalg.cholesky(SPEED) @ rng.normal(size=6)
        moving = moving_filter()
        moving.update(observe(T, root, rng), poses[0], 0)
        W = np.block(
            [
                [DRIFT * dt + ACCELERATION * dt**3 / 3, ACCELERATION * dt**2 / 2],
                [ACCELERATION * dt**2 / 2, ACCELERATION * dt],
            ]
        )
        noise_root = np.linalg.cholesky(W)
        for k in range(1, n):
            U = se3.inverse(poses[k]) @ poses[k - 1]
            noise = noise_root @ rng.normal(size=12)
            T = se3.project(se3.exp(noise[:6]) @ U @ se3.exp(twist * dt) @ T)
            twist = se3.adjoint(U) @ twist + noise[6:]
            state = moving.update(observe(T, root, rng), poses[k], k * STEP_NS)
            nis.append(state.nis)
        assert moving.motion is not None
        assert state.belief is not None
        both = np.concatenate([error(T, state.belief.mean), twist - moving.motion.twist])
        nees.append(both @ np.linalg.solve(moving.motion.covariance, both))
    # The mean of 40 chi-squared variables of 12 degrees of freedom has a standard deviation of 0.77.
    assert abs(np.mean(nees) - 12.0) < 2.5
    assert abs(np.mean(nis) - 6.0) < 0.25


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_the_choice_of_the_base_frame_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_other_base = se3.exp(rng.normal(0.0, [1.0] * 3 + [2.0] * 3))
    poses = sensor_poses(8, seed)
    root, here, there = np.linalg.cholesky(OBSERVED), moving_filter(), moving_filter()
    for k, true in enumerate(contacts(poses, TWIST_BASE)):
        observation = observe(true, root, rng)
        a = here.update(observation, poses[k], k * STEP_NS).belief
        b = there.update(observation, se3.compose(T_other_base, poses[k]), k * STEP_NS).belief
        np.testing.assert_allclose(b.mean, a.mean, atol=1e-9)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-6, atol=1e-15)


def test_covariance_stays_positive_definite_and_the_two_halves_agree() -> None:
    poses = sensor_poses(400, 3)
    moving = moving_filter()
    follow(moving, poses, contacts(poses, TWIST_BASE))
    assert moving.state is not None
    assert moving.motion is not None
    P = moving.motion.covariance
    np.linalg.cholesky(P)
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(P[:6, :6], moving.state.belief.covariance)


def test_reset_forgets_the_motion_too() -> None:
    poses = sensor_poses(20, 0)
    moving = moving_filter()
    follow(moving, poses, contacts(poses, TWIST_BASE))
    moving.reset()
    assert moving.state is None
    assert moving.motion is None
    with pytest.raises(ValueError, match="first observation"):
        moving.predict(poses[0], 0)


def test_invalid_poses_and_covariances_are_refused_at_once() -> None:
    for i in range(3):
        arguments = [DRIFT, ACCELERATION, SPEED]
        arguments[i] = np.full((6, 6), np.nan)
        with pytest.raises(NotPositiveDefinite):
            MovingSurfaceFilter(*arguments)
    moving = moving_filter()
    with pytest.raises(GeometryError):
        moving.update(PoseGaussian(CONTACT, OBSERVED), np.full((4, 4), np.nan), 0)
    assert moving.state is None
    assert moving.motion is None
    moving.update(PoseGaussian(CONTACT, OBSERVED), np.eye(4), STEP_NS)
    with pytest.raises(ValueError, match="back"):
        moving.predict(np.eye(4), 0)


def test_a_cell_file_chooses_the_model() -> None:
    drift = {"drift_mm_per_sqrt_s": 2, "drift_deg_per_sqrt_s": 3}
    motion = {"speed_mm_s": 30, "speed_deg_s": 9, "accel_mm_s_per_sqrt_s": 10, "accel_deg_s_per_sqrt_s": 4}
    for section, kind in (
        (drift, PoseFilter),
        ({"model": "still_surface", **drift}, PoseFilter),
        ({"model": "moving_surface", **drift, **motion}, MovingSurfaceFilter),
    ):
        estimator = NetworkEstimator.model_validate({"kind": "network", "model": "m", "filter": section})
        assert estimator.filter is not None
        assert type(estimator.filter.build()) is kind
