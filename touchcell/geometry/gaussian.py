"""Gaussians over poses, and the two steps of a filter on them: predict (``compound``) and correct (``fuse``).

A ``PoseGaussian`` perturbs its mean on the left, T = exp(e) mean with e ~ N(0, covariance), so e is [v, w] in metres
and radians along the axes of the frame in which the pose is given. Theory: Barfoot and Furgale, Associating
uncertainty with three-dimensional poses, T-RO 2014.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from touchcell.geometry import _check, _plain_gaussian, se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array, ArrayLike


class NotPositiveDefinite(GeometryError):
    """A covariance is not symmetric positive definite, or not finite.

    Attributes:
        function, argument: as in ``GeometryError``.
    """

    def __init__(self, function: str, argument: str, reason: str = "is not symmetric positive definite") -> None:
        super().__init__(function, argument, reason, hint="variances are in m^2 and rad^2, order [v, w]")


class NotConverged(GeometryError):
    """``fuse`` did not converge within its iteration limit.

    Attributes:
        iterations: number of updates made.
    """

    def __init__(self, iterations: int) -> None:
        super().__init__(
            "fuse",
            "observation",
            f"did not fuse with the prior in {iterations} iterations",
            hint="the two are half a turn apart, or max_iterations is small",
        )
        self.iterations = iterations


class _Kernels(Protocol):
    """Interface of both backends. They return None for invalid arguments."""

    def admit(self, mean: Array, covariance: Array, /) -> tuple[Array, Array] | None: ...
    def predict(self, U: Array, T: Array, S: Array, Q: Array | None, /) -> tuple[Array, Array] | None: ...
    def fuse(
        self, T1: Array, S1: Array, T2: Array, S2: Array, tolerance: float, max_iterations: int, /
    ) -> tuple[Array, Array, int, float] | None: ...


def _choose() -> _Kernels:
    if se3.BACKEND == "compiled":
        from touchcell.geometry import _se3c

        return _se3c
    return _plain_gaussian


_kernels = _choose()


@dataclass(frozen=True, slots=True, eq=False)
class PoseGaussian:
    """A pose and its uncertainty.

    Attributes:
        mean: (4, 4) pose, read-only.
        covariance: (6, 6) of e in T = exp(e) mean, [v, w], m and rad; read-only, exactly symmetric.

    Raises:
        GeometryError: the mean is not a pose, or a shape is wrong.
        NotPositiveDefinite: the covariance is not finite, asymmetric beyond rounding (1e-6 in units of the standard
            deviations), or singular to double precision.
    """

    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        clean = _kernels.admit(self.mean, self.covariance)
        if clean is None:
            mean = _single_pose("PoseGaussian", "mean", self.mean)
            clean = _kernels.admit(mean, _matrix("PoseGaussian", "covariance", self.covariance))
            if clean is None:
                raise NotPositiveDefinite("PoseGaussian", "covariance")
        object.__setattr__(self, "mean", clean[0])
        object.__setattr__(self, "covariance", clean[1])


@dataclass(frozen=True, slots=True)
class FusionRecord:
    """Diagnostics of a fusion.

    Attributes:
        iterations: updates made to the prior's mean.
        nis: normalised innovation squared, e' (P1' + P2)^-1 e with the innovation e between the two means and P1'
            the prior's covariance transported to it. Chi-squared with 6 degrees of freedom if the two are consistent.
    """

    iterations: int
    nis: float


def from_exponential(xi: ArrayLike, covariance_xi: ArrayLike) -> PoseGaussian:
    """Return the Gaussian over T = exp(xi + d), d ~ N(0, covariance_xi), to first order: covariance J_l(xi) S J_l(xi)'.

    Converts a network's output, exponential coordinates with a Gaussian over them, into a Gaussian over poses.

    Args:
        xi: (6,) [v, w], m and rad.
        covariance_xi: (6, 6).

    Raises:
        NotPositiveDefinite: the covariance is invalid, as for ``PoseGaussian``.
    """
    J = se3.left_jacobian(xi)
    if J.ndim != 2:
        raise GeometryError("from_exponential", "xi", f"has shape {np.shape(xi)}, not (6,)")
    clean = _kernels.admit(np.eye(4), _matrix("from_exponential", "covariance_xi", covariance_xi))
    if clean is None:
        raise NotPositiveDefinite("from_exponential", "covariance_xi")
    return PoseGaussian(se3.exp(xi), J @ clean[1] @ J.T)


def inverse(g: PoseGaussian) -> PoseGaussian:
    """Return the Gaussian over the inverse pose. Exact."""
    mean = se3.inverse(g.mean)
    Ad = se3.adjoint(mean)
    return PoseGaussian(mean, Ad @ g.covariance @ Ad.T)


def compound(T: ArrayLike, g: PoseGaussian, noise: ArrayLike | None = None, order: Literal[2, 4] = 2) -> PoseGaussian:
    """Return the Gaussian over exp(w) T g, w ~ N(0, noise), for a known pose T: the prediction step of a filter.

    Without noise both orders are exact. With it, the second order suffices below 0.1 rad of standard deviation.

    Args:
        T: (4, 4), the frame of ``g`` in the new frame.
        g: the prior.
        noise: (6, 6) positive semidefinite, [v, w], m and rad; zero rows and columns for axes without noise.
        order: 2, or 4 for Barfoot and Furgale's fourth-order terms.

    Raises:
        NotPositiveDefinite: the noise is not finite or not positive semidefinite.
    """
    if order not in (2, 4):
        raise GeometryError("compound", "order", f"is {order!r}, not 2 or 4")
    moved = _kernels.predict(T, g.mean, g.covariance, noise)
    if moved is None:
        T = _single_pose("compound", "T", T)
        noise = None if noise is None else _matrix("compound", "noise", noise)
        moved = _kernels.predict(T, g.mean, g.covariance, noise)
        if moved is None:
            raise NotPositiveDefinite("compound", "noise", "is not symmetric positive semidefinite")
    mean, covariance = moved
    if order == 4 and noise is not None:
        Q = np.asarray(noise, dtype=np.float64)
        covariance = covariance + _fourth_order(covariance - Q, Q)
    return PoseGaussian(mean, covariance)


def fuse(
    prior: PoseGaussian, observation: PoseGaussian, *, tolerance: float = 1e-6, max_iterations: int = 50
) -> tuple[PoseGaussian, FusionRecord]:
    """Return the product of two Gaussians over one pose: the correction step of a filter.

    Minimises the sum of squared Mahalanobis distances by Gauss-Newton from the prior's mean, on whitened residuals;
    the covariance is that of the linearisation at the final mean. To the tolerance, the inputs may be exchanged.

    Args:
        prior, observation: over the same pose, in the same frames.
        tolerance: stop when the next step is shorter than this, in standard deviations of the result, or than rounding.
        max_iterations: updates allowed. Filters take 2 to 7, means 3 rad apart 20.

    Raises:
        NotConverged: the step did not fall below the tolerance.
    """
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise GeometryError("fuse", "tolerance", f"is {tolerance!r}, not a positive number")
    fused = _kernels.fuse(
        prior.mean, prior.covariance, observation.mean, observation.covariance, tolerance, max_iterations
    )
    if fused is None:
        raise NotConverged(max_iterations)
    mean, covariance, iterations, nis = fused
    return PoseGaussian(mean, covariance), FusionRecord(iterations, nis)


def mahalanobis_squared(g: PoseGaussian, T: ArrayLike) -> float:
    """Return e' S^-1 e of a pose T = exp(e) mean. Chi-squared with 6 degrees of freedom for poses drawn from ``g``.

    Raises:
        GeometryError: ``T`` is not a pose.
        NotPositiveDefinite: the covariance is so close to singular that only the other backend accepts it.
    """
    e = se3.log(se3.compose(_single_pose("mahalanobis_squared", "T", T), se3.inverse(g.mean)))
    root = _plain_gaussian.cholesky(g.covariance)
    if root is None:
        raise NotPositiveDefinite("mahalanobis_squared", "g", "is singular to double precision")
    whitened = np.linalg.solve(root, e)
    return float(whitened @ whitened)


def _fourth_order(S: Array, Q: Array) -> Array:
    """Return the fourth-order terms to add to S + Q (Barfoot and Furgale 2014, section III)."""
    A_S, A_Q = _moment(S), _moment(Q)
    mixed = A_Q @ S + A_S @ Q
    Svv, Svw, Sww = S[:3, :3], S[:3, 3:], S[3:, 3:]
    Qvv, Qvw, Qww = Q[:3, :3], Q[:3, 3:], Q[3:, 3:]
    B_vv = _pair(Qww, Svv) + _pair(Qvw.T, Svw) + _pair(Qvw, Svw.T) + _pair(Qvv, Sww)
    B_vw = _pair(Qww, Svw.T) + _pair(Qvw.T, Sww)
    B = np.block([[B_vv, B_vw], [B_vw.T, _pair(Qww, Sww)]])
    return np.asarray((mixed + mixed.T) / 12.0 + B / 4.0)


def _moment(S: Array) -> Array:
    diagonal = _bracket(S[3:, 3:])
    return np.block([[diagonal, _bracket(S[:3, 3:] + S[3:, :3])], [np.zeros((3, 3)), diagonal]])


def _bracket(X: Array) -> Array:
    return np.asarray(X - np.trace(X) * np.eye(3))


def _pair(X: Array, Y: Array) -> Array:
    return _bracket(X) @ _bracket(Y) + _bracket(Y @ X)


def _single_pose(function: str, argument: str, value: ArrayLike) -> Array:
    T = _check.pose(function, argument, value)
    if T.shape != (4, 4):
        raise GeometryError(function, argument, f"has shape {T.shape}, not (4, 4)")
    return T


def _matrix(function: str, argument: str, value: ArrayLike) -> Array:
    """Return ``value`` as a (6, 6) float64 array, finite or not."""
    array = _check.real(function, argument, value, (6, 6))
    if array.shape != (6, 6):
        raise GeometryError(function, argument, f"has shape {array.shape}, not (6, 6)")
    return array
