"""Distances of capsules and boxes against MuJoCo's and against brute force; which pairs are checked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.coal_distance import box_body, capsule_body
from touchcell.control.interlocks.collision import (
    TOOL,
    Box,
    Capsule,
    Clearances,
    segment_box_distances,
    segment_distances,
)
from touchcell.geometry import se3

points = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


def brute_force(a0, a1, distance_to, steps=2001):
    along = np.linspace(0.0, 1.0, steps)[:, None]
    return float(np.min(distance_to(a0 + along * (a1 - a0))))


@given(a0=points, a1=points, b0=points, b1=points)
@settings(max_examples=100)
def test_segments_are_as_far_apart_as_brute_force_finds(a0, a1, b0, b1):
    def to_other(p):
        v = b1 - b0
        t = np.clip((p - b0) @ v / max(float(v @ v), 1e-300), 0.0, 1.0)
        return np.linalg.norm(p - b0 - t[:, None] * v, axis=1)

    exact = segment_distances(a0[None], a1[None], b0[None], b1[None])[0]
    found = brute_force(a0, a1, to_other)
    assert exact <= found + 1e-7
    assert found <= exact + np.linalg.norm(a1 - a0) / 2000 + 1e-7


@given(a0=points, a1=points, pose=st.lists(st.floats(-90, 90), min_size=6, max_size=6), half=points)
@settings(max_examples=100)
def test_a_segment_is_as_far_from_a_box_as_brute_force_finds(a0, a1, pose, half):
    T = se3.from_euler_mm_deg(np.array(pose) * [5, 5, 5, 1, 1, 1])
    half = 0.05 + 0.3 * np.abs(half)

    def to_box(p):
        local = (p - T[:3, 3]) @ T[:3, :3]
        return np.linalg.norm(local - np.clip(local, -half, half), axis=1)

    exact = segment_box_distances(a0[None], a1[None], T[None], half[None])[0]
    found = brute_force(a0, a1, to_box)
    assert exact <= found + 1e-9
    assert found <= exact + np.linalg.norm(a1 - a0) / 2000 + 1e-9


@pytest.mark.parametrize(
    ("a", "b", "distance"),
    [
        # Parallel and beside each other, one behind the other, points, crossing at 0.2 m.
        (((0, 0, 0), (1, 0, 0)), ((0.2, 0.3, 0), (0.7, 0.3, 0)), 0.3),
        (((0, 0, 0), (1, 0, 0)), ((1.5, 0, 0), (2, 0, 0)), 0.5),
        (((0, 0, 0), (0, 0, 0)), ((0, 0.4, 0), (0, 0.4, 0)), 0.4),
        (((0, 0, 0), (0, 0, 0)), ((-1, 0, 0.3), (1, 0, 0.3)), 0.3),
        (((-1, 0, 0), (1, 0, 0)), ((0, -1, 0.2), (0, 1, 0.2)), 0.2),
    ],
)
def test_special_places_of_two_segments(a, b, distance):
    ends = [np.array([end], dtype=float) for end in (*a, *b)]
    assert segment_distances(*ends)[0] == pytest.approx(distance, abs=1e-12)


def test_mujoco_agrees():
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(3)
    spec = mujoco.MjSpec()
    capsules, boxes = [], []
    for k in range(24):
        a, b = rng.uniform(-1.0, 1.0, (2, 3))
        b = a + 0.3 * (b - a)
        radius = float(rng.uniform(0.01, 0.06))
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, name=f"c{k}", size=[radius, 0, 0])
        geom.fromto = [*a, *b]
        capsules.append(Capsule(f"c{k}", (0, 0), (tuple(a), tuple(b)), radius))
    for k in range(8):
        T = se3.from_euler_mm_deg(rng.uniform(-1.0, 1.0, 6) * [1000, 1000, 1000, 180, 80, 180])
        half = rng.uniform(0.05, 0.3, 3)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, T[:3, :3].ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, name=f"b{k}", size=half, pos=T[:3, 3], quat=quat)
        boxes.append(Box(f"b{k}", T, half))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    arms = {"left": capsules[:12], "right": [Capsule(c.name, (1, 1), c.ends_m, c.radius_m) for c in capsules[12:]]}
    clearances = Clearances(arms, {"left": 2, "right": 2}, boxes)
    apart = clearances.distances(np.tile(np.eye(4), (4, 1, 1)))
    numbers = {model.geom(k).name: k for k in range(model.ngeom)}
    compared = 0
    for pair, distance in zip(clearances.pairs, apart, strict=True):
        judged = mujoco.mj_geomDistance(model, data, numbers[pair.part], numbers[pair.other], 10.0, None)
        if judged > 1e-3:
            compared += 1
            assert distance == pytest.approx(judged, abs=2e-6)
        else:
            assert distance < 2e-3
    # 12 x 12 of two arms; only the right one's capsules are on something that moves.
    assert len(clearances.pairs) == 144 + 12 * 8
    assert compared > 150


def scene(seed, *, degenerate=False):
    """Two arms of four capsules among three boxes, and where all four frames are."""
    rng = np.random.default_rng(seed)

    def capsule(frame):
        ends = rng.uniform(-0.4, 0.4, (2, 3))
        if degenerate:
            # Points, and segments along the axes of boxes.
            ends[1] = ends[0] + rng.choice([0.0, 0.0, 0.3], 3)
        return Capsule(f"part of {frame}", (0, frame), (tuple(ends[0]), tuple(ends[1])), float(rng.uniform(0.01, 0.06)))

    angles = 0.0 if degenerate else 80.0
    poses = se3.from_euler_mm_deg(rng.uniform(-1.0, 1.0, (7, 6)) * [600, 600, 600, angles, angles, angles])
    boxes = [Box(f"box {k}", poses[k], rng.uniform(0.05, 0.3, 3)) for k in range(3)]
    arms = {arm: [capsule(1) for _ in range(4)] for arm in ("left", "right")}
    return arms, boxes, poses[3:]


def clearances(monkeypatch, arms, boxes, *, pure):
    monkeypatch.setenv("TOUCHCELL_PURE_PYTHON", "1" if pure else "")
    return Clearances(arms, {"left": 2, "right": 2}, boxes)


@pytest.mark.parametrize("degenerate", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_compiled_and_plain_distances_are_the_same(seed, degenerate, monkeypatch):
    arms, boxes, frames = scene(seed, degenerate=degenerate)
    compiled, plain = (clearances(monkeypatch, arms, boxes, pure=pure).distances(frames) for pure in (False, True))
    assert len(compiled) == 16 + 24
    np.testing.assert_allclose(compiled, plain, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("pure", [False, True])
def test_a_frame_that_is_not_finite_gives_no_distance(pure, monkeypatch):
    arms, boxes, frames = scene(1)
    frames[1, 0, 3] = np.nan
    found = clearances(monkeypatch, arms, boxes, pure=pure)
    of_left = [pair.arm == "left" or pair.other_arm == "left" for pair in found.pairs]
    np.testing.assert_array_equal(np.isnan(found.distances(frames)), of_left)


@pytest.mark.parametrize("pure", [False, True])
def test_frames_of_another_number_of_links_are_an_error(pure, monkeypatch):
    arms, boxes, frames = scene(1)
    with pytest.raises(IndexError):
        clearances(monkeypatch, arms, boxes, pure=pure).distances(frames[:3])


@pytest.mark.parametrize("pure", [False, True])
def test_coal_agrees(pure, monkeypatch):
    coal = pytest.importorskip("coal")
    arms, boxes, frames = scene(2)
    found = clearances(monkeypatch, arms, boxes, pure=pure)
    first = {"left": 0, "right": 2}
    parts = [(arm, capsule_body(part, frames[first[arm] :])) for arm, parts in arms.items() for part in parts]
    pairs = [(parts[i][1], parts[j][1]) for i in range(8) for j in range(i) if parts[i][0] != parts[j][0]]
    pairs += [(part, box_body(box)) for _, part in parts for box in boxes]
    asked, answer = coal.DistanceRequest(), coal.DistanceResult()
    judged = []
    for one, other in pairs:
        answer.clear()
        judged.append(coal.distance(*one, *other, asked, answer))
    apart = found.distances(frames)
    # Where they overlap, coal tells how deep, and ours how deep at most a radius.
    outside = np.array(judged) > 0.0
    assert outside.sum() > 15
    np.testing.assert_allclose(apart[outside], np.array(judged)[outside], rtol=0.0, atol=1e-9)
    assert (apart[~outside] <= 0.0).all()


def test_neighbouring_links_and_static_pairs_are_left_out():
    def link(k):
        return Capsule(f"link {k}", (k, k), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)), 0.05)

    table = Box("table", np.eye(4), np.ones(3))
    bodies = {"arm": [link(0), link(1), link(2), link(3), link(TOOL)]}
    found = Clearances(bodies, {"arm": 5}, [table])
    names = {(pair.part, pair.other) for pair in found.pairs}
    assert names == {
        ("link -1", "link 0"),
        ("link 1", "table"),
        ("link 2", "table"),
        ("link 3", "table"),
        ("link -1", "table"),
    }


def test_no_pairs_give_no_distances():
    nothing = Clearances({"arm": []}, {"arm": 2}, [])
    assert nothing.pairs == ()
    assert nothing.distances(np.tile(np.eye(4), (2, 1, 1))).shape == (0,)


@pytest.mark.parametrize(
    ("first", "second", "apart"),
    [
        ((1, 3), (6, 8), False),
        ((1, 2), (6, 8), True),
        ((3, 1), (8, 6), False),
        ((2, 1), (8, 6), True),
        ((1, 8), (4, 4), False),
    ],
)
def test_parts_of_one_arm_are_compared_where_their_nearest_links_are_four_apart(
    first: tuple[int, int], second: tuple[int, int], apart: bool
) -> None:
    ends = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1))
    for frames in ((first, second), (second, first)):
        parts = [Capsule(name, each, ends, 0.05) for name, each in zip("ab", frames, strict=True)]
        assert bool(Clearances({"arm": parts}, {"arm": 10}, []).pairs) == apart
