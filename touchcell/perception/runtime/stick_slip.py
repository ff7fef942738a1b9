"""A filter that knows stick and slip: how much of the sensor's motion a contact feels is part of its state.

A contact that sticks to a surface which stands still changes by the whole motion of the sensor, as the still-surface
filter assumes. One that slides keeps its shear however far the sensor moves, and an object that is carried along keeps
all of its contact. So the prediction is ``T' = exp(L m) T``, with ``m = log(inv(T_b_s') T_b_s)`` the motion as the
contact sees it and ``L`` a diagonal of shares between 0 (carried along, or sliding) and 1 (stuck to what stands still),
one per component of the sensor frame.

The shares are learnt from the innovations ``e``: their gradient is ``m``, so a normalised least-mean-squares step moves
``L_i`` by ``e_i m_i / (m_i^2 + r_i)`` with ``r_i`` the variance of the innovation. Motions smaller than the noise teach
nothing, and a new contact begins stuck. What the shares leave out is noise of the process, whose size is learnt from
the innovations too (covariance matching: Mehra, IEEE TAC 1972; Myers & Tapley, IEEE TAC 1976). A surface that moves by
itself is followed by that.

The errors of one network are correlated from frame to frame. That part of their variance, ``bias_share``, is not
averaged out: it is left out of the correction and added to what the filter reports (a consider state: Schmidt 1966).
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import isotropic_noise, require_noise_density, require_pose
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before

_LEARNING: Final = 0.5
"""Part of a share's error that one informative innovation takes away."""
_MEMORY: Final = 6.0
"""Frames over which innovations are averaged."""


class StickSlipFilter:
    """Filter for observations of ``T_s_f`` from a moving sensor whose contact sticks, slides or is carried along.

    Args:
        noise_density: (6, 6) least growth of the covariance per second, [v, w], m^2/s and rad^2/s, sensor frame.
        bias_share: part of the observations' variance that does not average out, in [0, 1).

    Raises:
        NotPositiveDefinite: the noise density is not finite or not positive semidefinite.
    """

    def __init__(self, noise_density: Array, bias_share: float) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._white = 1.0 - bias_share
        self.reset()

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    @property
    def shares(self) -> Array:
        """(6,) share of the sensor's motion that each component of the contact feels."""
        return self._shares.copy()

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state: FilterState | None = None
        self._own: PoseGaussian | None = None
        self._bias = np.zeros((6, 6))
        self._shares = np.ones(6)
        self._process = np.zeros(6)

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        own, _ = self._moved(T_base_sensor, t_ns)
        return self._reported(own)

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose, or the fusion did not converge; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        white = PoseGaussian(observation.mean, self._white * observation.covariance)
        bias = observation.covariance - white.covariance
        if self._state is None:
            require_pose(T_base_sensor)
            self._own, self._bias = white, bias
            self._state = FilterState(self._reported(white), T_base_sensor, t_ns)
            return self._state
        prior, motion = self._moved(T_base_sensor, t_ns)
        e = se3.log(se3.compose(observation.mean, se3.inverse(prior.mean)))
        prior = self._learnt(prior, white, e, motion, (t_ns - self._state.t_ns) * 1e-9)
        fused, record = gaussian.fuse(prior, white)
        self._own, self._bias = fused, bias
        self._state = FilterState(self._reported(fused), T_base_sensor, t_ns, record.nis)
        return self._state

    def _moved(self, T_base_sensor: Array, t_ns: int) -> tuple[PoseGaussian, Array]:
        state, own = state_before(self._state, t_ns), self._own
        assert own is not None
        motion = se3.log(se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor))
        dt_s = (t_ns - state.t_ns) * 1e-9
        noise = self._noise_density * dt_s + np.diag(self._process * dt_s)
        return gaussian.compound(se3.exp(self._shares * motion), own, noise=noise), motion

    def _learnt(self, prior: PoseGaussian, white: PoseGaussian, e: Array, motion: Array, dt_s: float) -> PoseGaussian:
        """Learn shares and process noise from an innovation; return the prior updated by its own frame."""
        variance = np.diagonal(prior.covariance) + np.diagonal(white.covariance)
        change = _LEARNING * e * motion / (motion**2 + variance)
        shares = np.clip(self._shares + change, 0.0, 1.0)
        explained = (shares - self._shares) * motion
        self._shares = shares
        rest = e - explained
        if dt_s > 0.0:
            # What an innovation exceeds its own variance by is the process's.
            excess = (rest**2 - variance) / dt_s
            self._process = np.maximum(self._process + excess / _MEMORY, 0.0)
        jump = np.maximum(rest**2 - 4.0 * variance, 0.0)
        mean = se3.compose(se3.exp(explained), prior.mean)
        return PoseGaussian(mean, prior.covariance + np.diag(jump + explained**2))

    def _reported(self, own: PoseGaussian) -> PoseGaussian:
        return PoseGaussian(own.mean, own.covariance + self._bias)


class StickSlipConfig(FilterConfig):
    """The filter that learns how much of the arm's motion the contact feels: stuck, sliding, or carried along.

    Attributes:
        drift_mm_per_sqrt_s: least growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: least growth of the orientation's standard deviation between frames.
        bias_share: part of a frame's variance that is the same from frame to frame, so that it does not average out.
    """

    model: Literal["stick_slip"]
    drift_mm_per_sqrt_s: PositiveFloat
    drift_deg_per_sqrt_s: PositiveFloat
    bias_share: float = Field(default=0.5, ge=0.0, lt=1.0)

    def build(self) -> StickSlipFilter:
        """Return the ``StickSlipFilter``."""
        noise = isotropic_noise(1e-3 * self.drift_mm_per_sqrt_s, np.deg2rad(self.drift_deg_per_sqrt_s))
        return StickSlipFilter(noise, self.bias_share)


STICK_SLIP = FilterSpec(
    "stick_slip", "filter that knows whether the contact sticks, slides or is carried along", StickSlipConfig
)
