"""Arms close to each other, a table or themselves: when motion is slowed, when it trips, and valid cell files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.fault_injection.fault_matrix import cells
from touchcell.cell.config.planning_scene import link_capsules
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome
from touchcell.control.interlocks.clearance import Clearance, ClearanceConfig
from touchcell.control.interlocks.collision import BASE, TOOL, Box, Capsule, Clearances
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.planning_scene import Body, PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.interlocks.violation import Severity
from touchcell.control.latch import Latch
from touchcell.control.supervisor import LIMIT_FOR_NS, REDUCED, Supervisor
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain
from touchcell.errors import ConfigError
from touchcell.geometry import se3

NOW = 1_000_000_000
ENTRY = {"kind": "clearance", "limit_mm": 20, "slow_mm": 60}
FINGER = Capsule("finger", (TOOL, TOOL), ((0.0, 0.0, 0.0), (0.0, 0.0, -0.1)), 0.02)
# The right arm stands 1 m to the right and faces back.
BODIES = {
    "left": Body(np.eye(4), [FINGER]),
    "right": Body(se3.from_euler_mm_deg(np.array([1000.0, 0, 0, 0, 0, 180])), [FINGER]),
}
TABLE = Box("table", se3.from_euler_mm_deg(np.array([0, 0, -500.0, 0, 0, 0])), np.array([2.0, 2.0, 0.5]))


def arm(x_mm: float, twist: Any = None, z_mm: float = 400.0) -> ArmView:
    state = TcpState(se3.from_euler_mm_deg(np.array([x_mm, 0, z_mm, 0, 0, 0])), np.zeros(6))
    command = None if twist is None else TwistCommand(np.array(twist, dtype=float), TwistFrame.BASE, NOW, 0.03)
    return ArmView(Stamped(state, NOW, 1), command)


def apart(gap_mm: float, left: Any = None, right: Any = None) -> CellView:
    """The two fingers ``gap_mm`` from each other along the world's x."""
    return CellView(NOW, {"left": arm(400.0, left), "right": arm(1000.0 - 440.0 - gap_mm, right)})


def rule(boxes: tuple[Box, ...] = (), **changes: Any) -> Clearance:
    (built,) = build_interlocks(parse_interlocks({"clear": {**ENTRY, **changes}}), {}, PlanningScene({}, BODIES, boxes))
    assert isinstance(built, Clearance)
    return built


FORTH = (0.05, 0, 0, 0, 0, 0)
BACK = (-0.05, 0, 0, 0, 0, 0)
ASIDE = (0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("gap_mm", "left", "right", "severity"),
    [
        (61, FORTH, FORTH, None),
        (59, FORTH, None, Severity.LIMIT),
        (59, None, FORTH, Severity.LIMIT),
        (59, BACK, None, None),
        (59, ASIDE, ASIDE, None),
        # One approaches faster than the other retreats.
        (59, FORTH, (-0.02, 0, 0, 0, 0, 0), Severity.LIMIT),
        (59, FORTH, (-0.08, 0, 0, 0, 0, 0), None),
        (21, FORTH, None, Severity.LIMIT),
        (19, FORTH, None, Severity.TRIP),
        (19, BACK, None, None),
        (19, BACK, FORTH, Severity.TRIP),
        (19, None, None, Severity.TRIP),
        (19, ASIDE, ASIDE, Severity.TRIP),
        (-5, FORTH, None, Severity.TRIP),
        (-5, BACK, BACK, None),
    ],
)
def test_two_arms_slow_down_then_stop_and_may_always_separate(gap_mm, left, right, severity):
    found = rule().check(apart(gap_mm, left, right))
    assert (found and found.severity) == severity
    if found is not None:
        limit = 20 if severity is Severity.TRIP else 60
        assert (found.value, found.limit) == (pytest.approx(1e-3 * gap_mm), pytest.approx(1e-3 * limit))
        assert (found.interlock, found.unit) == ("clear", "m")
        assert "finger is" in found.reason
        assert "'s finger" in found.reason


@pytest.mark.parametrize(("um_s", "severity"), [(9.0, None), (11.0, Severity.LIMIT)])
def test_closing_by_a_ten_millionth_of_a_metre_in_ten_milliseconds_counts(um_s, severity):
    found = rule().check(apart(50, (1e-6 * um_s, 0, 0, 0, 0, 0)))
    assert (found and found.severity) == severity


@pytest.mark.parametrize(
    ("back_mm_s", "measured_mm_s", "severity"),
    [
        (0.9, 0.0, Severity.TRIP),
        (1.1, 0.0, None),
        (50.0, -1.9, None),
        (50.0, -2.1, Severity.TRIP),
        (50.0, 60.0, None),
    ],
)
def test_too_near_they_part_faster_than_standing_still_and_are_not_measured_to_close(
    back_mm_s, measured_mm_s, severity
):
    view = apart(19, (-1e-3 * back_mm_s, 0, 0, 0, 0, 0))
    left = view.arms["left"]
    moving = TcpState(left.state.value.T_base_tcp, np.array([-1e-3 * measured_mm_s, 0, 0, 0, 0, 0]))
    view = replace(view, arms={**view.arms, "left": replace(left, state=Stamped(moving, NOW, 1))})
    found = rule().check(view)
    assert (found and found.severity) == severity


