"""Long runs of a filter, in blocks, and a reference filter in mpmath."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian, mahalanobis_squared
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter_spec import ContactFilter

STEP_NS = 10_000_000
BLOCK = 10_000
SIGMA = np.array([3e-4, 3e-4, 1e-4, 0.01, 0.012, 0.02])
DRIFT_PER_STEP = 0.02
"""Noise density of the surface's random walk, in units of ``SIGMA``."""


@dataclass(frozen=True)
class LongRun:
    """Result of a long run.

    Attributes:
        steps: number of updates.
        nees: mean squared Mahalanobis distance of the truth.
        worst_nees: largest of them.
        orthogonality: largest entry of R'R - I of the last mean.
        covariance: last covariance.
    """

    steps: int
    nees: float
    worst_nees: float
    orthogonality: float
    covariance: Array


def long_run(
    pose_filter: ContactFilter, steps: int, seed: int, progress: Callable[[int], None] = lambda done: None
) -> LongRun:
    """Feed a filter noisy observations of a slowly drifting surface, from a sensor all over its workspace.

    The sensor's poses are those of an arm, so only the filter's own state accumulates errors.
    """
    total, worst, state, k = 0.0, 0.0, None, 0
    for block in _blocks(seed, -(-steps // BLOCK)):
        for T_base_s, truth, observed in block:
            state = pose_filter.update(PoseGaussian(observed, _COVARIANCE), T_base_s, k * STEP_NS)
            nees = mahalanobis_squared(state.belief, truth)
            total += nees
            worst = max(worst, nees)
            k += 1
            if k == steps:
                break
        progress(k)
    assert state is not None
    R = state.belief.mean[:3, :3]
    return LongRun(k, total / k, worst, float(np.abs(R.T @ R - np.eye(3)).max()), state.belief.covariance)


_COVARIANCE = np.diag(SIGMA**2)


def _blocks(seed: int, blocks: int) -> Iterator[Iterator[tuple[Array, Array, Array]]]:
    rng = np.random.default_rng(seed)
    surface = np.zeros(6)
    for _ in range(blocks):
        T_base_s = se3.exp(rng.normal(0.0, [0.01] * 3 + [0.2] * 3, (BLOCK, 6)))
        walk = surface + np.cumsum(rng.normal(size=(BLOCK, 6)) * DRIFT_PER_STEP * SIGMA, axis=0)
        # Drawn back now and then, so that the surface stays within reach in any long run.
        surface = 0.5 * walk[-1]
        walk += np.linspace(0.0, 1.0, BLOCK)[:, None] * (surface - walk[-1])
        truth = se3.compose(se3.inverse(T_base_s), se3.exp(walk))
        observed = se3.compose(se3.exp(rng.normal(size=(BLOCK, 6)) * SIGMA), truth)
        yield zip(T_base_s, truth, observed, strict=True)


class ExactFilter:
    """The still-surface filter in mpmath with series for every function: independent of the formulas under test."""

    def __init__(self, noise_density: Array) -> None:
        self._noise_density = mpmath.matrix(noise_density.tolist())
        self.mean: Any = None
        self.covariance: Any = None
        self._T_base_s: Any = None
        self._t_ns = 0

    def update(self, mean: Array, covariance: Array, T_base_s: Array, t_ns: int) -> None:
        """Update as ``PoseFilter.update``; call within ``mpmath.workdps``."""
        T2, P2, T_b_s = (mpmath.matrix(array.tolist()) for array in (mean, covariance, T_base_s))
        if self.mean is None:
            self.mean, self.covariance = T2, P2
        else:
            U = T_b_s**-1 * self._T_base_s
            Ad = _adjoint(U)
            dt = mpmath.mpf(t_ns - self._t_ns) / 10**9
            T1, P1 = U * self.mean, Ad * self.covariance * Ad.T + self._noise_density * dt
            T, weights = T1, (P1**-1, P2**-1)
            for _ in range(40):
                A, b = mpmath.zeros(6), mpmath.zeros(6, 1)
                for origin, weight in zip((T1, T2), weights, strict=True):
                    e = _log(T * origin**-1)
                    J = _inverse_left_jacobian(e)
                    A += J.T * weight * J
                    b += J.T * weight * e
                step = mpmath.lu_solve(A, b)
                if mpmath.norm(step) < mpmath.mpf(10) ** -25:
                    break
                T = mpmath.expm(_hat(-step)) * T
            self.mean, self.covariance = T, A**-1
        self._T_base_s, self._t_ns = T_b_s, t_ns

    def distances(self, belief: PoseGaussian) -> tuple[float, float]:
        """Return the distance of a mean in this covariance's standard deviations, and a covariance's relative error."""
        e = _log(mpmath.matrix(belief.mean.tolist()) * self.mean**-1)
        root = mpmath.cholesky(self.covariance**-1)
        whitened = root.T * mpmath.matrix(belief.covariance.tolist()) * root
        return float(mpmath.norm(root.T * e)), float(max(abs(x) for x in whitened - mpmath.eye(6)))


def _cross(w: Any) -> Any:
    return mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def _hat(xi: Any) -> Any:
    M = mpmath.zeros(4)
    M[:3, :3] = _cross(xi[3:])
    for i in range(3):
        M[i, 3] = xi[i]
    return M


def _log(T: Any) -> Any:
    """Return Mercator's series of the matrix logarithm, for the small innovations of a filter."""
    X, power, total = T - mpmath.eye(4), mpmath.eye(4), mpmath.zeros(4)
    assert mpmath.norm(X) < 0.2
    for n in range(1, 50):
        power = power * X
        total += power * (mpmath.mpf((-1) ** (n + 1)) / n)
    return mpmath.matrix([total[0, 3], total[1, 3], total[2, 3], total[2, 1], total[0, 2], total[1, 0]])


def _adjoint(T: Any) -> Any:
    R = T[:3, :3]
    Ad = mpmath.zeros(6)
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[:3, 3:] = _cross(T[:3, 3]) * R
    return Ad


def _inverse_left_jacobian(xi: Any) -> Any:
    """Return the sum of Bernoulli numbers times powers of the small adjoint."""
    ad = mpmath.zeros(6)
    ad[:3, :3] = ad[3:, 3:] = _cross(xi[3:])
    ad[:3, 3:] = _cross(xi[:3])
    power, total = mpmath.eye(6), mpmath.zeros(6)
    for n in range(25):
        total += power * (mpmath.bernoulli(n) / mpmath.factorial(n))
        power = power * ad
    return total
