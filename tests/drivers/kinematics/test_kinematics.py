from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.kinematics.chain import (
    GRAVITY_M_S2,
    ChainDescription,
    DifferentialIk,
    IkSettings,
    Joint,
    SerialChain,
    Tool,
)
from touchcell.errors import ConfigError
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array

GENERIC = ChainDescription.shipped("generic_6r")
TOOL = Tool(origin_mm=(5, -3, 60), rotation_deg=(0, 10, 30), mass_kg=0.2, com_mm=(0, 4, 30))
ARM = SerialChain(GENERIC, TOOL)
WORKING = np.deg2rad([10.0, 40.0, 90.0, 5.0, 50.0, 20.0])


def planar(lengths_mm: list[float]) -> SerialChain:
    """Joints about z, links along x, gravity along -y."""
    joints = tuple(
        Joint(
            name=f"j{i}",
            origin_mm=(x, 0, 0),
            lower_deg=-170,
            upper_deg=170,
            speed_deg_s=90,
            torque_n_m=5,
            mass_kg=1,
            com_mm=(100, 0, 0),
        )
        for i, x in enumerate([0.0, *lengths_mm[:-1]])
    )
    tool = Tool(origin_mm=(lengths_mm[-1], 0, 0))
    return SerialChain(ChainDescription(name="planar", joints=joints), tool, (0.0, -9.80665, 0.0))


def seven_joints() -> SerialChain:
    """Shoulder, elbow and wrist of alternating axes: redundant."""
    axes = [(0, 0, 1), (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1)]
    heights = [150, 80, 150, 150, 130, 130, 60]
    joints = tuple(
        Joint(name=f"j{i}", origin_mm=(0, 0, z), axis=a, lower_deg=-160, upper_deg=160, speed_deg_s=120, torque_n_m=10)
        for i, (a, z) in enumerate(zip(axes, heights, strict=True))
    )
    return SerialChain(ChainDescription(name="seven", joints=joints), Tool(origin_mm=(0, 0, 80)))


def angles(chain: SerialChain) -> st.SearchStrategy[Array]:
    fractions = st.lists(st.floats(0.0, 1.0), min_size=chain.joint_count, max_size=chain.joint_count)
    return fractions.map(lambda f: chain.lower + (chain.upper - chain.lower) * np.array(f))


twists = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)


def test_two_links_by_hand() -> None:
    arm = planar([300.0, 200.0])
    T = arm.forward(np.deg2rad([90.0, -90.0]))
    np.testing.assert_allclose(T[:3, 3], [0.2, 0.3, 0.0], atol=1e-15)
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-15)
    # Stretched along x under gravity along -y: link masses 1 kg at 0.1 m and 0.4 m.
    np.testing.assert_allclose(arm.gravity_torques(np.zeros(2)), [9.80665 * 0.5, 9.80665 * 0.1], rtol=1e-12)


def test_the_generic_arm_holds_its_tool_down_at_the_described_pose() -> None:
    T = SerialChain(GENERIC).forward(np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0]))
    np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, -1.0], atol=1e-12)


@given(q=angles(ARM))
@settings(max_examples=40)
def test_jacobian_is_the_derivative_of_the_pose(q: Array) -> None:
    step = 1e-6
    J = ARM.jacobian(q)
    for k, unit in enumerate(np.eye(6)):
        ahead, behind = ARM.forward(q + step * unit), ARM.forward(q - step * unit)
        np.testing.assert_allclose((ahead - behind)[:3, 3] / (2 * step), J[:3, k], atol=1e-8)
        spin = (ahead - behind)[:3, :3] / (2 * step) @ ARM.forward(q)[:3, :3].T
        np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], J[3:, k], atol=1e-8)