def test_what_is_told_is_the_limit_that_counts():
    assert rule().check(apart(19, FORTH)).reason.endswith("'s finger, limit 20 mm")
    assert rule().check(apart(21, FORTH)).reason.endswith("'s finger, slow below 60 mm")


def test_the_sensor_turning_towards_the_other_counts_as_approach():
    # Lying along y, the left finger sweeps its end towards the right arm.
    view = apart(30, None, None)
    lying = se3.from_euler_mm_deg(np.array([400.0, -100, 400, 90, 0, 0]))
    for turn, severity in ((-1.0, Severity.LIMIT), (1.0, None)):
        command = TwistCommand(np.array([0, 0, 0, 0, 0, turn]), TwistFrame.BASE, NOW, 0.03)
        left = ArmView(Stamped(TcpState(lying, np.zeros(6)), NOW, 1), command)
        found = rule(limit_mm=5).check(replace(view, arms={**view.arms, "left": left}))
        assert (found and found.severity) == severity


def test_a_table_is_checked_and_named():
    view = CellView(NOW, {"left": arm(0.0, (0, 0, -0.05, 0, 0, 0), z_mm=155.0), "right": arm(0.0)})
    found = rule((TABLE,)).check(view)
    assert found.severity is Severity.LIMIT
    assert found.reason == "finger is 35.0 mm from table, slow below 60 mm"
    assert found.subject == "left"


