"""Validate arguments: turn what a caller passed into a clean array, or raise. Both backends validate through here."""

from __future__ import annotations

from typing import Any

import numpy as np

from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array, ArrayLike

ROTATION_TOLERANCE = 1e-6
"""Largest entry of R'R - I that still counts as a rotation; a rotation rounded to float32 is at 2e-7."""

LARGEST = 1e60
"""Largest magnitude of a component. The kernels multiply up to four components, which then cannot overflow."""


def real(function: str, argument: str, value: ArrayLike, core: tuple[int, ...]) -> Array:
    """Return ``value`` as a C-contiguous float64 array of shape (..., *core), finite or not.

    Raises:
        GeometryError: it is not real numbers, or has another shape.
    """
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise GeometryError(function, argument, f"is not an array: {error}") from error
    if array.dtype.kind not in "fiu":
        raise GeometryError(function, argument, f"has dtype {array.dtype}, not real numbers")
    if array.shape[-len(core) :] != core:
        expected = ", ".join(["...", *map(str, core)])
        raise GeometryError(function, argument, f"has shape {array.shape}, not ({expected})")
    return np.ascontiguousarray(array, dtype=np.float64)


def numbers(function: str, argument: str, value: ArrayLike, core: tuple[int, ...]) -> Array:
    """Return ``value`` as ``real`` does.

    Raises:
        GeometryError: as ``real``, or it is not finite.
    """
    array = real(function, argument, value, core)
    if array.size and not (np.abs(array).max() <= LARGEST):
        raise GeometryError(function, argument, f"is not finite, or larger than {LARGEST:g}")
    return array


def twist(function: str, argument: str, value: ArrayLike) -> Array:
    """Return ``value`` as exponential coordinates or twists, (..., 6).

    Raises:
        GeometryError: as ``numbers``.
    """
    return numbers(function, argument, value, (6,))


def pose(function: str, argument: str, value: ArrayLike) -> Array:
    """Return ``value`` as poses, (..., 4, 4), whose rotation blocks are orthonormal to ``ROTATION_TOLERANCE``.

    Raises:
        GeometryError: as ``real``, or it is not a rigid transform.
    """
    T = numbers(function, argument, value, (4, 4))
    # Python's own floats are ten times faster than numpy on a single pose, and the same expressions serve both.
    entries: Any = T.ravel().tolist() if T.ndim == 2 else T.reshape(-1, 16).T.copy()
    r00, r01, r02, _, r10, r11, r12, _, r20, r21, r22, _, *bottom = entries
    defects = (
        r00 * r00 + r10 * r10 + r20 * r20 - 1.0,
        r01 * r01 + r11 * r11 + r21 * r21 - 1.0,
        r02 * r02 + r12 * r12 + r22 * r22 - 1.0,
        r00 * r01 + r10 * r11 + r20 * r21,
        r00 * r02 + r10 * r12 + r20 * r22,
        r01 * r02 + r11 * r12 + r21 * r22,
    )
    worst = max(map(abs, defects)) if T.ndim == 2 else np.max(np.abs(defects), initial=0.0)
    if worst > ROTATION_TOLERANCE:
        raise GeometryError(
            function, argument, f"is not a rotation: R'R is {worst:.1e} from I", hint="se3.project repairs small errors"
        )
    determinant = r00 * (r11 * r22 - r12 * r21) - r01 * (r10 * r22 - r12 * r20) + r02 * (r10 * r21 - r11 * r20)
    if np.any(determinant < 0.0):
        raise GeometryError(function, argument, "mirrors space: the determinant of R is -1")
    if np.max(np.abs(np.asarray(bottom).T - (0.0, 0.0, 0.0, 1.0)), initial=0.0) > ROTATION_TOLERANCE:
        raise GeometryError(function, argument, "is not a pose: its last row is not [0, 0, 0, 1]")
    return T


def pose_pair(function: str, left: str, a: ArrayLike, right: str, b: ArrayLike) -> tuple[Array, Array]:
    """Return two pose arrays of one shape, broadcast against each other.

    Raises:
        GeometryError: as ``pose``, or the leading shapes do not broadcast.
    """
    A, B = pose(function, left, a), pose(function, right, b)
    try:
        shape = np.broadcast_shapes(A.shape, B.shape)
    except ValueError as error:
        raise GeometryError(function, right, f"has shape {B.shape}, which does not broadcast with {A.shape}") from error
    return np.ascontiguousarray(np.broadcast_to(A, shape)), np.ascontiguousarray(np.broadcast_to(B, shape))
