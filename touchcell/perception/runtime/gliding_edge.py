"""A filter for edges: their frame {e} glides along with the tip and turns with the edge's bend.

State: ``T_s_e``, in which the sensor is at y = 0 by definition, and the bend ``c`` (3,) rad/m, the turn of {e} about
its own axes for each metre along the edge. Perturbations are ``T = exp(e) Tbar``, ``c = cbar + d``, (e, d) ~ N(0, P).

Prediction. While the sensor moves by ``U = inv(T_b_s') T_b_s`` a frame that stood still would be at ``U T_s_e``, with
the sensor at some y along it. {e} has glided by that, and turned: ``T_s_e' = U T_s_e Trans(0, y, 0) exp([0, c y])``.
Factors on the right leave left perturbations as they are, but for the unknown part of the bend:

    e' = Ad(U) e + y B d,    B = the last three columns of Ad(T_s_e'),    d' = d,

to which come the drift of both and, in {e}, a free y: ``Ad(T_s_e') diag(0, s^2, 0, 0, 0, 0) Ad(T_s_e')'``. What an
estimator says along the edge replaces what was there before, so five of the six numbers are filtered.

Correction. As for moving surfaces: the product of two Gaussians over the pose, and the bend that follows from it by
its regression ``G`` on the pose. A frame that contradicts the prediction beyond chance is a corner: the filter begins
anew with it, straight ahead.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import isotropic_noise, require_noise_density, require_pose
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before

_FREE_M: Final = 5e-3
_ALONG: Final = 1


class GlidingEdgeFilter:
    """Filter for observations of ``T_s_e`` of an edge that stands still, from a sensor that follows it.

    Args:
        noise_density: (6, 6) growth of the covariance per second, as for ``PoseFilter``.
        bend_per_m: standard deviation of the bend where nothing is known of it.
        bend_over_m: the way over which it changes by as much.
        corner_nis: normalised innovation squared from which an observation is a corner.

    Raises:
        NotPositiveDefinite: the noise density is not finite or not positive semidefinite.
    """

    def __init__(self, noise_density: Array, bend_per_m: float, bend_over_m: float, corner_nis: float) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._first_bend = bend_per_m**2 * np.eye(3)
        self._bend_drift = self._first_bend / bend_over_m
        self._corner_nis = corner_nis
        self._state: FilterState | None = None
        self._bend = np.zeros(3)
        self._with_bend = np.zeros((3, 6))
        self._of_bend = self._first_bend

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    @property
    def bend_per_m(self) -> Array:
        """The edge's bend (3,) rad/m about the axes of {e}."""
        return self._bend.copy()

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state = None

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        return self._predicted(T_base_sensor, t_ns)[0]

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose, or the fusion did not converge; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        if self._state is None:
            return self._begin(FilterState(observation, require_pose(T_base_sensor), t_ns))
        prior, with_bend, of_bend = self._predicted(T_base_sensor, t_ns)
        fused, record = gaussian.fuse(prior, observation)
        if record.nis > self._corner_nis:
            return self._begin(FilterState(observation, T_base_sensor, t_ns, record.nis))
        G = np.linalg.solve(prior.covariance, with_bend.T).T
        self._bend = self._bend + G @ se3.log(se3.compose(fused.mean, se3.inverse(prior.mean)))
        self._with_bend = G @ fused.covariance
        self._of_bend = of_bend - G @ with_bend.T + self._with_bend @ G.T
        self._state = FilterState(fused, T_base_sensor, t_ns, record.nis)
        return self._state

    def _begin(self, state: FilterState) -> FilterState:
        self._state = state
        self._bend, self._with_bend, self._of_bend = np.zeros(3), np.zeros((3, 6)), self._first_bend
        return state

    def _predicted(self, T_base_sensor: Array, t_ns: int) -> tuple[PoseGaussian, Array, Array]:
        """Return the pose, the covariance (3, 6) of the bend with it and that (3, 3) of the bend."""
        state = state_before(self._state, t_ns)
        U = se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor)
        still = gaussian.compound(U, state.belief, noise=self._noise_density * ((t_ns - state.t_ns) * 1e-9))
        y_m = float(se3.inverse(still.mean)[_ALONG, 3])
        T_s_e = still.mean.copy()
        T_s_e[:3, 3] += y_m * T_s_e[:3, _ALONG]
        T_s_e = se3.compose(T_s_e, se3.exp(np.concatenate([np.zeros(3), y_m * self._bend])))
        Ad = se3.adjoint(T_s_e)
        turned, along = y_m * Ad[:, 3:], _FREE_M * Ad[:, _ALONG]
        of_bend = self._of_bend + abs(y_m) * self._bend_drift
        carried = self._with_bend @ se3.adjoint(U).T
        both = turned @ carried
        covariance = still.covariance + both + both.T + turned @ of_bend @ turned.T + np.outer(along, along)
        return PoseGaussian(T_s_e, 0.5 * (covariance + covariance.T)), carried + of_bend @ turned.T, of_bend


class GlidingEdgeConfig(FilterConfig):
    """The filter of edges: growth of the uncertainty while no frame comes, how edges bend, and what a corner is.

    Attributes:
        drift_mm_per_sqrt_s: growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: growth of the orientation's.
        bend_deg_per_mm: standard deviation of the turn of edge and face on each millimetre.
        bend_over_mm: the way over which that changes by as much.
        corner_nis: normalised innovation squared of a frame with which the filter begins anew; chi-squared with six
            degrees of freedom where nothing is new.
    """

    model: Literal["gliding_edge"] = "gliding_edge"
    drift_mm_per_sqrt_s: PositiveFloat = 1.0
    drift_deg_per_sqrt_s: PositiveFloat = 4.0
    bend_deg_per_mm: PositiveFloat = 1.5
    bend_over_mm: PositiveFloat = 20.0
    corner_nis: PositiveFloat = 30.0

    def build(self) -> GlidingEdgeFilter:
        """Return the ``GlidingEdgeFilter``."""
        noise = isotropic_noise(1e-3 * self.drift_mm_per_sqrt_s, np.deg2rad(self.drift_deg_per_sqrt_s))
        bend_per_m = 1e3 * np.deg2rad(self.bend_deg_per_mm)
        return GlidingEdgeFilter(noise, bend_per_m, 1e-3 * self.bend_over_mm, self.corner_nis)


GLIDING_EDGE = FilterSpec(
    "gliding_edge", "SE(3) Bayesian filter of an edge along which its frame glides", GlidingEdgeConfig, feature="edge"
)