def test_slow_does_not_escalate_and_near_trips():
    supervisor = Supervisor(
        build_interlocks(parse_interlocks({"clear": ENTRY}), {}, PlanningScene({}, BODIES)), Latch()
    )
    for k in range(100):
        verdict = supervisor.review(replace(apart(40, FORTH), now_ns=NOW + k * LIMIT_FOR_NS // 10))
        assert (verdict.allow, verdict.speed) == (True, REDUCED)
    assert not supervisor.review(replace(apart(19, FORTH), now_ns=NOW + 100 * LIMIT_FOR_NS // 10)).allow


def test_a_forearm_between_base_and_tool_moves_with_the_tool_alone():
    forearm = Capsule("forearm", (BASE, TOOL), ((0.0, 0.0, 0.3), (0.0, 0.0, -0.1)), 0.03)
    body = Body(np.eye(4), [forearm])
    T = body.frames(arm(400.0, (0.1, 0, 0, 0, 0, 0)), 0.01)
    np.testing.assert_allclose(T[0], np.eye(4))
    np.testing.assert_allclose(T[-1][:3, 3], [0.401, 0.0, 0.4], atol=1e-12)
    box = Box("post", se3.from_euler_mm_deg(np.array([200.0, 100, 300, 0, 0, 0])), np.array([0.01, 0.01, 1.0]))
    found = Clearances({"arm": body.capsules}, {"arm": 2}, [box])
    assert found.distances(body.frames(arm(400.0)))[0] == pytest.approx(0.1 - 0.01 - 0.03, abs=1e-9)


CHAIN = SerialChain(ChainDescription.shipped("generic_6r"))
IK = DifferentialIk(CHAIN)


def jointed(q: np.ndarray, dq: np.ndarray) -> ArmView:
    T, J = CHAIN.forward_and_jacobian(q)
    command = TwistCommand(J @ dq, TwistFrame.BASE, NOW, 0.03)
    joints = Stamped(JointState(q, np.zeros(6)), NOW, 1)
    return ArmView(Stamped(TcpState(T, np.zeros(6)), NOW, 1), command, joints=joints)


def test_links_are_where_kinematics_put_them_and_move_as_the_command_asks():
    body = Body(np.eye(4), link_capsules(CHAIN.description), lambda: IK, 6)
    q = np.deg2rad([10.0, 40.0, 90.0, 5.0, 50.0, 20.0])
    dq = np.array([0.1, -0.2, 0.1, 0.0, 0.2, 0.1])
    T = body.frames(jointed(q, dq), 0.01)
    np.testing.assert_allclose(T[1:-1], CHAIN.link_poses(q + 0.01 * dq), atol=1e-9)
    np.testing.assert_allclose(T[-1], CHAIN.forward(q + 0.01 * dq), atol=2e-5)
    with pytest.raises(ValueError, match="joint angles"):
        body.frames(replace(jointed(q, dq), joints=None))


def test_an_arm_that_approaches_itself_is_slowed():
    parts = [
        *link_capsules(CHAIN.description),
        Capsule("gripper", (TOOL, TOOL), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.15)), 0.03),
    ]
    bodies = {"arm": Body(np.eye(4), parts, lambda: IK, 6)}
    (clear,) = build_interlocks(parse_interlocks({"clear": {**ENTRY, "slow_mm": 80}}), {}, PlanningScene({}, bodies))
    q = np.deg2rad([0.0, 20.0, 140.0, 0.0, 85.0, 0.0])
    bend = np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    found = clear.check(CellView(NOW, {"arm": jointed(q, bend)}))
    assert found is not None
    assert "its own" in found.reason
    assert clear.check(CellView(NOW, {"arm": jointed(q, -bend)})) is None or found.severity is Severity.TRIP


@pytest.mark.parametrize("name", ["generic_6r", "so101_5r", "ur3e", "ur5e", "ur10e", "ur16e", "fr3"])
def test_no_shipped_arm_touches_itself_where_it_works(name):
    chain = SerialChain(ChainDescription.shipped(name))
    poses = {"generic_6r": [0, 40, 90, 0, 50, 0], "so101_5r": [0, 10, 90, 80, 0], "fr3": [0, -45, 0, -135, 0, 90, 45]}
    q = np.deg2rad(np.array(poses.get(name, [0, -90, 90, -90, -90, 0]), dtype=float))
    found = Clearances({"arm": link_capsules(chain.description)}, {"arm": chain.joint_count + 2}, [])
    frames = np.concatenate([np.eye(4)[None], chain.link_poses(q), chain.forward(q)[None]])
    assert len(found.pairs) >= 3
    assert found.distances(frames).min() > 0.06


def test_nothing_to_keep_apart_is_a_config_error():
    with pytest.raises(ConfigError) as caught:
        build_interlocks(parse_interlocks({"clear": ENTRY}), {})
    assert caught.value.key == "interlocks.clear"


def test_slow_below_the_limit_is_refused():
    with pytest.raises(ValueError, match="slow_mm 10 is below limit_mm 20"):
        ClearanceConfig(kind="clearance", limit_mm=20, slow_mm=10)


def following(tmp_path: Path, **changes: Any) -> Path:
    """Surface following with a finger along the sensor, and a post in its path."""
    data = cells()["surface_following"]
    put_on_true_contact(data)
    data["task"]["distance_mm"] = 60
    data["arms"]["arm"]["body"] = [{"from_mm": [0, 0, -100], "to_mm": [0, 0, -20], "radius_mm": 15}]
    data["interlocks"]["clear"] = {"kind": "clearance", "limit_mm": 20, "slow_mm": 30}
    data["obstacles"] = {"post": {"pose_mm_deg": [20, 0, 50, 0, 0, 0], "size_mm": [20, 400, 400]}}
    data |= changes
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_a_running_cell_trips_before_the_post(tmp_path):
    cell = compose(plan_cell(following(tmp_path)))
    start_m = cell.arms["arm"]._body.T_base_tcp[:3, 3].copy()
    with cell:
        result = RunLoop(cell, None).run()
        reached_m = cell.arms["arm"].tcp().value.T_base_tcp[:3, 3]
    assert np.linalg.norm(reached_m - start_m) > 0.01
    assert result.outcome is Outcome.TRIPPED
    assert result.causes[0].interlock == "clear"
    assert "from post" in result.reason
    # Slowed to 5 mm/s before, it stops right at the limit: the post's face is at 10 mm, the finger 15 mm thick.
    assert 0.010 - reached_m[0] - 0.015 == pytest.approx(0.020, abs=2e-4)


def problems(path: Path) -> dict[str, str]:
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    return {problem.key: problem.reason for problem in caught.value.problems}


def test_a_limit_that_leaves_no_room_to_stop_is_refused_with_its_remedy(tmp_path):
    path = following(tmp_path)
    way = plan_cell(path).stopping_distances["clear"]
    data = yaml.safe_load(path.read_text())
    data["interlocks"]["clear"]["limit_mm"] = 1
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    (problem,) = caught.value.problems
    assert problem.key == "interlocks.clear.limit_mm"
    assert problem.value == 1
    assert "lower limits.tcp_speed_m_s of arm" in problem.hint
    assert f"{1e3 * way.total_m:.1f} mm in all" in problem.reason


def test_the_speeds_of_two_arms_add_up(tmp_path):
    path = following(tmp_path)
    one = plan_cell(path).stopping_distances["clear"]
    data = yaml.safe_load(path.read_text())
    data["arms"]["other"] = {**data["arms"]["arm"], "base_pose_mm_deg": [900, 0, 0, 0, 0, 180]}
    data["sensors"]["second"] = {**data["sensors"]["sensor"], "mounted_on": "other"}
    path.write_text(yaml.safe_dump(data))
    plan = plan_cell(path)
    # The task needs one arm only: the other is not built and does not move.
    assert "other" in plan.skipped
    assert plan.stopping_distances["clear"] == one
    assert plan.devices["other"].config.base_pose_mm_deg[0] == 900


def test_an_arm_without_a_shape_is_refused(tmp_path):
    path = following(tmp_path)
    data = yaml.safe_load(path.read_text())
    del data["arms"]["arm"]["body"]
    path.write_text(yaml.safe_dump(data))
    assert "arms.arm.body" in problems(path)
    data["arms"]["arm"]["body"] = [{"to_mm": [0, 0, 1], "radius_mm": 5}]
    path.write_text(yaml.safe_dump(data))
    assert any("from_mm or from_base_mm" in reason for reason in problems(path).values())
