"""Poses of a cell in which something is too near, and in which nothing is, for the proof of the clearance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import starmap

import numpy as np
import pytest

from touchcell.cell.config.planning_scene import link_capsules
from touchcell.control.interlocks.clearance import Clearance, ClearanceConfig, _Places, _Posed, _random_pose, _search
from touchcell.control.interlocks.collision import BASE, TOOL, Box, Capsule, Clearances
from touchcell.control.interlocks.coverage import ArmFacts, CannotTrip, CellFacts, Change, Fault
from touchcell.control.interlocks.planning_scene import Body, PlanningScene
from touchcell.control.proof import prove
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain
from touchcell.geometry import se3

FINGER = Capsule("finger", (TOOL, TOOL), ((0.0, 0.0, 0.0), (0.0, 0.0, -0.1)), 0.02)
FACING = {
    "left": Body(np.eye(4), [FINGER]),
    "right": Body(se3.from_euler_mm_deg(np.array([1000.0, 0, 0, 0, 0, 180])), [FINGER]),
}
TABLE = Box("table", se3.from_euler_mm_deg(np.array([300.0, 0, -500.0, 0, 0, 0])), np.array([2.0, 2.0, 0.5]))
POST = Box("post", se3.from_euler_mm_deg(np.array([300.0, 0, 200.0, 0, 0, 0])), np.array([0.01, 0.01, 0.01]))


def facts_of(
    bodies: Mapping[str, Body], boxes: Sequence[Box] = (), reach_m: float = 0.9, arms: Sequence[str] = ()
) -> CellFacts:
    return CellFacts(
        0.01, (), {role: ArmFacts(None, reach_m) for role in (*bodies, *arms)}, {}, PlanningScene({}, bodies, boxes)
    )


def clearances_of(facts: CellFacts) -> Clearances:
    bodies = facts.scene.bodies
    counts = {role: body.link_count + 2 for role, body in bodies.items()}
    return Clearances({role: body.capsules for role, body in bodies.items()}, counts, facts.scene.boxes)


def distances(facts: CellFacts, change: Change) -> np.ndarray:
    view = change(facts.healthy(0, ""), 0.0)
    frames = [body.frames(view.arms[role]) for role, body in facts.scene.bodies.items()]
    return clearances_of(facts).distances(np.concatenate(frames))


def test_both_arms_are_shown_too_near_and_then_clear() -> None:
    facts = facts_of(FACING)
    near, apart = _search(clearances_of(facts), facts, 0.02, 0.06)
    assert near.keys() == {"left", "right"}
    for change in near.values():
        assert distances(facts, change).min() < 0.02
    assert distances(facts, apart).min() > 0.06


def test_only_the_arm_that_reaches_an_obstacle_is_shown_near_it() -> None:
    # The right arm stands 5 m away: it reaches neither the table nor the left arm.
    away = {**FACING, "right": Body(se3.from_euler_mm_deg(np.array([5000.0, 0, 0, 0, 0, 180])), [FINGER])}
    facts = facts_of(away, [POST])
    near, apart = _search(clearances_of(facts), facts, 0.02, 0.06)
    assert near.keys() == {"left"}
    assert distances(facts, near["left"]).min() < 0.02
    assert distances(facts, apart).min() > 0.06
    settings = ClearanceConfig(kind="clearance", limit_mm=20, slow_mm=60)
    left, right = settings.faults(facts)
    assert isinstance(left, Fault)
    assert isinstance(right, CannotTrip)
    assert (left.subject, right.subject) == ("left", "right")
    assert right.reason == "in none of 300 poses anything of it is nearer than 20 mm to anything"


def test_where_nothing_is_ever_clear_the_widest_of_all_poses_is_taken() -> None:
    facts = facts_of(FACING)
    near, apart = _search(clearances_of(facts), facts, 0.02, 100.0)
    assert near.keys() == {"left", "right"}
    # Two cubes of 1.8 m whose middles are 1 m apart: most poses are far nearer than this.
    assert distances(facts, apart).min() > 2.2


def test_the_first_pose_that_is_clear_is_kept() -> None:
    # The right arm is never near anything, so that all poses are tried.
    away = {**FACING, "right": Body(se3.from_euler_mm_deg(np.array([4000.0, 0, 0, 0, 0, 180])), [FINGER])}
    facts = facts_of(away)
    near, apart = _search(clearances_of(facts), facts, 0.02, 1e-6)
    assert not near
    first = _Posed(dict(starmap(lambda role, T: (role, (T, None)), first_poses(facts))))
    np.testing.assert_allclose(distances(facts, apart), distances(facts, first))


def first_poses(facts: CellFacts) -> list[tuple[str, np.ndarray]]:
    rng, places = np.random.default_rng(0), _Places(facts)
    return [(role, _random_pose(role, facts, places, 0, rng)[0]) for role in facts.scene.bodies]


def middle_of_finger(facts: CellFacts, role: str, number: int, seed: int = 0) -> np.ndarray:
    """Where the middle of an arm's finger is in the world, m."""
    T_base_tcp, q = _random_pose(role, facts, _Places(facts), number, np.random.default_rng(seed))
    assert q is None
    np.testing.assert_allclose(T_base_tcp[:3, :3] @ T_base_tcp[:3, :3].T, np.eye(3), atol=1e-12)
    T = facts.scene.bodies[role].T_world_base @ T_base_tcp
    middle: np.ndarray = T[:3, :3] @ [0.0, 0.0, -0.05] + T[:3, 3]
    return middle


