"""touchcell.geometry.se3: conventions, laws, shapes, errors; both backends."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.compiled import extension
from touchcell.geometry import _plain, se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array

TWISTS = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)
IDENTITY = np.eye(4)


@pytest.fixture(params=["plain", "compiled"])
def kernels(request: pytest.FixtureRequest) -> Any:
    return _plain if request.param == "plain" else extension("touchcell.geometry._se3c")


def rotation_z(angle: float) -> Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0.0, 0.0], [sine, cosine, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def random_twists(count: int, seed: int = 3) -> Array:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return np.concatenate([rng.normal(size=(count, 3)), axis * rng.uniform(0.0, 3.1, size=(count, 1))], axis=1)


def test_exponential_is_linear_part_first(kernels: Any) -> None:
    assert np.array_equal(kernels.exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))[:3, 3], [1.0, 2.0, 3.0])
    quarter = kernels.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    assert np.allclose(quarter, rotation_z(np.pi / 2), atol=1e-15)


def test_exponential_is_a_screw_motion(kernels: Any) -> None:
    # A quarter turn about the vertical line through (1, 0): the origin goes to (1, -1).
    T = kernels.exp(np.pi / 2 * np.array([0.0, -1.0, 0.0, 0.0, 0.0, 1.0]))
    assert np.allclose(T[:3, 3], [1.0, -1.0, 0.0], atol=1e-15)


def test_compose_chains_frames(kernels: Any) -> None:
    T_a_b = kernels.exp(random_twists(1)[0])
    T_b_c = kernels.exp(random_twists(1, seed=4)[0])
    point_c = np.array([0.3, -0.2, 0.7, 1.0])
    assert np.allclose(kernels.compose(T_a_b, T_b_c) @ point_c, T_a_b @ (T_b_c @ point_c), atol=1e-15)


@given(xi=TWISTS)
def test_log_undoes_exp(xi: Array) -> None:
    assert np.allclose(se3.exp(se3.log(se3.exp(xi))), se3.exp(xi), atol=1e-14)


@given(xi=TWISTS)
def test_inverse_undoes(xi: Array) -> None:
    T = se3.exp(xi)
    assert np.allclose(se3.compose(T, se3.inverse(T)), IDENTITY, atol=1e-14)


@given(xi=TWISTS, other=TWISTS)
def test_adjoint_transforms_twists(xi: Array, other: Array) -> None:
    T = se3.exp(other)
    carried = se3.exp(se3.adjoint(T) @ xi)
    assert np.allclose(carried, T @ se3.exp(xi) @ se3.inverse(T), atol=1e-12)


@given(xi=TWISTS, direction=TWISTS)
def test_left_jacobian_is_the_derivative_of_exp(xi: Array, direction: Array) -> None:
    d = 1e-6 * direction
    moved = se3.exp(se3.left_jacobian(xi) @ d) @ se3.exp(xi)
    assert np.allclose(moved, se3.exp(xi + d), atol=5e-10)


@given(xi=TWISTS)
def test_jacobians_are_inverse(xi: Array) -> None:
    assert np.allclose(se3.left_jacobian(xi) @ se3.left_jacobian_inverse(xi), np.eye(6), atol=1e-12)


@pytest.mark.parametrize(
    "name", ["exp", "log", "compose", "inverse", "adjoint", "left_jacobian", "left_jacobian_inverse"]
)
def test_backends_agree(name: str) -> None:
    compiled = getattr(extension("touchcell.geometry._se3c"), name)
    plain = getattr(_plain, name)
    xi = random_twists(2000)
    T = _plain.exp(xi)
    arguments = {"exp": (xi,), "compose": (T, T[::-1].copy())}.get(name, (xi,) if "jacobian" in name else (T,))
    expected = compiled(*arguments)

    def distance_eps(found: Array) -> float:
        flat, exact = found.reshape(2000, -1), expected.reshape(2000, -1)
        ratio = np.linalg.norm(flat - exact, axis=1) / np.linalg.norm(exact, axis=1)
        return float(np.max(ratio)) / float(np.finfo(float).eps)

    assert distance_eps(np.array([compiled(*one) for one in zip(*arguments, strict=True)])) == 0.0
    assert distance_eps(np.array([plain(*one) for one in zip(*arguments, strict=True)])) <= 2.0
    # numpy's vectorised sin, cos and arctan2 differ from the C library's: one ulp more.
    assert distance_eps(plain(*arguments)) <= 3.0


@pytest.mark.parametrize("leading", [(), (1,), (5,), (0,), (2, 3), (2, 0, 3), (700,)])
def test_every_leading_shape(kernels: Any, leading: tuple[int, ...]) -> None:
    xi = random_twists(int(np.prod(leading, dtype=int))).reshape(*leading, 6)
    T = kernels.exp(xi)
    assert T.shape == (*leading, 4, 4)
    assert T.dtype == np.float64
    shapes = {"inverse": (4, 4), "adjoint": (6, 6), "log": (6,)}
    for name, core in shapes.items():
        assert getattr(kernels, name)(T).shape == (*leading, *core)
    for name in ("left_jacobian", "left_jacobian_inverse"):
        assert getattr(kernels, name)(xi).shape == (*leading, 6, 6)
    assert np.allclose(kernels.log(T), xi, atol=1e-12)
    assert np.allclose(kernels.compose(T, kernels.inverse(T)), IDENTITY, atol=1e-14)


@pytest.mark.parametrize(
    ("left", "right", "shape"),
    [((), (3,), (3,)), ((3,), (), (3,)), ((3, 1), (2,), (3, 2)), ((1,), (0,), (0,)), ((1,), (3,), (3,)), ((), (), ())],
)
def test_compose_broadcasts(
    kernels: Any, left: tuple[int, ...], right: tuple[int, ...], shape: tuple[int, ...]
) -> None:
    A = kernels.exp(np.resize(random_twists(6), (*left, 6)))
    B = kernels.exp(np.resize(random_twists(6, seed=5), (*right, 6)))
    product = kernels.compose(A, B)
    assert product.shape == (*shape, 4, 4)
    assert np.allclose(product, A @ B, atol=1e-14)


@pytest.mark.parametrize("make", [np.asfortranarray, lambda a: a[::2], lambda a: a.astype(">f8"), lambda a: a.tolist()])
def test_any_memory_layout(kernels: Any, make: Any) -> None:
    xi = random_twists(8)
    T = _plain.exp(xi)
    assert np.allclose(kernels.exp(make(xi)), _plain.exp(np.array(make(xi), dtype=float)), atol=1e-15)
    assert np.allclose(kernels.log(make(T)), _plain.log(np.array(make(T), dtype=float)), atol=1e-15)


def test_integers_and_float32_are_numbers(kernels: Any) -> None:
    assert np.array_equal(kernels.exp([1, 2, 3, 0, 0, 0])[:3, 3], [1.0, 2.0, 3.0])
    assert kernels.exp(np.zeros(6, dtype=np.float32)).dtype == np.float64


@pytest.mark.parametrize("axis", range(3))
def test_exact_half_turns(kernels: Any, axis: int) -> None:
    T = np.diag([-1.0, -1.0, -1.0, 1.0])
    T[axis, axis] = 1.0
    T[:3, 3] = [0.1, 0.2, 0.3]
    xi = kernels.log(T)
    assert np.isclose(np.linalg.norm(xi[3:]), np.pi, rtol=0.0, atol=1e-15)
    assert abs(xi[3 + axis]) == np.linalg.norm(xi[3:])
    assert np.allclose(kernels.exp(xi), T, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-310, 1e-200, 1e-150, 1e-100])
def test_tiny_rotations_are_kept(kernels: Any, size: float) -> None:
    xi = np.array([1.0, 2.0, 3.0, size, -size, 2.0 * size])
    T = kernels.exp(xi)
    assert T[2, 1] == size
    assert np.allclose(kernels.log(T), xi, rtol=1e-15, atol=0.0)
    assert np.isfinite(kernels.left_jacobian(xi)).all()
    assert np.isfinite(kernels.left_jacobian_inverse(xi)).all()


def test_rotations_rounded_to_float32_pass(kernels: Any) -> None:
    xi = random_twists(500)
    T = kernels.exp(xi).astype(np.float32).astype(np.float64)
    assert np.max(np.abs(kernels.log(T)[:, 3:] - xi[:, 3:])) < 1e-6
    assert np.max(np.abs(kernels.exp(kernels.log(T)) - T)) < 1e-6


def test_huge_components_stay_finite(kernels: Any) -> None:
    for xi in (
        np.full(6, 1e59),
        np.array([1e59, 0.0, 0.0, 0.0, 1e59, 1e-5]),
        np.array([1e59, 1.0, 1.0, 0.1, 0.2, 0.3]),
    ):
        for name in ("exp", "left_jacobian", "left_jacobian_inverse"):
            assert np.isfinite(getattr(kernels, name)(xi)).all(), name
    T = kernels.exp(np.array([1e59, 0.0, 0.0, 1.0, 2.0, 0.5]))
    for name in ("log", "adjoint", "inverse"):
        assert np.isfinite(getattr(kernels, name)(T)).all(), name


def mirrored() -> Array:
    return np.diag([1.0, 1.0, -1.0, 1.0])


def stretched() -> Array:
    return np.diag([1.0, 1.0, 1.0 + 1e-5, 1.0])


def with_entry(row: int, column: int, value: float) -> Array:
    T = np.eye(4)
    T[row, column] = value
    return T


BAD_NUMBERS = [
    *(None, "pose", ..., 1.0, [], [1.0, "a"], [[1.0], [1.0, 2.0]]),
    1j * np.ones(6),
    np.ones(6, dtype=bool),
]
BAD_TWISTS = [
    *BAD_NUMBERS,
    np.zeros(5),
    np.zeros((6, 5)),
    np.full(6, np.nan),
    [0, 0, 0, 0, 0, np.inf],
    np.full(6, 1e200),
]
BAD_POSES = [
    *BAD_NUMBERS,
    np.eye(3),
    np.zeros((4, 4)),
    1j * np.eye(4),
    np.eye(4).astype(object),
    mirrored(),
    stretched(),
    with_entry(0, 3, np.nan),
    with_entry(0, 0, np.nan),
    with_entry(1, 3, np.inf),
    with_entry(3, 0, 1e-3),
    with_entry(3, 3, 2.0),
    with_entry(3, 3, np.nan),
    with_entry(0, 1, 1e-3),
    np.stack([np.eye(4), np.eye(4), stretched()]),
]


@pytest.mark.parametrize("bad", BAD_TWISTS, ids=repr)
@pytest.mark.parametrize("name", ["exp", "left_jacobian", "left_jacobian_inverse"])
def test_refuses_invalid_twists(kernels: Any, name: str, bad: Any) -> None:
    with pytest.raises(GeometryError) as caught:
        getattr(kernels, name)(bad)
    assert (caught.value.function, caught.value.argument) == (name, "xi")


@pytest.mark.parametrize("bad", BAD_POSES, ids=repr)
@pytest.mark.parametrize("name", ["log", "inverse", "adjoint"])
def test_refuses_invalid_poses(kernels: Any, name: str, bad: Any) -> None:
    with pytest.raises(GeometryError) as caught:
        getattr(kernels, name)(bad)
    assert (caught.value.function, caught.value.argument) == (name, "T")


@pytest.mark.parametrize("bad", BAD_POSES, ids=repr)
def test_compose_names_the_bad_side(kernels: Any, bad: Any) -> None:
    for arguments, argument in (((bad, IDENTITY), "T_a_b"), ((IDENTITY, bad), "T_b_c")):
        with pytest.raises(GeometryError) as caught:
            kernels.compose(*arguments)
        assert (caught.value.function, caught.value.argument) == ("compose", argument)


def test_compose_refuses_shapes_that_do_not_broadcast(kernels: Any) -> None:
    with pytest.raises(GeometryError, match="broadcast"):
        kernels.compose(np.tile(IDENTITY, (2, 1, 1)), np.tile(IDENTITY, (3, 1, 1)))


@pytest.mark.parametrize("bad", [*BAD_TWISTS], ids=repr)
def test_euler_refuses(bad: Any) -> None:
    with pytest.raises(GeometryError) as caught:
        se3.from_euler_mm_deg(bad)
    assert caught.value.function == "from_euler_mm_deg"


def test_euler_is_extrinsic_xyz_in_mm_and_degrees() -> None:
    T = se3.from_euler_mm_deg([1000.0, -2.0, 0.5, 0.0, 0.0, 90.0])
    assert np.allclose(T[:3, 3], [1.0, -0.002, 0.0005], atol=1e-16)
    assert np.allclose(T[:3, :3], rotation_z(np.pi / 2)[:3, :3], atol=1e-16)
    alpha, beta, gamma = (
        se3.from_euler_mm_deg(row) for row in ([0] * 3 + [25, 0, 0], [0] * 4 + [-40, 0], [0] * 5 + [130])
    )
    assert np.allclose(se3.from_euler_mm_deg([0, 0, 0, 25, -40, 130]), gamma @ beta @ alpha, atol=1e-15)
    assert np.allclose(alpha, se3.exp([0, 0, 0, np.radians(25), 0, 0]), atol=1e-15)
    assert np.allclose(beta, se3.exp([0, 0, 0, 0, np.radians(-40), 0]), atol=1e-15)


@given(angles=st.tuples(st.floats(-179.0, 179.0), st.floats(-89.0, 89.0), st.floats(-179.0, 179.0)))
def test_euler_round_trips(angles: tuple[float, float, float]) -> None:
    pose = np.array([10.0, -20.0, 30.0, *angles])
    assert np.allclose(se3.to_euler_mm_deg(se3.from_euler_mm_deg(pose)), pose, atol=1e-10)


@given(
    alpha=st.floats(-180.0, 180.0),
    gamma=st.floats(-180.0, 180.0),
    beta=st.sampled_from([90.0, -90.0, 90.0 - 1e-7, -90.0 + 1e-12, 89.999]),
    rounded=st.booleans(),
)
def test_gimbal_lock_round_trips_as_a_pose(alpha: float, gamma: float, beta: float, rounded: bool) -> None:
    T = se3.from_euler_mm_deg([1.0, 2.0, 3.0, alpha, beta, gamma])
    if rounded:
        T = T.astype(np.float32).astype(np.float64)
    found = se3.to_euler_mm_deg(T)
    assert -90.0 <= found[4] <= 90.0
    assert np.allclose(se3.from_euler_mm_deg(found), T, atol=1e-6 if rounded else 1e-15)


def test_euler_of_a_perfect_lock_has_gamma_zero() -> None:
    T = np.array([[0.0, 0.6, 0.8, 0.0], [0.0, 0.8, -0.6, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    found = se3.to_euler_mm_deg(T)
    assert found[4] == 90.0
    assert found[5] == 0.0
    assert np.allclose(se3.from_euler_mm_deg(found), T, atol=1e-15)


def test_euler_of_the_identity_has_no_negative_zeros() -> None:
    assert not np.signbit(se3.to_euler_mm_deg(IDENTITY)).any()


def test_euler_is_the_same_in_both_backends() -> None:
    compiled = extension("touchcell.geometry._se3c")
    poses = np.random.default_rng(3).uniform(-170.0, 170.0, (500, 6)) * [1, 1, 1, 1, 0.5, 1]
    T = compiled.from_euler_mm_deg(poses)
    np.testing.assert_allclose(T, _plain.from_euler_mm_deg(poses), rtol=0.0, atol=4e-16)
    np.testing.assert_allclose(compiled.to_euler_mm_deg(T), _plain.to_euler_mm_deg(T), rtol=0.0, atol=2e-13)
    np.testing.assert_array_equal(compiled.to_euler_mm_deg(T[0]), compiled.to_euler_mm_deg(T)[0])


def test_euler_in_batches() -> None:
    poses = np.random.default_rng(1).uniform(-80.0, 80.0, size=(2, 3, 6))
    assert np.allclose(se3.to_euler_mm_deg(se3.from_euler_mm_deg(poses)), poses, atol=1e-11)
    assert se3.from_euler_mm_deg(np.zeros((0, 6))).shape == (0, 4, 4)
    assert se3.to_euler_mm_deg(np.zeros((0, 4, 4))).shape == (0, 6)


@given(xi=TWISTS, seed=st.integers(0, 100), size=st.sampled_from([1e-12, 1e-6, 1e-3, 0.05]))
def test_project_finds_the_nearest_rotation(xi: Array, seed: int, size: float) -> None:
    T = se3.exp(xi)
    T[:3, :3] += size * np.random.default_rng(seed).normal(size=(3, 3))
    found = se3.project(T)
    U, _, Vt = np.linalg.svd(T[:3, :3])
    assert np.allclose(found[:3, :3], U @ Vt, atol=5e-15)
    assert np.max(np.abs(found[:3, :3].T @ found[:3, :3] - np.eye(3))) < 1e-15
    assert np.array_equal(found[:3, 3], T[:3, 3])
    assert np.array_equal(found[3], [0.0, 0.0, 0.0, 1.0])


def test_project_in_batches_leaves_its_input_alone() -> None:
    T = se3.exp(random_twists(6)).reshape(2, 3, 4, 4)
    T[..., :3, :3] *= 1.01
    before = T.copy()
    found = se3.project(T)
    assert np.array_equal(T, before)
    assert np.allclose(found[..., :3, :3], T[..., :3, :3] / 1.01, atol=1e-15)
    assert se3.project(np.zeros((0, 4, 4))).shape == (0, 4, 4)


@pytest.mark.parametrize(
    "bad", [np.zeros((4, 4)), 2.0 * np.eye(4), mirrored(), with_entry(3, 0, 0.1), with_entry(0, 0, np.nan), np.eye(3)]
)
def test_project_refuses_matrices_far_from_a_pose(bad: Array) -> None:
    with pytest.raises(GeometryError) as caught:
        se3.project(bad)
    assert caught.value.function == "project"


def test_environment_selects_the_plain_kernels() -> None:
    code = "from touchcell.geometry import se3, gaussian; print(se3.BACKEND, gaussian._kernels.__name__)"
    environment = {**os.environ, "TOUCHCELL_PURE_PYTHON": "1"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["python", "touchcell.geometry._plain_gaussian"]
