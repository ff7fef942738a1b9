import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.stick_slip import StickSlipFilter

SIGMA = np.array([1e-4, 1e-4, 1e-4, 4e-3, 4e-3, 4e-3])
NOISE = isotropic_noise(5e-4, np.deg2rad(2.0))
PERIOD_NS = 33_000_000


def seen(contact_mm_deg: list[float], rng: np.random.Generator, bias: np.ndarray) -> PoseGaussian:
    T_s_f = se3.inverse(se3.from_euler_mm_deg(np.array(contact_mm_deg)))
    return PoseGaussian(se3.exp(bias + SIGMA * rng.standard_normal(6)) @ T_s_f, np.diag(SIGMA**2))


def errors(stick: bool, carried: bool, make, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """RMS errors (6,) of frames and of the filter, of a sensor that moves by 0.7 mm a frame along x and then z."""
    rng, contact_filter = np.random.default_rng(seed), make()
    T_base_s, x_mm, z_mm = np.eye(4), 0.0, 3.0
    frames, filtered = [], []
    for k in range(200):
        step = np.array([0.7e-3 if k % 40 < 20 else -0.7e-3, 0.0, 0.0])
        if carried:
            step = np.array([0.0, 0.0, 0.7e-3])
        T_base_s = T_base_s.copy()
        T_base_s[:3, 3] += step
        if not carried:
            x_mm = x_mm + 1e3 * step[0]
            x_mm = x_mm if stick else float(np.clip(x_mm, -2.0, 2.0))
        observation = seen([x_mm, 0.0, z_mm, 0.0, 0.0, 0.0], rng, np.zeros(6))
        true = se3.inverse(se3.from_euler_mm_deg(np.array([x_mm, 0.0, z_mm, 0.0, 0.0, 0.0])))
        belief = contact_filter.update(observation, T_base_s, k * PERIOD_NS).belief
        if k > 20:
            frames.append(se3.log(observation.mean @ se3.inverse(true)))
            filtered.append(se3.log(belief.mean @ se3.inverse(true)))
    return np.sqrt(np.mean(np.square(frames), axis=0)), np.sqrt(np.mean(np.square(filtered), axis=0))


@pytest.mark.parametrize(("stick", "carried"), [(True, False), (False, False), (False, True)])
def test_it_is_at_least_as_good_as_one_frame_stuck_sliding_and_carried_along(stick: bool, carried: bool) -> None:
    frame, filtered = errors(stick, carried, lambda: StickSlipFilter(NOISE, 0.5))
    assert (filtered <= 1.02 * frame).all()


def test_a_filter_that_holds_the_surface_still_is_worse_than_one_frame_where_it_is_carried_along() -> None:
    frame, still = errors(False, True, lambda: PoseFilter(NOISE))
    assert still[2] > 1.2 * frame[2]


def test_a_contact_that_sticks_is_averaged() -> None:
    frame, filtered = errors(True, False, lambda: StickSlipFilter(NOISE, 0.0))
    assert (filtered[[0, 1, 2]] < 0.9 * frame[[0, 1, 2]]).all()


def test_shares_tell_sliding_from_sticking() -> None:
    for stick in (True, False):
        contact_filter = StickSlipFilter(NOISE, 0.5)
        rng, T_base_s = np.random.default_rng(1), np.eye(4)
        for k in range(30):
            T_base_s = T_base_s.copy()
            T_base_s[0, 3] += 0.7e-3
            x_mm = 0.7 * (k + 1) if stick else 2.0
            contact_filter.update(seen([x_mm, 0, 3, 0, 0, 0], rng, np.zeros(6)), T_base_s, k * PERIOD_NS)
        assert contact_filter.shares[0] == pytest.approx(float(stick), abs=0.2)


def test_what_frames_have_in_common_is_not_averaged_out() -> None:
    rng, contact_filter = np.random.default_rng(2), StickSlipFilter(NOISE, 0.5)
    for k in range(100):
        state = contact_filter.update(seen([0, 0, 3, 0, 0, 0], rng, np.zeros(6)), np.eye(4), k * PERIOD_NS)
    assert (np.diag(state.belief.covariance) >= 0.5 * SIGMA**2).all()


def test_it_predicts_neither_before_a_frame_nor_backwards() -> None:
    contact_filter = StickSlipFilter(NOISE, 0.5)
    with pytest.raises(ValueError, match="before the first"):
        contact_filter.predict(np.eye(4), 0)
    contact_filter.update(seen([0, 0, 3, 0, 0, 0], np.random.default_rng(0), np.zeros(6)), np.eye(4), 10)
    with pytest.raises(ValueError, match="back"):
        contact_filter.predict(np.eye(4), 5)