def test_every_other_pose_has_the_tool_at_one_thing_after_the_other() -> None:
    facts = facts_of(FACING, [POST, TABLE], reach_m=1.2)
    # The post's nearest corner, the table's top, the middle between the arms, both bases; and round again.
    corner = [0.29, 0.0, 0.19]
    for number, place in ((0, corner), (4, [0.5, 0, 0]), (6, [0, 0, 0]), (8, [1, 0, 0]), (10, corner)):
        np.testing.assert_allclose(middle_of_finger(facts, "left", number), place, atol=1e-12)
    np.testing.assert_allclose(middle_of_finger(facts, "right", 0), [0.31, 0.0, 0.19], atol=1e-12)
    np.testing.assert_allclose(middle_of_finger(facts, "right", 2), [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(middle_of_finger(facts, "right", 4), [0.5, 0.0, 0.0], atol=1e-12)


def test_a_box_that_is_turned_is_met_where_it_is_nearest() -> None:
    # A bar of 2 m along a diagonal: its middle is out of reach, its side is not.
    T = se3.from_euler_mm_deg(np.array([800.0, 0, 0, 0, 0, 45]))
    facts = facts_of({"left": FACING["left"]}, [Box("bar", T, np.array([1.0, 0.01, 0.01]))], reach_m=0.9)
    side = 0.8 / np.sqrt(2.0) - 0.01
    np.testing.assert_allclose(
        middle_of_finger(facts, "left", 0), [side / np.sqrt(2.0), -side / np.sqrt(2.0), 0.0], atol=1e-9
    )


def test_arms_of_different_reach_meet_nearer_to_the_shorter() -> None:
    arms = {"left": ArmFacts(None, 0.9), "right": ArmFacts(None, 0.3)}
    facts = CellFacts(0.01, (), arms, {}, PlanningScene({}, FACING))
    for role in FACING:
        at = [middle_of_finger(facts, role, 0, seed) for seed in range(8)]
        # The tool itself may be out of reach: then it is anywhere.
        assert any(np.allclose(each, [0.75, 0.0, 0.0]) for each in at), role


FAR = Capsule("far", (TOOL, TOOL), ((0.1, 0.0, 0.2), (0.1, 0.0, 0.4)), 0.02)
UPPER_ARM = Capsule("arm", (BASE, TOOL), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 0.02)


@pytest.mark.parametrize(
    ("parts", "number", "part", "place"),
    [
        ([FINGER, FAR, UPPER_ARM], 0, [0.0, 0.0, -0.05], [0.29, 0.0, 0.19]),
        ([FINGER, FAR, UPPER_ARM], 2, [0.1, 0.0, 0.3], [0.0, 0.0, 0.0]),
        ([FINGER, FAR, UPPER_ARM], 4, [0.0, 0.0, -0.05], [0.29, 0.0, 0.19]),
        ([UPPER_ARM], 0, [0.0, 0.0, 0.0], [0.29, 0.0, 0.19]),
    ],
)
def test_every_part_of_a_tool_is_brought_to_what_it_may_meet(
    parts: list[Capsule], number: int, part: list[float], place: list[float]
) -> None:
    facts = facts_of({"left": Body(np.eye(4), parts)}, [POST])
    T, _ = _random_pose("left", facts, _Places(facts), number, np.random.default_rng(0))
    np.testing.assert_allclose(T[:3, :3] @ part + T[:3, 3], place, atol=1e-12)


@pytest.mark.parametrize(("reach_m", "is_there"), [(0.501, True), (0.499, False)])
def test_what_is_out_of_reach_is_not_gone_to(reach_m: float, is_there: bool) -> None:
    dot = Capsule("dot", (TOOL, TOOL), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 0.02)
    box = Box("box", se3.from_euler_mm_deg(np.array([310.0, 410.0, 0, 0, 0, 0])), np.full(3, 0.01))
    facts = facts_of({"left": Body(np.eye(4), [dot])}, [box], reach_m=reach_m)
    T_base_tcp, _ = _random_pose("left", facts, _Places(facts), 0, np.random.default_rng(0))
    assert np.allclose(T_base_tcp[:3, 3], [0.3, 0.4, 0.0]) == is_there
    assert (np.abs(T_base_tcp[:3, 3]) <= reach_m).all()


def test_the_others_are_anywhere_within_reach_turned_anyhow() -> None:
    facts = facts_of({"left": FACING["left"]}, reach_m=0.9)
    rng = np.random.default_rng(1)
    poses = np.array([_random_pose("left", facts, _Places(facts), 2 * k + 1, rng)[0] for k in range(50)])
    at, up = poses[:, :3, 3], poses[:, :3, 2]
    assert (np.abs(at) <= 0.9).all()
    for found, wide in ((at, 0.6), (up, 0.8)):
        assert (found.min(axis=0) < -wide).all()
        assert (found.max(axis=0) > wide).all()


@pytest.mark.parametrize("seed", range(4))
def test_arms_without_joints_are_shown_near_whatever_they_reach(seed: int) -> None:
    chance = np.random.default_rng(seed)
    base = se3.from_euler_mm_deg(np.array([*chance.uniform(-800, 800, 3), *chance.uniform(-80, 80, 3)]))
    aside = chance.normal(size=3)
    aside *= 0.8 / np.linalg.norm(aside)
    other, post = base.copy(), base.copy()
    other[:3, 3] += 1.9 * aside
    post[:3, 3] += aside
    rail = post.copy()
    rail[:3, 3] += 1.5 * rail[:3, 0]
    fingers = {"left": Body(base, [FINGER]), "right": Body(other, [FINGER])}
    gripper = Capsule("gripper", (TOOL, TOOL), ((0.0, 0.0, 0.1), (0.0, 0.0, 0.2)), 0.02)
    for bodies, boxes in (
        (fingers, ()),
        ({"left": Body(base, [gripper])}, (Box("post", post, np.full(3, 0.01)),)),
        ({"left": Body(base, [FINGER])}, (Box("rail", rail, np.array([2.0, 0.01, 0.01])),)),
    ):
        facts = facts_of(bodies, boxes, reach_m=1.0)
        near, _ = _search(clearances_of(facts), facts, 0.02, 0.06)
        assert near.keys() == bodies.keys()


def test_an_arm_with_joints_is_shown_at_angles_within_their_limits() -> None:
    chain = SerialChain(ChainDescription.shipped("generic_6r"))
    ik = DifferentialIk(chain)
    facts = facts_of({"arm": Body(np.eye(4), link_capsules(chain.description), lambda: ik, 6)}, [TABLE])
    near, apart = _search(clearances_of(facts), facts, 0.02, 0.03)
    for change in (near["arm"], apart):
        arm = change(facts.healthy(0, ""), 0.0).arms["arm"]
        assert arm.joints is not None
        q = arm.joints.value.q
        assert ((chain.lower <= q) & (q <= chain.upper)).all()
        assert np.ptp(q) > 0.1
        np.testing.assert_array_equal(arm.joints.value.dq, np.zeros(6))
        np.testing.assert_allclose(arm.state.value.T_base_tcp, chain.forward(q), atol=1e-12)
    assert distances(facts, near["arm"]).min() < 0.02
    assert distances(facts, apart).min() > 0.03


def test_a_clearance_is_proven_for_each_arm_that_has_a_shape() -> None:
    facts = facts_of(FACING, [TABLE], arms=["bare"])
    settings = ClearanceConfig(kind="clearance", limit_mm=20, slow_mm=60)
    rule = settings.build_in_scene("clear", {}, facts.scene)
    assert isinstance(rule, Clearance)
    found = {proof.subject: proof for proof in prove("clear", settings, rule, facts)}
    assert found["bare"].problem == "its shape is not known"
    assert [found[role].problem for role in FACING] == ["", ""]
    assert [found[role].limit for role in FACING] == ["20 mm", "20 mm"]
    assert next(iter(settings.faults(facts_of({}, [TABLE], arms=["bare"])))).subject == "bare"
    assert len(tuple(settings.faults(facts_of({}, [TABLE], arms=["bare"])))) == 1


@pytest.mark.parametrize(("limit_mm", "slow_mm", "valid"), [(20, 20, True), (20, 19.9, False)])
def test_slow_may_be_as_near_as_the_limit(limit_mm: float, slow_mm: float, valid: bool) -> None:
    if valid:
        ClearanceConfig(kind="clearance", limit_mm=limit_mm, slow_mm=slow_mm)
    else:
        with pytest.raises(ValueError, match="below limit_mm"):
            ClearanceConfig(kind="clearance", limit_mm=limit_mm, slow_mm=slow_mm)
