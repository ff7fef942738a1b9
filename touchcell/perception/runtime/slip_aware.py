"""A filter that knows that skin slides: a still surface, and how far the skin has slid along it as part of the state.

A model learns the motion of the arm since first touch as its label. Until the skin slips, a frame shows that motion;
afterwards the skin shows less, by as much as it has slid, and it keeps showing less when it sticks again. A single
frame cannot tell, and its error stays for as long as the contact lasts, so that averaging does not help either.

The state is the contact and the slide: two components along the surface and one about its normal, zero at first touch.
A frame shows both together. Between two frames the skin has stuck, and the slide is what it was; or it has slipped, by
at most about as far as the sensor has moved. Bayes' rule weighs both by how well they explain the frame, the prior
being the probability of slip that the frame tells, and their mixture is the new state (a generalised pseudo-Bayesian
filter of first order). Frames after a slip thus measure the slide, and the contact keeps what frames before it said.

Skin that has just been touched has hardly been sheared: the shear of the first frame is no larger than its depth.

What a frame measures is known along and across the surface, not along the axes of the sensor: its covariance is turned
to the surface of the prediction, which is known better than that of the frame.

Frames shortly after one another err alike. Those within ``correlation_s`` share the information of one.

Sources: Lloyd & Lepora 2024, section 3.2 (the filter); Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 11.6 (several models of one motion).
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.models.prediction import slip_probability
from touchcell.perception.runtime.filter import isotropic_noise, require_noise_density, require_pose
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before

_LEAST, _MOST = 0.1, 0.9
"""Bounds of the prior probability that the skin slips between two frames: friction may be another than a model's."""
_APPROACH: Final = 1.0
"""Standard deviation of the sensor's motion along the surface until the first frame, relative to its depth there."""


class SlipAwareFilter:
    """Filter for observations of ``T_s_f`` of a static surface, from a moving sensor whose skin may slip.

    Args:
        noise_density: (6, 6) growth of the covariance per second, [v, w], m^2/s and rad^2/s, sensor frame.
        slide_m, slide_rad: standard deviations of how far skin slides along the surface and about its normal: for all
            of a single contact, and their ratio for contacts that move.
        correlation_s: frames within this time share the information of one.
        single: each frame is of a contact of its own, whose slide says nothing of the next one's.

    Raises:
        NotPositiveDefinite: the noise density is not finite or not positive semidefinite.
    """

    def __init__(
        self, noise_density: Array, slide_m: float, slide_rad: float, correlation_s: float, *, single: bool = False
    ) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._slide_m = slide_m
        self._turn_rad_per_m = slide_rad / slide_m
        self._correlation_s = correlation_s
        self._single = single
        self.reset()

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    @property
    def slide(self) -> Array:
        """(3,) how far the skin has slid since first touch: along x and y of the surface, m, and about its z, rad."""
        return self._slide.copy()

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state: FilterState | None = None
        self._slide = np.zeros(3)
        self._covariance = np.zeros((9, 9))

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        mean, covariance, _ = self._moved(T_base_sensor, t_ns)
        return PoseGaussian(mean, covariance[:6, :6])

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        require_pose(T_base_sensor)
        if self._state is None:
            belief = observation if self._single else _just_touched(observation, self._turn_rad_per_m)
            self._covariance[:6, :6] = belief.covariance
            self._state = FilterState(belief, T_base_sensor, t_ns)
            return self._state
        prior, covariance, U = self._moved(T_base_sensor, t_ns)
        slide, growth = self._slide, self._growth(prior, U)
        if self._single:
            slide = np.zeros(3)
            covariance[6:, :] = covariance[:, 6:] = 0.0
        e, noise, H = _innovation(observation, prior, slide)
        shared = max(min((t_ns - self._state.t_ns) * 1e-9 / self._correlation_s, 1.0), 1e-6)
        corrections, logs, squares = [], [], []
        for grown in (0.0, growth):
            before = covariance.copy()
            before[[6, 7, 8], [6, 7, 8]] += grown
            across = H @ before
            log, nis = _log_density(e, across @ H.T + noise)
            logs.append(log)
            squares.append(nis)
            K = np.linalg.solve(across @ H.T + noise / shared, across).T
            left = np.eye(9) - K @ H
            corrections.append((K @ e, left @ before @ left.T + K @ (noise / shared) @ K.T))
        slips = _posterior(_prior_of_slip(observation), logs[1] - logs[0])
        step, covariance = _mixed(corrections, slips)
        mean = se3.compose(se3.exp(step[:6]), prior)
        # The position is known along and across the surface, which has just been found to be tilted otherwise.
        turned = np.eye(9)
        turned[:3, :3] = mean[:3, :3] @ prior[:3, :3].T
        covariance = turned @ covariance @ turned.T
        belief = PoseGaussian(mean, covariance[:6, :6])
        self._slide, self._covariance = slide + step[6:], covariance
        self._state = FilterState(belief, T_base_sensor, t_ns, (1.0 - slips) * squares[0] + slips * squares[1])
        return self._state

    def _moved(self, T_base_sensor: Array, t_ns: int) -> tuple[Array, Array, Array]:
        """Return the mean and (9, 9) covariance predicted for a sensor pose, and the motion from the state's."""
        state = state_before(self._state, t_ns)
        U = se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor)
        moving = np.eye(9)
        moving[:6, :6] = se3.adjoint(U)
        covariance = moving @ self._covariance @ moving.T
        covariance[:6, :6] += self._noise_density * ((t_ns - state.t_ns) * 1e-9)
        return se3.compose(U, state.belief.mean), 0.5 * (covariance + covariance.T), U

    def _growth(self, prior: Array, U: Array) -> Array:
        """Return (3,) variances of how far skin that slips slides while the sensor moves by ``U``."""
        if self._single:
            along, turned = self._slide_m**2, 0.0
        else:
            motion = se3.log(U)
            along, turned = float(motion[:3] @ motion[:3]), float(prior[:3, 2] @ motion[3:]) ** 2
        return np.array([along, along, turned + self._turn_rad_per_m**2 * along])


