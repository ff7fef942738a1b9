"""Exact SE(3) reference: closed forms of the textbooks in mpmath, with enough digits for their cancellation.

They are not the formulas under test: the Jacobian's upper right block is Barfoot's Q (State Estimation for Robotics,
2nd ed. 2024, chapter 8), that of its inverse -J^-1 Q J^-1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import mpmath
import numpy as np

from touchcell.geometry.types import Array

DIGITS = 150
ANGLES = (
    *(0.0, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 2.0, 3.0),
    *(np.pi - 1e-5, np.pi - 1e-8, np.pi),
)
DISTANCES = (1e-3, 1.0, 1e3)

Matrix: TypeAlias = Any
"""Nested lists or mpmath matrices of mpf."""


@dataclass(frozen=True)
class Exact:
    """Numbers to twice double precision: ``high + low``."""

    high: Array
    low: Array

    def error(self, value: Array, axes: tuple[int, ...], rows: slice, columns: slice = slice(None)) -> Array:
        """Return the norm-wise relative error of one block of ``value``."""
        block = (..., rows, columns) if len(axes) == 2 else (..., rows)
        difference = (value[block] - self.high[block]) - self.low[block]
        size = np.sqrt(np.sum(self.high[block] ** 2, axis=axes))
        distance = np.sqrt(np.sum(difference**2, axis=axes))
        missed = np.where(distance > 0.0, np.inf, 0.0)
        relative: Array = np.divide(distance, size, out=missed, where=size > 0.0)
        return relative


@dataclass(frozen=True)
class Reference:
    """Exponential coordinates and their exact results.

    Attributes:
        xi: (n, 6) [v, w].
        other: (n, 6) the other coordinates of the same pose, with rotation angle 2 pi - theta.
        T, J, J_inverse: of ``xi``.
        J_inverse_other: of ``other``.
        adjoint: of ``T`` rounded to double.
    """

    xi: Exact
    other: Exact
    T: Exact
    J: Exact
    J_inverse: Exact
    J_inverse_other: Exact
    adjoint: Exact


def points() -> Array:
    """Return (1035, 6): a grid of angles, distances and directions, and a dense sweep of angles from 1e-9 to pi."""
    rng = np.random.default_rng(7)
    axes = np.concatenate([np.eye(3), rng.normal(size=(9, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    directions = rng.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    grid = [
        np.concatenate([distance * direction, angle * axis])
        for angle in ANGLES
        for distance in DISTANCES
        for axis, direction in zip(axes, directions, strict=True)
    ]
    dense = np.concatenate([np.geomspace(1e-9, np.pi, 89), np.pi - np.geomspace(1e-9, 1.0, 40)])
    sweep = [
        np.concatenate([direction, angle * axis])
        for angle in dense
        for axis, direction in zip(axes[2:5], directions[2:5], strict=True)
    ]
    return np.array(grid + sweep)


def reference(xi: Array) -> Reference:
    """Evaluate everything exactly at each row of ``xi``, about 5 ms each."""
    with mpmath.workdps(DIGITS):
        rows = [_evaluate(row.tolist()) for row in xi]
        shapes = ((6,), (6,), (4, 4), *[(6, 6)] * 4)
        columns = zip(*rows, strict=True)
        return Reference(*(_split(column, shape) for column, shape in zip(columns, shapes, strict=True)))


def _split(values: Sequence[Sequence[Any]], shape: tuple[int, ...]) -> Exact:
    high = np.array([[float(entry) for entry in row] for row in values])
    low = np.array([[float(entry - float(entry)) for entry in row] for row in values])
    return Exact(high.reshape(-1, *shape), low.reshape(-1, *shape))


def _evaluate(xi: list[float]) -> tuple[list[Any], ...]:
    v, w = mpmath.matrix(xi[:3]), mpmath.matrix(xi[3:])
    W, V = _cross(w), _cross(v)
    theta = mpmath.norm(w)
    if theta == 0:
        R = J = mpmath.eye(3)
        inverse = other_inverse = _blocks(J, -V / 2)
        Q, other = V / 2, [mpmath.mpf("nan")] * 6
    else:
        R = mpmath.eye(3) + mpmath.sin(theta) / theta * W + (1 - mpmath.cos(theta)) / theta**2 * W * W
        J, Q = _jacobian(v, w)
        inverse = _inverse_jacobian(v, w)
        # The same pose by the complementary rotation.
        w_other = w * (1 - 2 * mpmath.pi / theta)
        v_other = mpmath.lu_solve(_jacobian(v, w_other)[0], J * v)
        other, other_inverse = [*v_other, *w_other], _inverse_jacobian(v_other, w_other)
    t = J * v
    rounded_R, rounded_t = R.apply(float), t.apply(float)
    rows = [*_rows(R, t), [0, 0, 0, 1]]
    return (
        xi,
        other,
        [entry for row in rows for entry in row],
        _blocks(J, Q),
        inverse,
        other_inverse,
        _blocks(rounded_R, _cross(rounded_t) * rounded_R),
    )


def _jacobian(v: Matrix, w: Matrix) -> tuple[Matrix, Matrix]:
    W, V, theta = _cross(w), _cross(v), mpmath.norm(w)
    sine, cosine = mpmath.sin(theta), mpmath.cos(theta)
    J = mpmath.eye(3) + (1 - cosine) / theta**2 * W + (theta - sine) / theta**3 * W * W
    Q = (
        V / 2
        + (theta - sine) / theta**3 * (W * V + V * W + W * V * W)
        + (theta**2 / 2 + cosine - 1) / theta**4 * (W * W * V + V * W * W - 3 * W * V * W)
        + (2 * theta - 3 * sine + theta * cosine) / (2 * theta**5) * (W * V * W * W + W * W * V * W)
    )
    return J, Q


def _inverse_jacobian(v: Matrix, w: Matrix) -> list[Any]:
    J, Q = _jacobian(v, w)
    inverse = J**-1
    return _blocks(inverse, -inverse * Q * inverse)


def _cross(v: Matrix) -> Matrix:
    return mpmath.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _rows(left: Matrix, right: Matrix) -> list[list[Any]]:
    return [[*left[i, :], *right[i, :]] for i in range(3)]


def _blocks(diagonal: Matrix, corner: Matrix) -> list[Any]:
    rows = _rows(diagonal, corner) + _rows(mpmath.zeros(3), diagonal)
    return [entry for row in rows for entry in row]


@dataclass(frozen=True)
class Library:
    """SE(3) functions of a library, in our order and conventions; None where it has none.

    Each function takes a batch, or one element where ``batched`` is False.
    """

    name: str
    exp: Callable[[Array], Array] | None = None
    log: Callable[[Array], Array] | None = None
    adjoint: Callable[[Array], Array] | None = None
    left_jacobian: Callable[[Array], Array] | None = None
    left_jacobian_inverse: Callable[[Array], Array] | None = None
    batched: bool = True

    def over(self, function: Callable[[Array], Array], values: Array) -> Array:
        """Apply one of the functions to every element."""
        return function(values) if self.batched else np.array([function(value) for value in values])


def errors(library: Library, exact: Reference) -> dict[str, Array]:
    """Return the relative error at every point, per block: the columns of the accuracy table.

    ``exp small`` is the antisymmetric part of R up to 1 rad: preservation of tiny rotations. ``round`` is
    log(exp(xi)). Of the two valid logarithms near a half turn the nearer one counts, and so for J^-1, which some
    libraries offer for a pose only.
    """
    found: dict[str, Array] = {}
    xi, T = exact.xi.high, exact.T.high
    first, last, matrix, vector = slice(0, 3), slice(3, None), (-2, -1), (-1,)

    def log_errors(name: str, value: Array) -> None:
        worst = [
            np.maximum(branch.error(value, vector, first), branch.error(value, vector, last))
            for branch in (exact.xi, exact.other)
        ]
        other_is_nearer = worst[1] < worst[0]
        for block, part in (("w", last), ("v", first)):
            one, two = (branch.error(value, vector, part) for branch in (exact.xi, exact.other))
            found[f"{name} {block}"] = np.where(other_is_nearer, two, one)

    if library.exp is not None:
        value = library.over(library.exp, xi)
        found["exp R"] = exact.T.error(value, matrix, first, first)
        found["exp t"] = exact.T.error(value, matrix, first, last)
        antisymmetric = Exact(*(part - np.swapaxes(part, -1, -2) for part in (exact.T.high, exact.T.low)))
        small = np.linalg.norm(xi[:, 3:], axis=1) <= 1.0
        found["exp small"] = np.where(
            small, antisymmetric.error(value - np.swapaxes(value, -1, -2), matrix, first, first), 0.0
        )
        if library.log is not None:
            log_errors("round", library.over(library.log, value))
    if library.log is not None:
        log_errors("log", library.over(library.log, T))

    def matrix_error(value: Array, part: Exact) -> Array:
        blocks = [part.error(value, matrix, first, columns) for columns in (first, last)]
        return np.maximum(*blocks)

    if library.left_jacobian is not None:
        found["J"] = matrix_error(library.over(library.left_jacobian, xi), exact.J)
    if library.left_jacobian_inverse is not None:
        value = library.over(library.left_jacobian_inverse, xi)
        found["J^-1"] = np.fmin(*(matrix_error(value, part) for part in (exact.J_inverse, exact.J_inverse_other)))
    if library.adjoint is not None:
        found["Ad"] = matrix_error(library.over(library.adjoint, T), exact.adjoint)
    return found
