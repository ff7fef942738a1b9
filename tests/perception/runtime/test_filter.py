"""The SE(3) filter follows the equations, improves with every frame, and is consistent."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.motion import PoseHistory

STEP_NS = 33_000_000
CONTACT = se3.inverse(se3.from_euler_mm_deg([1.0, -0.5, 3.0, 5.0, -8.0, 2.0]))
OBSERVED = np.diag([0.3e-3, 0.3e-3, 0.1e-3, 0.01, 0.012, 0.02]) ** 2


def walk(n: int, seed: int) -> list[Array]:
    """Return sensor poses of a gentle random walk in the world."""
    rng = np.random.default_rng(seed)
    poses = [se3.from_euler_mm_deg([400.0, 10.0, 100.0, 180.0, 0.0, 30.0])]
    for _ in range(n - 1):
        step = rng.normal(0.0, [1e-3] * 3 + [0.02] * 3)
        poses.append(se3.compose(poses[-1], se3.exp(step)))
    return poses


def observations(poses: list[Array], seed: int) -> tuple[list[Array], list[PoseGaussian]]:
    """Return true contacts of a static surface, and noisy observations of them."""
    rng = np.random.default_rng(seed)
    T_world_f = se3.compose(poses[0], CONTACT)
    truth = [se3.compose(se3.inverse(T), T_world_f) for T in poses]
    root = np.linalg.cholesky(OBSERVED)
    noisy = [PoseGaussian(se3.compose(se3.exp(root @ rng.normal(size=6)), T), OBSERVED) for T in truth]
    return truth, noisy


def test_prediction_moves_the_belief_by_the_sensors_own_motion() -> None:
    poses = walk(2, 0)
    noise = isotropic_noise(2e-3, 0.05)
    pose_filter = PoseFilter(noise)
    pose_filter.update(PoseGaussian(CONTACT, OBSERVED), poses[0], 0)
    predicted = pose_filter.predict(poses[1], STEP_NS)
    U = se3.compose(se3.inverse(poses[1]), poses[0])
    np.testing.assert_allclose(predicted.mean, U @ CONTACT, atol=1e-12)
    Ad = se3.adjoint(U)
    np.testing.assert_allclose(
        predicted.covariance, Ad @ OBSERVED @ Ad.T + noise * STEP_NS * 1e-9, rtol=1e-9, atol=1e-18
    )


def test_the_covariance_of_a_static_contact_shrinks_with_every_frame() -> None:
    pose_filter = PoseFilter(np.zeros((6, 6)))
    T_base_sensor = np.eye(4)
    for i in range(9):
        state = pose_filter.update(PoseGaussian(CONTACT, OBSERVED), T_base_sensor, i * STEP_NS)
    np.testing.assert_allclose(state.belief.covariance, OBSERVED / 9, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(state.belief.mean, CONTACT, atol=1e-12)
    assert state.nis == pytest.approx(0.0, abs=1e-9)


def test_filtering_beats_single_frames_and_is_consistent() -> None:
    nees, filtered, single = [], [], []
    for seed in range(20):
        poses = walk(40, seed)
        truth, noisy = observations(poses, seed + 100)
        pose_filter = PoseFilter(np.zeros((6, 6)))
        for i, (T_base_sensor, true, observed) in enumerate(zip(poses, truth, noisy, strict=True)):
            belief = pose_filter.update(observed, T_base_sensor, i * STEP_NS).belief
            e = se3.log(true @ se3.inverse(belief.mean))
            filtered.append(np.abs(e))
            single.append(np.abs(se3.log(true @ se3.inverse(observed.mean))))
            nees.append(e @ np.linalg.solve(belief.covariance, e))
    assert (np.mean(filtered[30::40], axis=0) < 0.4 * np.mean(single, axis=0)).all()
    # Six degrees of freedom: the mean over 20 independent runs lies within 6 +- 1.6 with 95 % confidence.
    last = np.array(nees).reshape(20, 40)[:, -1]
    assert 4.0 < last.mean() < 8.0


def test_innovation_reveals_a_wrong_frame() -> None:
    pose_filter = PoseFilter(np.zeros((6, 6)))
    pose_filter.update(PoseGaussian(CONTACT, OBSERVED), np.eye(4), 0)
    far = se3.compose(se3.exp(np.array([5e-3, 0, 0, 0, 0, 0])), CONTACT)
    state = pose_filter.update(PoseGaussian(far, OBSERVED), np.eye(4), STEP_NS)
    assert state.nis is not None
    assert state.nis > 100


def test_reset_starts_a_new_contact() -> None:
    pose_filter = PoseFilter(np.zeros((6, 6)))
    pose_filter.update(PoseGaussian(CONTACT, OBSERVED), np.eye(4), 0)
    pose_filter.reset()
    assert pose_filter.state is None
    fresh = PoseGaussian(np.eye(4), OBSERVED)
    assert pose_filter.update(fresh, np.eye(4), STEP_NS).belief is fresh


def test_time_does_not_run_backwards() -> None:
    pose_filter = PoseFilter(isotropic_noise(1e-3, 0.01))
    with pytest.raises(ValueError, match="first observation"):
        pose_filter.predict(np.eye(4), 0)
    pose_filter.update(PoseGaussian(CONTACT, OBSERVED), np.eye(4), STEP_NS)
    with pytest.raises(ValueError, match="back"):
        pose_filter.predict(np.eye(4), 0)


def test_history_interpolates_on_the_geodesic() -> None:
    T0 = se3.from_euler_mm_deg([0, 0, 0, 10, 0, 0])
    twist = np.array([0.01, -0.02, 0.005, 0.3, 0.1, -0.2])
    history = PoseHistory()
    history.record(0, T0)
    history.record(100, se3.compose(T0, se3.exp(twist)))
    np.testing.assert_allclose(history.at(25), se3.compose(T0, se3.exp(0.25 * twist)), atol=1e-14)
    np.testing.assert_array_equal(history.at(-5), T0)
    np.testing.assert_allclose(history.at(500), se3.compose(T0, se3.exp(twist)), atol=1e-15)


def test_history_forgets_and_ignores_what_is_not_newer() -> None:
    history = PoseHistory(keep_s=1e-6)
    for t_ns in range(0, 10_000, 100):
        history.record(t_ns, se3.from_euler_mm_deg([float(t_ns), 0, 0, 0, 0, 0]))
    history.record(9_900, np.eye(4))
    assert history.at(9_900)[0, 3] == pytest.approx(9.9)
    assert len(history) <= 12


def test_empty_history_has_no_pose() -> None:
    with pytest.raises(LookupError):
        PoseHistory().at(0)
