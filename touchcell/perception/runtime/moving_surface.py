"""A filter for surfaces that move: contact pose and the surface's twist in one state, at constant velocity.

The still-surface filter (``touchcell.perception.runtime.filter``) lags a moving surface, because it takes the surface's
motion for noise. Here the state is the pose ``T_s_f`` and the surface's twist ``xi`` relative to the base, [v, w] along
the axes and at the origin of the sensor frame, with perturbations ``T = exp(e) Tbar`` and ``xi = xibar + d``, (e, d) ~
N(0, P), 12-D.

Prediction. While the surface moves by ``E = exp(xi dt)`` and the sensor by ``U = inv(T_b_s') T_b_s``, the pose becomes
``U E T`` and the twist, carried to the new sensor frame, ``Ad(U) xi``. With ``J = J_l(xibar dt)``,

    U exp((xibar + d) dt) exp(e) Tbar = exp(Ad(U) J d dt) exp(Ad(U E) e) U E Tbar   to first order in d, so

    e' = Ad(U E) e + dt Ad(U) J d,    d' = Ad(U) d,

to which come the drift of the pose and a random walk of the twist with density W (white acceleration), integrated:
``[[drift dt + W dt^3/3, W dt^2/2], [W dt^2/2, W dt]]``.

Correction. A frame observes the pose alone, and given the pose error e the twist error is Gaussian with mean ``G e``
and covariance C, where ``P = [[L, 0], [M, N]] [[L, 0], [M, N]]'`` (Cholesky), ``G = M L^-1`` and ``C = N N'``. The
joint optimum is therefore the fused pose, by the same Gauss-Newton iteration as for a still surface, and the twist that
follows from it: with ``e* = log(T inv(Tbar))``, and ``J_l^-1(e*)``, which turns a perturbation of the fused mean into
one of the prior's, ``K = G J_l^-1(e*)``; then ``xi = xibar + G e*``, and the covariance of (e, d) is
``[[S, S K'], [K S, C + K S K']]`` with S that of the fused pose. Nothing is subtracted, so it stays positive definite.

Sources: Barfoot and Furgale, T-RO 2014 (left perturbations); Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 6.2 (white-noise acceleration).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import NotPositiveDefinite, PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import isotropic_noise, require_noise_density, require_pose
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState, state_before


@dataclass(frozen=True, slots=True)
class SurfaceMotion:
    """Estimated motion of the surface.

    Attributes:
        twist: (6,) of the surface relative to the base, [v, w], m/s and rad/s, in the sensor frame.
        covariance: (12, 12) of pose perturbation and twist, (e, d), SI.
    """

    twist: Array
    covariance: Array


class MovingSurfaceFilter:
    """Filter for observations of ``T_s_f`` of a surface with constant twist, from a moving sensor.

    Args:
        noise_density: (6, 6) growth of the pose's covariance per second apart from the twist's, as for ``PoseFilter``.
        twist_noise_density: (6, 6) growth of the twist's covariance per second, m^2/s^3 and rad^2/s^3.
        first_twist_covariance: (6, 6) prior covariance of the twist about zero.

    Raises:
        NotPositiveDefinite: a matrix is not finite, or not positive definite (``noise_density``: semidefinite).
    """

    def __init__(self, noise_density: Array, twist_noise_density: Array, first_twist_covariance: Array) -> None:
        require_noise_density(noise_density)
        self._noise_density = noise_density
        self._twist_noise_density = PoseGaussian(np.eye(4), twist_noise_density).covariance
        self._first_twist_covariance = PoseGaussian(np.eye(4), first_twist_covariance).covariance
        self._state: FilterState | None = None
        self._motion: SurfaceMotion | None = None

    @property
    def state(self) -> FilterState | None:
        """The current state, None before the first observation."""
        return self._state

    @property
    def motion(self) -> SurfaceMotion | None:
        """The surface's motion at the current state, None before the first observation."""
        return self._motion

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        self._state = self._motion = None

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate at ``t_ns`` by the motion of sensor and surface; the state is unchanged.

        Raises:
            ValueError: no observation yet, or ``t_ns`` is before the state's time.
        """
        way = self._way(T_base_sensor, t_ns)
        P = way.of_pose @ way.before.covariance @ way.of_pose.T
        return self._belief(way, P)

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state.

        Raises:
            GeometryError: ``T_base_sensor`` is not a pose, or the fusion did not converge; the state is unchanged.
            ValueError: ``t_ns`` is before the state's time.
        """
        if self._state is None:
            self._state = FilterState(observation, require_pose(T_base_sensor), t_ns)
            covariance = np.zeros((12, 12))
            covariance[:6, :6], covariance[6:, 6:] = observation.covariance, self._first_twist_covariance
            self._motion = SurfaceMotion(np.zeros(6), covariance)
            return self._state
        prior, motion = self._moved(T_base_sensor, t_ns)
        fused, record = gaussian.fuse(prior, observation)
        self._motion = _corrected(motion, prior, fused)
        self._state = FilterState(fused, T_base_sensor, t_ns, record.nis)
        return self._state

    def _moved(self, T_base_sensor: Array, t_ns: int) -> tuple[PoseGaussian, SurfaceMotion]:
        way = self._way(T_base_sensor, t_ns)
        F = np.zeros((12, 12))
        F[:6], F[6:, 6:] = way.of_pose, way.Ad_U
        P = F @ way.before.covariance @ F.T
        W, dt = self._twist_noise_density, way.dt_s
        belief = self._belief(way, P[:6, :6])
        P[:6, :6] = belief.covariance
        P[:6, 6:] += W * (dt**2 / 2.0)
        P[6:, :6] = P[:6, 6:].T
        P[6:, 6:] += W * dt
        P[6:, 6:] = 0.5 * (P[6:, 6:] + P[6:, 6:].T)
        return belief, SurfaceMotion(way.Ad_U @ way.before.twist, P)

    def _way(self, T_base_sensor: Array, t_ns: int) -> _Way:
        state, motion = state_before(self._state, t_ns), self._motion
        assert motion is not None
        dt = (t_ns - state.t_ns) * 1e-9
        U = se3.compose(se3.inverse(T_base_sensor), state.T_base_sensor)
        UE = se3.compose(U, se3.exp(motion.twist * dt))
        Ad_U = se3.adjoint(U)
        of_pose = np.empty((6, 12))
        of_pose[:, :6] = se3.adjoint(UE)
        of_pose[:, 6:] = dt * (Ad_U @ se3.left_jacobian(motion.twist * dt))
        return _Way(dt, se3.compose(UE, state.belief.mean), Ad_U, of_pose, motion)

    def _belief(self, way: _Way, P: Array) -> PoseGaussian:
        P = P + self._noise_density * way.dt_s + self._twist_noise_density * (way.dt_s**3 / 3.0)
        return PoseGaussian(way.T_s_f, 0.5 * (P + P.T))


