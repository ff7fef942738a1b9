"""Alternatives to the filter: other corrections of a Gaussian by a Gaussian, and corrections robust to slip.

They performed worse than the product's; docs/decisions/0007-filter.md has the figures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import PoseFilter
from touchcell.perception.runtime.filter_spec import FilterState


def gauss_newton(prior: PoseGaussian, observation: PoseGaussian) -> PoseGaussian:
    """The product's iteration in numpy, for a comparison of run times."""
    roots = [np.linalg.inv(np.linalg.cholesky(g.covariance)) for g in (prior, observation)]
    inverses = [se3.inverse(g.mean) for g in (prior, observation)]
    T = prior.mean
    for _ in range(50):
        A, b = np.zeros((6, 6)), np.zeros(6)
        for root, inverse in zip(roots, inverses, strict=True):
            e = se3.log(se3.compose(T, inverse))
            M = root @ se3.left_jacobian_inverse(e)
            A += M.T @ M
            b += M.T @ (root @ e)
        step = np.linalg.solve(A, b)
        if b @ step < 1e-12:
            break
        T = se3.compose(se3.exp(-step), T)
    return PoseGaussian(T, np.asarray(np.linalg.inv(A), dtype=np.float64))


def extended_kalman(prior: PoseGaussian, observation: PoseGaussian) -> PoseGaussian:
    """Linearise once at the prior, in gain form: the first step of Gauss-Newton."""
    e = se3.log(se3.compose(prior.mean, se3.inverse(observation.mean)))
    H = se3.left_jacobian_inverse(e)
    PH = prior.covariance @ H.T
    K = np.linalg.solve(H @ PH + observation.covariance, PH.T).T
    I_KH = np.eye(6) - K @ H
    covariance = I_KH @ prior.covariance @ I_KH.T + K @ observation.covariance @ K.T
    return PoseGaussian(se3.compose(se3.exp(-K @ e), prior.mean), 0.5 * (covariance + covariance.T))


def naive(prior: PoseGaussian, observation: PoseGaussian) -> PoseGaussian:
    """Treat exponential coordinates of the innovation as a vector: every Jacobian the identity."""
    e = se3.log(se3.compose(observation.mean, se3.inverse(prior.mean)))
    K = np.linalg.solve(prior.covariance + observation.covariance, prior.covariance).T
    covariance = (np.eye(6) - K) @ prior.covariance
    return PoseGaussian(se3.compose(se3.exp(K @ e), prior.mean), 0.5 * (covariance + covariance.T))


class StudentFilter(PoseFilter):
    """A filter that trusts a surprising frame less: its covariance grows as under a Student-t of ``degrees``."""

    degrees = 4.0

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        if self.state is None:
            return super().update(observation, T_base_sensor, t_ns)
        nis = gaussian.fuse(self.predict(T_base_sensor, t_ns), observation)[1].nis
        grown = observation.covariance * ((self.degrees + nis) / (self.degrees + 6.0))
        weighted = PoseGaussian(observation.mean, grown if nis > 6.0 else observation.covariance)
        return replace(super().update(weighted, T_base_sensor, t_ns), nis=nis)


class SlipFilter(PoseFilter):
    """A filter that detects slip: if the innovation exceeds ``threshold``, the prior's covariance is inflated.

    It grows by as much as makes the frame likely again.
    """

    threshold = 22.46
    """Threshold of the normalised innovation squared: 99.9 % of consistent frames are below."""

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        prior = super().predict(T_base_sensor, t_ns)
        return PoseGaussian(prior.mean, prior.covariance * self._growth)

    _growth = 1.0

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        if self.state is None:
            return super().update(observation, T_base_sensor, t_ns)
        nis = gaussian.fuse(self.predict(T_base_sensor, t_ns), observation)[1].nis
        if nis <= self.threshold:
            return super().update(observation, T_base_sensor, t_ns)
        self._growth = nis / 6.0
        try:
            return super().update(observation, T_base_sensor, t_ns)
        finally:
            self._growth = 1.0
