"""Rigid motions: SE(3), its exponential coordinates, adjoint and Jacobians.

A pose ``T_a_b`` is a 4x4 matrix, the pose of frame b in frame a, so ``T_a_c = compose(T_a_b, T_b_c)``. Exponential
coordinates and twists are ``[v, w]``: linear first, metres and radians. Every function takes one element or any
leading batch shape, including an empty one, and returns new float64 arrays.

Input that is not numeric, not finite, of the wrong shape, or not a rotation where a pose is expected (to 1e-6, so that
rotations rounded to float32 pass) raises ``GeometryError`` with the function and the argument.

A C extension is used where it is built; the environment variable ``TOUCHCELL_PURE_PYTHON`` selects the plain
kernels instead, which use the same formulas. ``BACKEND`` names the one in use. Formulas: Barfoot, State Estimation for
Robotics (2nd ed. 2024), chapter 8, with the coefficients and the Jacobian blocks rewritten to avoid cancellation
(``touchcell/geometry/_plain.py``).
"""

from __future__ import annotations

from typing import Literal, Protocol, cast

import numpy as np

from touchcell import compiled
from touchcell.geometry import _check, _plain
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array, ArrayLike

__all__ = [
    "BACKEND",
    "adjoint",
    "compose",
    "exp",
    "from_euler_mm_deg",
    "inverse",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "project",
    "to_euler_mm_deg",
]


class _Kernels(Protocol):
    """Interface of both backends."""

    def exp(self, xi: ArrayLike, /) -> Array: ...
    def log(self, T: ArrayLike, /) -> Array: ...
    def compose(self, T_a_b: ArrayLike, T_b_c: ArrayLike, /) -> Array: ...
    def inverse(self, T: ArrayLike, /) -> Array: ...
    def adjoint(self, T: ArrayLike, /) -> Array: ...
    def from_euler_mm_deg(self, pose: ArrayLike, /) -> Array: ...
    def to_euler_mm_deg(self, T: ArrayLike, /) -> Array: ...
    def left_jacobian(self, xi: ArrayLike, /) -> Array: ...
    def left_jacobian_inverse(self, xi: ArrayLike, /) -> Array: ...


def _choose() -> tuple[_Kernels, Literal["compiled", "python"]]:
    found = compiled.unless_plain("touchcell.geometry._se3c")
    return (_plain, "python") if found is None else (cast(_Kernels, found), "compiled")


_kernels, BACKEND = _choose()

PROJECTABLE = 0.5
"""Largest Frobenius norm of R'R - I that ``project`` repairs; its iteration converges from all of these."""


def exp(xi: ArrayLike) -> Array:
    """Return the pose with the given exponential coordinates.

    Args:
        xi: (..., 6) [v, w], m and rad; any angle.

    Returns:
        (..., 4, 4), within 4 eps of the exact rotation and translation.
    """
    return _kernels.exp(xi)


def log(T: ArrayLike) -> Array:
    """Return the exponential coordinates of a pose, with a rotation angle in [0, pi].

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 6) [v, w], m and rad, accurate at every angle; at an exact half turn one of the two valid solutions.
    """
    return _kernels.log(T)


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """Return ``T_a_c``, the product of two poses, broadcast over leading shapes.

    Rounding drifts by 2e-13 in 1e6 products; ``project`` removes it.
    """
    return _kernels.compose(T_a_b, T_b_c)


def inverse(T_a_b: ArrayLike) -> Array:
    """Return ``T_b_a``, using the transpose of the rotation."""
    return _kernels.inverse(T_a_b)


def adjoint(T_a_b: ArrayLike) -> Array:
    """Return the (..., 6, 6) matrix that maps a twist in frame b, [v, w], to the same twist in frame a."""
    return _kernels.adjoint(T_a_b)


def left_jacobian(xi: ArrayLike) -> Array:
    """Return the left Jacobian J, (..., 6, 6): exp(xi + d) = exp(J d) exp(xi) to first order; the right one is J(-xi).

    Args:
        xi: (..., 6) [v, w], m and rad; any angle.
    """
    return _kernels.left_jacobian(xi)


def left_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the (..., 6, 6) inverse of ``left_jacobian``: log(exp(d) exp(xi)) = xi + J^-1 d to first order in d.

    Args:
        xi: (..., 6) [v, w], m and rad. Accurate for angles up to pi, as ``log`` returns them; singular at 2 pi.
    """
    return _kernels.left_jacobian_inverse(xi)


def from_euler_mm_deg(pose: ArrayLike) -> Array:
    """Return the pose given by mm and degrees: R = Rz(gamma) Ry(beta) Rx(alpha), extrinsic xyz.

    Args:
        pose: (..., 6) [x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg].

    Returns:
        (..., 4, 4), translation in metres.
    """
    return _kernels.from_euler_mm_deg(pose)


def to_euler_mm_deg(T: ArrayLike) -> Array:
    """Return (..., 6) [x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg] of a pose, beta in [-90, 90].

    At beta = +-90 deg (gimbal lock) only gamma -+ alpha is determined: gamma then follows the rounding residue in the
    first column of R (zero if there is none), and alpha, measured after rotating back by gamma, compensates for it. The
    pose round-trips everywhere.
    """
    return _kernels.to_euler_mm_deg(T)


def project(T: ArrayLike) -> Array:
    """Return the pose nearest to an almost rigid matrix, for instance after many products or from another program.

    The rotation becomes its orthogonal polar factor, the nearest rotation in the Frobenius norm, by the Newton-Schulz
    iteration R <- R (3 I - R'R)/2 (Higham, Functions of Matrices, 2008, section 8.3); the translation is kept.

    Args:
        T: (..., 4, 4) with ``|R'R - I| <= 0.5`` in the Frobenius norm, det R > 0, and last row [0, 0, 0, 1] to 1e-3.

    Raises:
        GeometryError: ``T`` is further from a pose than that.
    """
    nearest = np.array(_check.numbers("project", "T", T, (4, 4)))
    R = nearest[..., :3, :3]
    identity = np.eye(3)
    gram = np.swapaxes(R, -1, -2) @ R
    distance = np.linalg.norm(gram - identity, axis=(-2, -1))
    if np.any(distance > PROJECTABLE):
        raise GeometryError("project", "T", f"is far from a rotation: R'R is {np.max(distance):.1e} from I")
    if np.any(np.linalg.det(R) < 0.0):
        raise GeometryError("project", "T", "mirrors space: the determinant of R is negative")
    if np.any(np.abs(nearest[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) > 1e-3):
        raise GeometryError("project", "T", "is not a pose: its last row is not [0, 0, 0, 1]")
    # The distance e becomes at most 3/4 e^2 + 1/4 e^3, so seven steps take 0.5 to rounding.
    for _ in range(7):
        R = R @ (1.5 * identity - 0.5 * gram)
        gram = np.swapaxes(R, -1, -2) @ R
        if np.all(np.abs(gram - identity) <= 4.0 * np.finfo(np.float64).eps):
            break
    nearest[..., :3, :3] = R
    nearest[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return nearest
