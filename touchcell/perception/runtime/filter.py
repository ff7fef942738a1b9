"""The discriminative Bayesian filter on SE(3) (Lloyd & Lepora 2024, section 3.2, Algorithm 2).

State: a Gaussian over ``T_s_f`` with left perturbations. The surface is static in the world, so when the sensor
moves from ``T_b_s`` to ``T_b_s'`` the state moves by ``U = inv(T_b_s') T_b_s``; an observation is fused as the product
of two Gaussians on the manifold. Training poses are drawn uniformly, so dividing by p(state) changes nothing.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before


class PoseFilter:
    """Filter for observations of ``T_s_f`` of a static surface, from a moving sensor.

    Args:
        noise_density: (6, 6) growth of the covariance per second, [v, w], m^2/s and rad^2/s, sensor frame. It models
            slip,
            surface curvature and everything else that the static-surface model leaves out.
        order: 2 or 4, order of the covariance's prediction (``gaussian.compound``: 2 suffices below 0.1 rad).

    Raises:
        NotPositiveDefinite: the noise density is not finite or not positive semidefinite.
    """

    def __init__(self, noise_density: Array, *, order: Literal[2, 4] = 2) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._order = order
        self._state: FilterState | None = None

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state = None

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        state = state_before(self._state, t_ns)
        U = se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor)
        noise = self._noise_density * ((t_ns - state.t_ns) * 1e-9)
        return gaussian.compound(U, state.belief, noise=noise, order=self._order)

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose, or the fusion did not converge; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        if self._state is None:
            self._state = FilterState(observation, require_pose(T_base_sensor), t_ns)
        else:
            fused, record = gaussian.fuse(self.predict(T_base_sensor, t_ns), observation)
            self._state = FilterState(fused, T_base_sensor, t_ns, record.nis)
        return self._state


def isotropic_noise(translation_m_per_sqrt_s: float, rotation_rad_per_sqrt_s: float) -> Array:
    """Return the (6, 6) noise density of independent random walks, equal along all axes."""
    return np.diag([translation_m_per_sqrt_s**2] * 3 + [rotation_rad_per_sqrt_s**2] * 3)


def require_noise_density(noise_density: Array) -> None:
    """Raise NotPositiveDefinite unless it is a valid covariance growth: at construction, not at the second frame."""
    gaussian.compound(np.eye(4), PoseGaussian(np.eye(4), np.eye(6)), noise_density)


def require_pose(T_base_sensor: Array) -> Array:
    """Return the pose. Raises GeometryError unless it is one: a first frame is stored before anything is computed."""
    return PoseGaussian(T_base_sensor, np.eye(6)).mean


class StillSurfaceConfig(FilterConfig):
    """The SE(3) Bayesian filter: growth of the uncertainty while no frame comes (slip, curvature).

    Attributes:
        drift_mm_per_sqrt_s: growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: growth of the orientation's standard deviation between frames.
    """

    model: Literal["still_surface"] = "still_surface"
    drift_mm_per_sqrt_s: PositiveFloat
    drift_deg_per_sqrt_s: PositiveFloat

    def build(self) -> PoseFilter:
        """Return the ``PoseFilter``."""
        return PoseFilter(isotropic_noise(1e-3 * self.drift_mm_per_sqrt_s, np.deg2rad(self.drift_deg_per_sqrt_s)))


STILL_SURFACE = FilterSpec("still_surface", "SE(3) Bayesian filter of a surface that stands still", StillSurfaceConfig)
