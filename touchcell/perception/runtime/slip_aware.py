"""A filter that knows that skin may have slipped: a still surface, and two explanations of each frame.

A model learns the motion of the arm since first touch as its label. Until the skin slips, a frame shows that motion;
afterwards the skin shows less, by as much as it has slid, and it keeps showing less when it sticks again. A single
frame cannot tell, and its error stays for as long as the contact lasts, so that averaging does not help either.

Here the contact is predicted by the sensor's motion, as of a surface that stands still, and each frame has two
explanations: the skin has not slipped, and errs as the estimator says; or it has, and shear and torsion are off by an
unknown slide besides. The prior probability of the second is the largest probability of slip seen in this contact,
Bayes' rule weighs both against the prediction, and the frame counts with its mean information. Depth and tilt are
corrected by every frame.

Frames shortly after one another err alike. Those within ``correlation_s`` share the information of one.

Sources: Lloyd & Lepora 2024, section 3.2 (the filter); Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 11.6 (several models of one measurement).
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.models.prediction import slip_probability
from touchcell.perception.runtime.filter import isotropic_noise, require_noise_density, require_pose
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before

_LEAST, _MOST = 0.05, 0.999
"""Bounds of the prior probability that the skin has slipped."""


class SlipAwareFilter:
    """Filter for observations of ``T_s_f`` of a static surface, from a moving sensor whose skin may slip.

    Args:
        noise_density: (6, 6) growth of the covariance per second, [v, w], m^2/s and rad^2/s, sensor frame.
        slide_m, slide_rad: standard deviations of how far skin has slid along the surface and about its normal.
        correlation_s: frames within this time share the information of one.

    Raises:
        NotPositiveDefinite: the noise density is not finite or not positive semidefinite.
    """

    def __init__(self, noise_density: Array, slide_m: float, slide_rad: float, correlation_s: float) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._slide = np.array([slide_m, slide_rad]) ** 2
        self._correlation_s = correlation_s
        self.reset()

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    @property
    def slipped(self) -> float:
        """Prior probability that the skin has slipped since first touch."""
        return self._slipped

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state: FilterState | None = None
        self._slipped = _LEAST

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        state = state_before(self._state, t_ns)
        U = se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor)
        return gaussian.compound(U, state.belief, noise=self._noise_density * ((t_ns - state.t_ns) * 1e-9))

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose, or the fusion did not converge; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        now = slip_probability(se3.inverse(observation.mean)[:3, 3], np.sqrt(np.diagonal(observation.covariance))[:3])
        slipped = min(max(self._slipped, now), _MOST)
        if self._state is None:
            state = FilterState(observation, require_pose(T_base_sensor), t_ns)
        else:
            prior = self.predict(T_base_sensor, t_ns)
            explained, nis = self._explained(prior, observation, slipped)
            shared = min((t_ns - self._state.t_ns) * 1e-9 / self._correlation_s, 1.0)
            counted = PoseGaussian(explained.mean, explained.covariance / max(shared, 1e-6))
            fused, _ = gaussian.fuse(prior, counted)
            state = FilterState(fused, T_base_sensor, t_ns, nis)
        self._state, self._slipped = state, slipped
        return state

    def _explained(self, prior: PoseGaussian, observation: PoseGaussian, slipped: float) -> tuple[PoseGaussian, float]:
        """Return the observation with the covariance that both explanations give it, and its innovation squared."""
        e = se3.log(se3.compose(observation.mean, se3.inverse(prior.mean)))
        stuck = observation.covariance
        slid = stuck + self._slide_covariance(prior.mean[:3, 2])
        logs = [math.log(1.0 - slipped) + _log_density(e, prior.covariance + stuck)]
        logs += [math.log(slipped) + _log_density(e, prior.covariance + slid)]
        share = 1.0 / (1.0 + math.exp(min(logs[1] - logs[0], 700.0)))
        both = np.linalg.inv(share * np.linalg.inv(stuck) + (1.0 - share) * np.linalg.inv(slid))
        both = 0.5 * (both + both.T)
        return PoseGaussian(observation.mean, both), float(e @ np.linalg.solve(prior.covariance + both, e))

    def _slide_covariance(self, normal: Array) -> Array:
        """Return (6, 6) of a slide along the surface and about its unit normal (3,), in the sensor frame."""
        about = np.outer(normal, normal)
        S = np.zeros((6, 6))
        S[:3, :3] = self._slide[0] * (np.eye(3) - about)
        S[3:, 3:] = self._slide[1] * about
        return S


def _log_density(e: Array, covariance: Array) -> float:
    """Return the logarithm of a Gaussian density, without its constant."""
    return -0.5 * float(e @ np.linalg.solve(covariance, e)) - 0.5 * float(np.linalg.slogdet(covariance)[1])


class SlipAwareConfig(FilterConfig):
    """The filter of a still surface along which skin slips: frames of skin that has slipped count little in shear.

    Attributes:
        drift_mm_per_sqrt_s: growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: growth of the orientation's standard deviation between frames.
        slide_mm: standard deviation of how far skin that has slipped is off along the surface.
        slide_deg: the same about the surface's normal.
        correlation_ms: frames within this time err alike and count as one.
    """

    model: Literal["slip_aware"]
    drift_mm_per_sqrt_s: PositiveFloat = 0.05
    drift_deg_per_sqrt_s: PositiveFloat = 0.2
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
        )


SLIP_AWARE: Final = FilterSpec(
    "slip_aware", "filter of a surface that stands still, along which the skin may slip", SlipAwareConfig
)
