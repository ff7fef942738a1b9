"""Kernels of ``touchcell.geometry.gaussian`` in numpy. Like the compiled ones, they return None for invalid input."""

from __future__ import annotations

import math
from operator import mul

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry import _check, se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array

SMALLEST_PIVOT = 32.0 * float(np.finfo(np.float64).eps)
"""Of a Cholesky factorisation, in units of the variance: below it, a covariance is numerically singular.

Conditions up to 1e14 pass, and scales of the axes however different. Where those make several pivots small at once,
another order of summation, such as LAPACK's, may still find none: so every kernel factorises as ``cholesky`` does.
"""

ASYMMETRY = 1e-6
"""Largest difference of S from its transpose, in units of the standard deviations, that counts as rounding."""

SMALLEST_VARIANCE = 1e-60
"""Squares of whitened residuals stay finite above this and below ``_check.LARGEST``."""

ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
"""Of a fusion: a step below this, in rad or relative to the translations, is the rounding of the poses themselves."""


def admit(mean: Array, covariance: Array) -> tuple[Array, Array] | None:
    """Return read-only copies of a clean pose and its covariance, made symmetric."""
    if not (_is(mean, (4, 4)) and _is(covariance, (6, 6))):
        return None
    try:
        T = _check.pose("PoseGaussian", "mean", mean).copy()
    except GeometryError:
        return None
    S = symmetric(covariance)
    if S is None or cholesky(S) is None:
        return None
    T.flags.writeable = S.flags.writeable = False
    return T, S


def predict(U: Array, T: Array, S: Array, Q: Array | None) -> tuple[Array, Array] | None:
    """Return U T and Ad(U) S Ad(U)' + Q."""
    if not _is(U, (4, 4)):
        return None
    try:
        Ad = se3.adjoint(U)
    except GeometryError:
        return None
    moved = Ad @ S @ Ad.T
    if Q is not None:
        noise = semidefinite(Q)
        if noise is None:
            return None
        moved += noise
    return se3.compose(U, T), moved


def fuse(
    T1: Array, S1: Array, T2: Array, S2: Array, tolerance: float, max_iterations: int
) -> tuple[Array, Array, int, float] | None:
    """Fuse two Gaussians by Gauss-Newton on whitened residuals.

    With S_i = C_i C_i', e_i = log(T T_i^-1) and G_i = J_l^-1(e_i), each step solves C_i^-1 (e_i + G_i x) = 0 in the
    least squares sense by QR, so no covariance is inverted and no normal equations are formed. A step counts as zero
    when it is below the tolerance, or below the rounding error of the poses in standard deviations, which is the larger
    of the two for standard deviations below 1e-9 rad.

    Returns:
        Mean, covariance, number of updates, and normalised innovation squared.
    """
    C1, C2 = cholesky(S1), cholesky(S2)
    if C1 is None or C2 is None:
        return None
    inverse1, inverse2 = se3.inverse(T1), se3.inverse(T2)
    T, nis = T1, 0.0
    scale = np.full(6, ROUNDING)
    scale[:3] *= max(np.abs(T1[:3, 3]).max(), np.abs(T2[:3, 3]).max())
    for iteration in range(max_iterations + 1):
        stack = np.concatenate([_whitened(T, inverse1, C1), _whitened(T, inverse2, C2)])
        triangle = np.asarray(np.linalg.qr(stack, mode="r"))
        R, y = triangle[:6, :6], triangle[:6, 6]
        if iteration == 0:
            # The residual that no x can reduce: e' (G P1 G' + P2)^-1 e, without forming the sum.
            nis = float(triangle[6, 6] ** 2)
        if y @ y < max(tolerance * tolerance, float(np.square(R * scale).sum())):
            root = np.linalg.inv(R)
            return T, root @ root.T, iteration, nis
        T = se3.compose(se3.exp(-np.linalg.solve(R, y)), T)
    return None


def cholesky(S: Array) -> Array | None:
    """Return the lower Cholesky factor of a symmetric matrix, or None if it is not safely positive definite.

    Computed on Python floats: for one 6x6 matrix that is faster than numpy's call and its checks.
    """
    rows: list[list[float]] = []
    for i, row in enumerate(S.tolist()):
        if not SMALLEST_VARIANCE <= row[i] <= _check.LARGEST:
            return None
        new: list[float] = []
        for j, done in enumerate(rows):
            new.append((row[j] - sum(map(mul, new, done))) / done[j])
        pivot = row[i] - sum(map(mul, new, new))
        if not pivot > SMALLEST_PIVOT * row[i]:
            return None
        rows.append([*new, math.sqrt(pivot), *[0.0] * (5 - i)])
    return np.array(rows)


def symmetric(S: Array) -> Array | None:
    """Return the mean of S and its transpose, or None if they differ by more than rounding or are not finite."""
    if not np.abs(S).max() <= _check.LARGEST:
        return None
    difference = np.abs(S - S.T)
    if difference.any():
        sigma = np.sqrt(np.abs(np.diagonal(S)))
        if (difference > ASYMMETRY * np.outer(sigma, sigma)).any():
            return None
    return np.asarray(0.5 * (S + S.T))


def semidefinite(Q: Array) -> Array | None:
    """Return Q made symmetric if it is positive semidefinite, else None.

    An axis without noise is a zero row and column.
    """
    if not _is(Q, (6, 6)):
        return None
    noise = symmetric(Q)
    if noise is None:
        return None
    variances = np.diagonal(noise)
    quiet = variances == 0.0
    if noise[quiet].any():
        return None
    # Adding a small diagonal makes a singular Q positive definite, but not an indefinite one.
    raised = noise.copy()
    raised.flat[::7] += np.where(quiet, 1.0, 1e-9 * variances)
    try:
        np.linalg.cholesky(raised)
    except np.linalg.LinAlgError:
        return None
    return noise


def _whitened(T: Array, inverse: Array, C: NDArray[np.floating]) -> Array:
    e = se3.log(se3.compose(T, inverse))
    return np.linalg.solve(C, np.concatenate([se3.left_jacobian_inverse(e), e[:, None]], axis=1))


def _is(array: Array, shape: tuple[int, ...]) -> bool:
    return type(array) is np.ndarray and array.dtype == np.float64 and array.shape == shape
