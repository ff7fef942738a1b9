"""Errors against mpmath over the whole grid and sweep: random twists never hit the points of cancellation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.se3_reference import Library, Reference, errors, points, reference
from tests.helpers.compiled import extension
from touchcell.geometry import _plain

LIMITS_EPS = {
    "exp R": 4.0,
    "exp t": 4.0,
    "exp small": 2.0,
    "round w": 4.0,
    "round v": 4.0,
    "log w": 4.0,
    "log v": 4.0,
    "J": 4.0,
    "J^-1": 4.0,
    "Ad": 1.0,
}


@pytest.fixture(scope="module")
def exact() -> Reference:
    return reference(points())


@pytest.mark.parametrize("batched", [True, False])
@pytest.mark.parametrize("backend", ["plain", "compiled"])
def test_errors_are_a_few_eps(exact: Reference, backend: str, batched: bool) -> None:
    kernels: Any = _plain if backend == "plain" else extension("touchcell.geometry._se3c")
    library = Library(
        backend,
        exp=kernels.exp,
        log=kernels.log,
        adjoint=kernels.adjoint,
        left_jacobian=kernels.left_jacobian,
        left_jacobian_inverse=kernels.left_jacobian_inverse,
        batched=batched,
    )
    found = errors(library, exact)
    assert found.keys() == LIMITS_EPS.keys()
    worst = {name: float(np.max(error)) / np.finfo(float).eps for name, error in found.items()}
    too_large = {name: error for name, error in worst.items() if not error <= LIMITS_EPS[name]}
    assert not too_large, f"in eps: {too_large}"


def test_the_error_measure_detects_a_fault(exact: Reference) -> None:
    def careless(xi: Any) -> Any:
        T = _plain.exp(xi)
        T[:, :3, 3] *= 1.0 + 1e-14
        return T

    assert np.max(errors(Library("careless", exp=careless), exact)["exp t"]) > 9e-15


def test_drift_of_a_long_chain_is_small_and_projectable() -> None:
    from touchcell.geometry import se3

    rng = np.random.default_rng(0)
    increments = se3.exp(1e-3 * rng.normal(size=(20000, 6)))
    T = np.eye(4)
    for increment in increments:
        T = se3.compose(T, increment)
    assert np.linalg.norm(T[:3, :3].T @ T[:3, :3] - np.eye(3)) < 1e-12
    R = se3.project(T)[:3, :3]
    assert np.linalg.norm(R.T @ R - np.eye(3)) < 1e-15