def _just_touched(observation: PoseGaussian, turn_rad_per_m: float) -> PoseGaussian:
    """Return a first frame with what every first frame shares: the sensor has hardly moved along the surface yet."""
    T_f_s = se3.inverse(observation.mean)
    moved_m = _APPROACH * (abs(T_f_s[2, 3]) + math.sqrt(observation.covariance[2, 2]))
    # What e in exp(e) T_s_f does to shear and torsion.
    H = np.zeros((3, 6))
    H[:2, :3], H[2, 3:] = -T_f_s[:2, :3], -T_f_s[2, :3]
    across = H @ observation.covariance
    K = np.linalg.solve(across @ H.T + moved_m**2 * np.diag([1.0, 1.0, turn_rad_per_m**2]), across).T
    shear = np.array([T_f_s[0, 3], T_f_s[1, 3], math.atan2(T_f_s[1, 0], T_f_s[0, 0])])
    covariance = observation.covariance - K @ across
    return PoseGaussian(se3.compose(se3.exp(-K @ shear), observation.mean), 0.5 * (covariance + covariance.T))


def _innovation(observation: PoseGaussian, prior: Array, slide: Array) -> tuple[Array, Array, Array]:
    """Return (6,) the observation less what is expected, its (6, 6) noise, and (6, 9) what the state does to it."""
    x, y, angle = slide.tolist()
    c, s = math.cos(angle), math.sin(angle)
    slid = np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    off = se3.compose(observation.mean, se3.inverse(se3.compose(prior, slid)))
    back = np.eye(6)
    back[:3, :3] = off[:3, :3].T
    e = np.concatenate([off[:3, :3].T @ off[:3, 3], se3.log(off)[3:]])
    H = np.eye(6, 9)
    # The skin turns about where it has slid to.
    H[:, 6:] = se3.adjoint(prior)[:, [0, 1, 5]]
    H[:, 8] += y * H[:, 6] - x * H[:, 7]
    return e, back @ observation.covariance @ back.T, H


def _prior_of_slip(observation: PoseGaussian) -> float:
    at, sigma = se3.inverse(observation.mean)[:3, 3], np.sqrt(np.diagonal(observation.covariance))[:3]
    return min(max(slip_probability(at, sigma), _LEAST), _MOST)


def _posterior(prior: float, log_ratio: float) -> float:
    """Return the probability of a hypothesis from its prior one and the logarithm of its Bayes factor."""
    log_odds = math.log(prior / (1.0 - prior)) + log_ratio
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -700.0), 700.0)))


def _mixed(two: list[tuple[Array, Array]], share: float) -> tuple[Array, Array]:
    """Return mean and covariance of a mixture of two Gaussians, ``share`` that of the second."""
    (first, first_covariance), (second, second_covariance) = two
    apart = second - first
    covariance = (1.0 - share) * first_covariance + share * second_covariance
    covariance += share * (1.0 - share) * np.outer(apart, apart)
    return first + share * apart, 0.5 * (covariance + covariance.T)


def _log_density(e: Array, covariance: Array) -> tuple[float, float]:
    """Return the logarithm of a Gaussian density, without its constant, and the squared Mahalanobis distance."""
    square = float(e @ np.linalg.solve(covariance, e))
    return -0.5 * (square + float(np.linalg.slogdet(covariance)[1])), square


class SlipAwareConfig(FilterConfig):
    """The filter of a still surface along which skin slips: how far it has slid is estimated beside the contact.

    Attributes:
        drift_mm_per_sqrt_s: growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: growth of the orientation's standard deviation between frames.
        motions: ``sequence`` for contacts that move, ``single`` where each frame is of a contact of its own that was
            pressed and then sheared, as in public data.
        slide_mm: standard deviation of how far skin of a single contact slides along the surface.
        slide_deg: how far skin turns about the surface's normal where it slides by ``slide_mm``.
        correlation_ms: frames within this time err alike and count as one.
    """

    model: Literal["slip_aware"]
    drift_mm_per_sqrt_s: PositiveFloat = 0.05
    drift_deg_per_sqrt_s: PositiveFloat = 0.2
    motions: Literal["sequence", "single"] = "sequence"
    slide_mm: PositiveFloat = 4.0
    slide_deg: PositiveFloat = 4.0
    correlation_ms: PositiveFloat = 300.0

    def build(self) -> SlipAwareFilter:
        """Return the ``SlipAwareFilter``."""
        return SlipAwareFilter(
            isotropic_noise(1e-3 * self.drift_mm_per_sqrt_s, np.deg2rad(self.drift_deg_per_sqrt_s)),
            1e-3 * self.slide_mm,
            float(np.deg2rad(self.slide_deg)),
            1e-3 * self.correlation_ms,
            single=self.motions == "single",
        )


SLIP_AWARE: Final = FilterSpec(
    "slip_aware",
    "filter of a surface that stands still, along which the skin may slip",
    SlipAwareConfig,
    anchored=True,
)