def test_gravity_torques_do_the_work_that_lifting_takes() -> None:
    def lift(q: Array, unit: Array) -> float:
        work = 0.0
        for a, b in zip(np.linspace(0, 1, 200)[:-1], np.linspace(0, 1, 200)[1:], strict=True):
            work += float(ARM.gravity_torques(q + 0.5 * (a + b) * unit) @ unit) * (b - a)
        return work

    # A conservative field: the work along a closed path of joint angles is zero.
    e = 0.4 * np.eye(6)
    loop = lift(WORKING, e[1]) + lift(WORKING + e[1], e[2]) - lift(WORKING + e[2], e[1]) - lift(WORKING, e[2])
    assert abs(loop) < 1e-5
    assert abs(lift(WORKING, e[1])) > 1.0


def test_pinocchio_agrees() -> None:
    pin = pytest.importorskip("pinocchio")
    model = pin.Model()
    model.gravity = pin.Motion(np.array(GRAVITY_M_S2), np.zeros(3))
    parent = 0
    for joint in GENERIC.joints:
        placement = joint.pose()
        axis = np.array(joint.axis)
        placement = pin.SE3(placement[:3, :3], placement[:3, 3])
        parent = model.addJoint(parent, pin.JointModelRevoluteUnaligned(*axis), placement, joint.name)
        body = pin.Inertia(joint.mass_kg, np.array(joint.com_mm) * 1e-3, np.zeros((3, 3)))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    flange, tool = GENERIC.flange.pose(), TOOL.pose()
    T_joint_flange = pin.SE3(flange[:3, :3], flange[:3, 3])
    held = pin.Inertia(TOOL.mass_kg, np.array(TOOL.com_mm) * 1e-3, np.zeros((3, 3)))
    model.appendBodyToJoint(parent, held, T_joint_flange)
    T_joint_tcp = T_joint_flange * pin.SE3(tool[:3, :3], tool[:3, 3])
    frame = model.addFrame(pin.Frame("tcp", parent, 0, T_joint_tcp, pin.FrameType.OP_FRAME))
    data = model.createData()
    rng = np.random.default_rng(1)
    for q in rng.uniform(ARM.lower, ARM.upper, (50, 6)):
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(ARM.forward(q), data.oMf[frame].homogeneous, atol=1e-12)
        J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(ARM.jacobian(q), J, atol=1e-12)
        np.testing.assert_allclose(ARM.gravity_torques(q), pin.computeGeneralizedGravity(model, data, q), atol=1e-10)


def test_a_twist_in_the_open_is_followed_exactly() -> None:
    twist = np.array([0.05, -0.02, 0.03, 0.1, -0.2, 0.05])
    motion = DifferentialIk(ARM).solve(WORKING, twist)
    np.testing.assert_allclose(ARM.jacobian(WORKING) @ motion.dq, twist, atol=1e-12)
    np.testing.assert_allclose(motion.twist, twist, atol=1e-12)
    assert motion.adjustments == ()
    assert motion.smallest_singular_value > 0.04


@pytest.mark.parametrize("chain", [ARM, planar([300.0, 200.0]), seven_joints()], ids=["six", "two", "seven"])
def test_every_answer_is_finite_and_within_the_speeds(chain: SerialChain) -> None:
    ik = DifferentialIk(chain)

    @given(q=angles(chain), twist=twists)
    @settings(max_examples=100)
    def check(q: Array, twist: Array) -> None:
        motion = ik.solve(q, 10.0 * twist)
        assert np.isfinite(motion.dq).all()
        assert (np.abs(motion.dq) <= chain.speed).all()
        assert (motion.dq[q >= chain.upper] <= 0.0).all()
        assert (motion.dq[q <= chain.lower] >= 0.0).all()
        np.testing.assert_allclose(chain.jacobian(q) @ motion.dq, motion.twist, atol=1e-9)

    check()


def test_a_limited_motion_keeps_its_direction() -> None:
    twist = np.array([0.5, -0.2, 0.3, 1.0, -2.0, 0.5])
    motion = DifferentialIk(ARM).solve(WORKING, 10.0 * twist)
    scale = motion.twist[0] / twist[0]
    assert 0.0 < scale < 10.0
    np.testing.assert_allclose(motion.twist, scale * twist, rtol=1e-9)
    assert np.isclose(np.max(np.abs(motion.dq) / ARM.speed), 1.0)
    assert motion.adjustments[0].limit.startswith("joint ")


