"""The filter that knows slip: shear and torsion of contacts whose skin has slid, from frames that cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.geometry import gaussian, se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.models.labels import xi_gaussian
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.filter_spec import ContactFilter
from touchcell.perception.runtime.slip_aware import SlipAwareConfig, SlipAwareFilter, _innovation
from touchcell.perception.runtime.stick_slip import StickSlipFilter
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.sequences import Sequence, random_sequence

SIGMA = np.array([0.1e-3, 0.1e-3, 0.05e-3, 0.006, 0.006, 0.005])
PERIOD_NS = 33_333_333
DRIFT = isotropic_noise(0.05e-3, np.deg2rad(0.2))


def slip_aware() -> SlipAwareFilter:
    return SlipAwareConfig(model="slip_aware").build()


def errors(sequence: Sequence, contact_filter: ContactFilter | None, seed: int = 0) -> np.ndarray:
    """Errors (n, 6) mm and deg of frames that show what the skin holds, filtered."""
    rng, found = np.random.default_rng(seed), []
    for k, (sensor, held) in enumerate(zip(sequence.T_f_s, sequence.held, strict=True)):
        xi = se3.log(se3.inverse(held)) + SIGMA * rng.standard_normal(6)
        belief = gaussian.from_exponential(xi, np.diag(SIGMA**2))
        if contact_filter is not None:
            belief = contact_filter.update(belief, sensor, k * PERIOD_NS).belief
        found.append(se3.to_euler_mm_deg(se3.inverse(belief.mean)) - se3.to_euler_mm_deg(sensor))
    return np.array(found)


def rms(values: np.ndarray) -> np.ndarray:
    root: np.ndarray = np.sqrt((values**2).mean(axis=0))
    return root


@pytest.mark.parametrize("friction", [0.6, 1.0, 1.5])
def test_shear_and_torsion_err_by_less_than_half_of_what_other_filters_leave_while_the_skin_slips(
    friction: float,
) -> None:
    law = ContactLaw(slip_at_1mm_m=0.34e-3 * friction, torsion_grip=0.1 * friction)
    sequences = [random_sequence(240, seed, law) for seed in range(4)]
    slipping = np.concatenate([sequence.slipping for sequence in sequences])
    rivals: list[ContactFilter | None] = [None, PoseFilter(DRIFT), StickSlipFilter(100 * DRIFT, 0.5)]
    ours = np.concatenate([errors(sequence, slip_aware()) for sequence in sequences])
    for rival in rivals:
        theirs = []
        for sequence in sequences:
            if rival is not None:
                rival.reset()
            theirs.append(errors(sequence, rival))
        others = np.concatenate(theirs)
        for chosen in (slipping, ~slipping):
            assert (rms(ours[chosen])[[0, 1, 5]] < 0.5 * rms(others[chosen])[[0, 1, 5]]).all()
            assert (rms(ours[chosen])[2:5] < 1.05 * rms(errors_of_frames(sequences))[2:5]).all()


def errors_of_frames(sequences: list[Sequence]) -> np.ndarray:
    return np.concatenate([errors(sequence, None) for sequence in sequences])


def test_a_contact_that_never_slips_is_averaged_as_by_the_filter_of_a_still_surface() -> None:
    sequence = random_sequence(200, 1, ContactLaw(slip_at_1mm_m=20e-3, torsion_grip=1.0))
    assert not sequence.slipping.any()
    assert (rms(errors(sequence, slip_aware())) < rms(errors(sequence, None))).all()


def slid_contact(frames: int) -> tuple[list[PoseGaussian], list[np.ndarray]]:
    """Frames and sensor poses of skin that is pressed, held still, slides by 2 mm, is pressed deeper and then sticks.

    After the slide a frame is as sure of itself as before it, and wrong by 2 mm.
    """
    observed, sensors = [], []
    for k in range(frames):
        moved = float(np.clip((k - 60) / 30, 0.0, 1.0))
        sensor = se3.from_euler_mm_deg(np.array([3.0 * moved, 0.0, 1.5 + 2.5 * moved, 4.0, -3.0, 0.0]))
        held = se3.from_euler_mm_deg(np.array([1.0 * moved, 0.0, 1.5 + 2.5 * moved, 4.0, -3.0, 0.0]))
        observed.append(gaussian.from_exponential(se3.log(se3.inverse(held)), np.diag(SIGMA**2)))
        sensors.append(sensor)
    return observed, sensors


def test_confident_frames_after_a_slip_measure_the_slide_and_do_not_move_the_contact() -> None:
    contact_filter = slip_aware()
    observed, sensors = slid_contact(600)
    for k, (frame, sensor) in enumerate(zip(observed, sensors, strict=True)):
        belief = contact_filter.update(frame, sensor, k * PERIOD_NS).belief
    error = se3.to_euler_mm_deg(se3.inverse(belief.mean)) - se3.to_euler_mm_deg(sensors[-1])
    assert abs(error[0]) < 0.3
    assert contact_filter.slide[0] == pytest.approx(2e-3, abs=0.3e-3)
    assert gaussian.mahalanobis_squared(belief, se3.inverse(sensors[-1])) < 12.0
    contact_filter.reset()
    assert contact_filter.state is None
    assert not contact_filter.slide.any()


def test_where_each_frame_is_of_a_contact_of_its_own_a_slide_ends_with_its_frame() -> None:
    contact_filter = SlipAwareConfig(model="slip_aware", motions="single").build()
    observed, sensors = slid_contact(600)
    for k, (frame, sensor) in enumerate(zip(observed, sensors, strict=True)):
        belief = contact_filter.update(frame, sensor, k * PERIOD_NS).belief
    shown = se3.to_euler_mm_deg(se3.inverse(observed[-1].mean))
    assert se3.to_euler_mm_deg(se3.inverse(belief.mean))[0] == pytest.approx(shown[0], abs=0.3)


def test_a_frame_whose_tilt_is_wrong_does_not_move_the_contact_along_the_surface() -> None:
    # Shear is hardly known, depth well: along the axes of a sensor that is tilted, the two are not apart.
    sure = np.diag([2.0, 2.0, 0.05, 6.0, 6.0, 3.0]) ** 2
    contact_filter = slip_aware()
    sensor = se3.from_euler_mm_deg(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    for k, (depth_mm, tilt_deg) in enumerate(((2.0, 0.0), (2.2, 14.0), (1.8, -9.0), (2.2, 11.0))):
        shown = np.array([0.0, 0.0, depth_mm, 0.0, tilt_deg, 0.0])
        observed = gaussian.from_exponential(*xi_gaussian(shown, sure))
        belief = contact_filter.update(observed, sensor, k * PERIOD_NS).belief
    assert abs(se3.to_euler_mm_deg(se3.inverse(belief.mean))[0]) < 0.1


def test_the_shear_of_a_first_frame_is_no_larger_than_its_depth() -> None:
    unsure = np.diag([5.0, 5.0, 0.05, 1.0, 1.0, 5.0]) ** 2
    shown = np.array([4.0, -4.0, 0.5, 2.0, 3.0, 4.0])
    observed = gaussian.from_exponential(*xi_gaussian(shown, unsure))
    belief = slip_aware().update(observed, np.eye(4), 0).belief
    found = se3.to_euler_mm_deg(se3.inverse(belief.mean))
    assert np.abs(found[[0, 1, 5]]).max() < 0.5
    np.testing.assert_allclose(found[2:5], shown[2:5], atol=0.05)


def test_a_frame_is_expected_to_follow_contact_and_slide_as_their_derivatives_say() -> None:
    prior = se3.inverse(se3.from_euler_mm_deg(np.array([1.0, -2.0, 3.0, 12.0, -9.0, 4.0])))
    slide, step = np.array([2e-3, -1.5e-3, 0.06]), 1e-6
    turn = se3.from_euler_mm_deg(np.array([2.0, -1.5, 0.0, 0.0, 0.0, np.degrees(0.06)]))
    shown = PoseGaussian(se3.compose(prior, turn), np.diag(SIGMA**2))
    e, _, H = _innovation(shown, prior, slide)
    np.testing.assert_allclose(e, 0.0, atol=1e-12)
    for i in range(9):
        d = step * np.eye(9)[i]
        moved, _, _ = _innovation(shown, se3.compose(se3.exp(d[:6]), prior), slide + d[6:])
        np.testing.assert_allclose(-moved / step, H[:, i], atol=1e-5)


def test_what_is_no_pose_is_refused_and_changes_nothing() -> None:
    contact_filter = slip_aware()
    observed, sensors = slid_contact(2)
    with pytest.raises(GeometryError):
        contact_filter.update(observed[0], np.full((4, 4), np.nan), 0)
    assert contact_filter.state is None
    state = contact_filter.update(observed[0], sensors[0], 0)
    with pytest.raises(GeometryError):
        contact_filter.update(observed[1], np.full((4, 4), np.nan), PERIOD_NS)
    assert contact_filter.state is state


def test_sigma_of_shear_grows_where_frames_say_nothing_of_it() -> None:
    contact_filter, sigmas = slip_aware(), []
    covariance = np.diag(SIGMA**2)
    for k in range(300):
        x_mm = min(0.1 * k, 1.0)
        held = se3.from_euler_mm_deg(np.array([x_mm, 0.0, 1.5, 0.0, 0.0, 0.0]))
        sensor = se3.from_euler_mm_deg(np.array([0.1 * k, 0.0, 1.5, 0.0, 0.0, 0.0]))
        observed = gaussian.from_exponential(se3.log(se3.inverse(held)), covariance)
        state = contact_filter.update(observed, sensor, k * PERIOD_NS)
        sigmas.append(np.sqrt(np.diagonal(state.belief.covariance)))
    assert sigmas[-1][0] > 1.5 * sigmas[30][0]
    assert sigmas[-1][2] < 0.5 * sigmas[-1][0]


def test_frames_closer_together_than_they_are_independent_count_as_one() -> None:
    sigmas = []
    for frames in (10, 100):
        contact_filter = SlipAwareFilter(1e-12 * np.eye(6), 4e-3, 0.07, correlation_s=0.5)
        T_f_s = se3.from_euler_mm_deg(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))
        observed = gaussian.from_exponential(se3.log(se3.inverse(T_f_s)), np.diag(SIGMA**2))
        for k in range(frames + 1):
            state = contact_filter.update(observed, T_f_s, round(k * 5e9 / frames))
        sigmas.append(np.sqrt(np.diagonal(state.belief.covariance)))
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.05)


@pytest.mark.parametrize(
    ("axes", "trips"), [((1, 1, 1), False), ((-1, -1, 1), True), ((1, -1, 1), True), ((-1, 1, 1), True)]
)
def test_a_camera_that_is_mounted_turned_or_mirrored_trips_the_shipped_rule_and_a_good_one_never(
    axes: tuple[int, int, int], trips: bool
) -> None:
    law, seen = ContactLaw(slip_at_1mm_m=0.34e-3, torsion_grip=0.1), np.diag([*axes, 1.0])
    for seed in range(3):
        sequence, contact_filter = random_sequence(150, seed, law), slip_aware()
        rng, beyond, longest = np.random.default_rng(seed), 0, 0
        for k, (sensor, held) in enumerate(zip(sequence.T_f_s, sequence.held, strict=True)):
            xi = se3.log(se3.inverse(seen @ held @ seen)) + SIGMA * rng.standard_normal(6)
            state = contact_filter.update(gaussian.from_exponential(xi, np.diag(SIGMA**2)), sensor, k * PERIOD_NS)
            beyond = beyond + 1 if state.nis is not None and state.nis > 22.5 else 0
            longest = max(longest, beyond)
        # interlocks: {kind: inconsistent, limit_nis: 22.5, frames: 5}
        assert (longest >= 5) == trips