@dataclass(frozen=True, slots=True)
class _Way:
    """Transition from the state to a later time, to first order.

    Attributes:
        dt_s: time step.
        T_s_f: (4, 4) predicted mean of the pose.
        Ad_U: (6, 6) maps twists to the sensor frame at the later time.
        of_pose: (6, 12) Jacobian of the later pose perturbation with respect to the current (pose, twist).
        before: motion at the state.
    """

    dt_s: float
    T_s_f: Array
    Ad_U: Array
    of_pose: Array
    before: SurfaceMotion


def _corrected(motion: SurfaceMotion, prior: PoseGaussian, fused: PoseGaussian) -> SurfaceMotion:
    try:
        factor = np.linalg.cholesky(motion.covariance)
    except np.linalg.LinAlgError:
        raise NotPositiveDefinite("MovingSurfaceFilter.update", "covariance") from None
    L, M, N = factor[:6, :6], factor[6:, :6], factor[6:, 6:]
    G = np.linalg.solve(L.T, M.T).T
    e = se3.log(se3.compose(fused.mean, se3.inverse(prior.mean)))
    K = G @ se3.left_jacobian_inverse(e)
    S = fused.covariance
    KS = K @ S
    rest = N @ N.T + KS @ K.T
    covariance = np.empty((12, 12))
    covariance[:6, :6], covariance[:6, 6:], covariance[6:, :6] = S, KS.T, KS
    covariance[6:, 6:] = 0.5 * (rest + rest.T)
    return SurfaceMotion(motion.twist + G @ e, covariance)


class MovingSurfaceConfig(FilterConfig):
    """The filter that also estimates the surface's velocity, for surfaces that move steadily.

    ``speed_*`` is the standard deviation of the surface's velocity when it is first touched, ``accel_*`` the growth of
    the velocity's uncertainty.

    Attributes:
        drift_mm_per_sqrt_s: growth of the position's standard deviation between frames.
        drift_deg_per_sqrt_s: growth of the orientation's standard deviation between frames.
        speed_mm_s: standard deviation of the surface's linear velocity when it is first touched.
        speed_deg_s: standard deviation of its angular velocity then.
        accel_mm_s_per_sqrt_s: growth of the linear velocity's standard deviation.
        accel_deg_s_per_sqrt_s: growth of the angular velocity's standard deviation.
    """

    model: Literal["moving_surface"]
    drift_mm_per_sqrt_s: PositiveFloat
    drift_deg_per_sqrt_s: PositiveFloat
    speed_mm_s: PositiveFloat
    speed_deg_s: PositiveFloat
    accel_mm_s_per_sqrt_s: PositiveFloat
    accel_deg_s_per_sqrt_s: PositiveFloat

    def build(self) -> MovingSurfaceFilter:
        """Return the ``MovingSurfaceFilter``."""
        return MovingSurfaceFilter(
            isotropic_noise(1e-3 * self.drift_mm_per_sqrt_s, np.deg2rad(self.drift_deg_per_sqrt_s)),
            isotropic_noise(1e-3 * self.accel_mm_s_per_sqrt_s, np.deg2rad(self.accel_deg_s_per_sqrt_s)),
            isotropic_noise(1e-3 * self.speed_mm_s, np.deg2rad(self.speed_deg_s)),
        )


MOVING_SURFACE = FilterSpec("moving_surface", "filter that also estimates the surface's velocity", MovingSurfaceConfig)