def test_a_joint_near_its_limit_moves_inwards_freely_and_outwards_ever_slower() -> None:
    ik = DifferentialIk(ARM)
    q = WORKING.copy()
    q[5] = ARM.upper[5] - np.deg2rad(1.0)
    outwards = ARM.jacobian(q)[:, 5]
    assert np.isclose(ik.solve(q, 2.0 * outwards).dq[5], ARM.speed[5] / 5.0)
    np.testing.assert_allclose(ik.solve(q, -2.0 * outwards).dq, [0, 0, 0, 0, 0, -2.0], atol=1e-9)
    q[5] = ARM.upper[5] + 0.01
    assert ik.solve(q, outwards).dq[5] == 0.0
    assert np.isclose(ik.solve(q, -ARM.jacobian(q)[:, 5]).dq[5], -1.0)


def test_rounding_at_a_limit_does_not_stop_the_arm() -> None:
    q = WORKING.copy()
    q[0] = ARM.upper[0]
    in_the_plane_of_the_arm = ARM.jacobian(q)[:, 1] * 0.3
    np.testing.assert_allclose(
        DifferentialIk(ARM).solve(q, in_the_plane_of_the_arm).dq, [0, 0.3, 0, 0, 0, 0], atol=1e-6
    )


def test_a_redundant_arm_avoids_a_joint_limit_in_its_null_space() -> None:
    arm = seven_joints()
    q = np.deg2rad([10.0, 40.0, 20.0, 80.0, 10.0, 50.0, 0.0])
    twist = np.array([0.05, 0.05, 0.02, 0.0, 0.1, 0.0])
    ik = DifferentialIk(arm)
    assert ik.solve(q, twist).dq[2] < -0.01
    arm.lower[2] = q[2]
    motion = ik.solve(q, twist)
    assert motion.dq[2] == 0.0
    np.testing.assert_allclose(motion.twist, twist, atol=1e-9)


def test_reaching_out_stops_before_the_singularity_and_can_turn_back() -> None:
    ik, dt_s = DifferentialIk(ARM), 0.004
    q = WORKING.copy()
    outwards = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    fastest = 0.0
    for _ in range(3000):
        motion = ik.solve(q, outwards)
        fastest = max(fastest, float(np.abs(motion.dq).max()))
        q = q + motion.dq * dt_s
        assert motion.smallest_singular_value > IkSettings().singular_floor_m * 0.99
    assert fastest < 2.0
    stuck = ik.solve(q, outwards)
    assert np.linalg.norm(stuck.twist) < 0.002
    assert any(adjustment.limit == "singularity" for adjustment in stuck.adjustments)
    back = ik.solve(q, -outwards)
    assert back.twist[0] < -0.05
    for _ in range(500):
        q = q + ik.solve(q, -outwards).dq * dt_s
    np.testing.assert_allclose(ik.solve(q, -outwards).twist, -outwards, atol=1e-9)


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, np.nan)])
def test_invalid_joint_angles_are_refused(q: Array) -> None:
    with pytest.raises(GeometryError):
        ARM.forward(q)


@pytest.mark.parametrize("twist", [np.zeros(5), np.array([np.nan, 0, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0, np.inf])])
def test_invalid_twists_are_refused(twist: Array) -> None:
    with pytest.raises(GeometryError):
        DifferentialIk(ARM).solve(WORKING, twist)


def test_a_wrong_description_names_its_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text("name: arm\njoints:\n- {name: a, lower_deg: 10, upper_deg: 5, speed_deg_s: 1, torque_n_m: 1}\n")
    with pytest.raises(ConfigError) as caught:
        ChainDescription.read(path)
    assert caught.value.file == str(path)
    assert "lower_deg 10.0 is not below" in str(caught.value)
    with pytest.raises(ConfigError) as caught:
        ChainDescription.shipped("generic_9r")
    assert "generic_6r" in caught.value.hint
