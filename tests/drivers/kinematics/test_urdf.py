"""Arms from URDF files, judged by pinocchio's own reading of them and on arms that others describe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchcell.drivers.kinematics import urdf
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool
from touchcell.errors import ConfigError

TWO_JOINTS = """<?xml version="1.0"?>
<robot name="small">
  <link name="world"/>
  <link name="base"><collision><geometry><box size="0.2 0.1 0.1"/></geometry></collision></link>
  <link name="upper"><inertial><origin xyz="0 0 0.1"/><mass value="2"/></inertial></link>
  <link name="lower">
    <collision><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.04" length="0.2"/></geometry></collision>
  </link>
  <link name="cover"><inertial><origin xyz="0 0.1 0"/><mass value="1"/></inertial></link>
  <link name="tool0"/>
  <link name="left"/><link name="right"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="2" velocity="3" effort="10"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.2" rpy="1.5707963267948966 0 0"/><axis xyz="0 1 0"/><limit velocity="3" effort="10"/></joint>
  <joint name="covered" type="fixed"><parent link="upper"/><child link="cover"/></joint>
  <joint name="hand" type="fixed"><parent link="lower"/><child link="tool0"/><origin xyz="0 0 0.3"/></joint>
  <joint name="finger1" type="revolute"><parent link="tool0"/><child link="left"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/></joint>
  <joint name="finger2" type="revolute"><parent link="tool0"/><child link="right"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/></joint>
</robot>
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(TWO_JOINTS)
    return path


def test_an_arm_ends_before_its_fingers_at_its_flange(file: Path) -> None:
    found = ChainDescription.named(str(file))
    assert [joint.name for joint in found.joints] == ["shoulder", "elbow"]
    assert found.joints[0].origin_mm == pytest.approx((0.0, 0.0, 1100.0))
    assert (found.joints[0].lower_deg, found.joints[0].upper_deg) == pytest.approx((-57.29578, 114.59156))
    assert found.joints[1].upper_deg == 36_000.0
    assert found.flange.origin_mm == pytest.approx((0.0, 0.0, 300.0))


def test_what_a_link_carries_counts_as_its_mass(file: Path) -> None:
    upper = ChainDescription.named(str(file)).joints[0]
    assert upper.mass_kg == 3.0
    assert upper.com_mm == pytest.approx((0.0, 100.0 / 3.0, 200.0 / 3.0))


def test_collision_shapes_become_capsules_that_contain_them(file: Path) -> None:
    found = ChainDescription.named(str(file))
    (cylinder,) = found.joints[1].capsules
    assert (cylinder.from_mm, cylinder.to_mm, cylinder.radius_mm) == ((0, 0, 0), (0, 0, 200), 40)
    (box,) = ChainDescription.named(f"{file}#base:tool0").base_capsules
    assert box.radius_mm == pytest.approx(70.71, abs=0.01)


@pytest.mark.parametrize("seed", range(20))
def test_a_capsule_contains_all_points(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(60, 3)) * [0.3, 0.1, 0.05]
    start, end, radius = urdf.around(points)
    way = end - start
    along = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
    assert (np.linalg.norm(points - (start + along[:, None] * way), axis=1) <= radius + 1e-9).all()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("robot", "cell", "root is <cell>"),
        ("</robot>", "", "no URDF file"),
        ('<limit lower="-1" upper="2" velocity="3" effort="10"/>', "", "joint 'shoulder' has no range"),
        ('upper="2" velocity="3"', 'upper="2"', "joint 'shoulder' has no velocity limit"),
        ('upper="2" velocity="3"', 'upper="two" velocity="3"', "'two' is no upper end"),
        ('xyz="0 0 2"', 'xyz="0 0 nan"', "is not finite"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "lacks a parent, a child or an axis"),
        ('type="continuous"', 'type="prismatic"', "is prismatic"),
        ('<child link="cover"/>', '<child link="nothing"/>', "joins links that are not there"),
        ('<child link="cover"/>', '<child link="tool0"/>', "has two parents"),
        ('lower="-1" upper="2"', 'lower="2" upper="-1"', "is not below"),
    ],
)
def test_what_a_chain_cannot_be_made_of_is_named(old: str, new: str, says: str, file: Path) -> None:
    file.write_text(TWO_JOINTS.replace(old, new))
    with pytest.raises(ConfigError, match=says) as caught:
        ChainDescription.named(f"{file}#tool0")
    assert caught.value.file == str(file)


def test_a_link_that_is_not_there_is_named_with_those_that_are(file: Path) -> None:
    with pytest.raises(ConfigError, match="no link 'tool1'") as caught:
        ChainDescription.named(f"{file}#tool1")
    assert "tool0" in str(caught.value)


ROBOTS = [
    ("ur_description/urdf/ur3_robot.urdf", "world", "tool0"),
    ("ur_description/urdf/ur5_robot.urdf", "world", "tool0"),
    ("ur_description/urdf/ur10_robot.urdf", "world", "tool0"),
    ("ur_description/urdf/ur3_gripper.urdf", None, "tool0"),
    ("ur_description/urdf/ur5_gripper.urdf", None, "tool0"),
    ("panda_description/urdf/panda.urdf", None, "panda_link8"),
    ("kinova_description/urdf/kinova.urdf", None, "j2s6s200_end_effector"),
    ("xarm_description/urdf/xarm7.urdf", None, "link7"),
    ("z1_description/urdf/z1.urdf", None, "link06"),
    ("so_arm_description/urdf/so100.urdf", None, "jaw"),
    ("so_arm_description/urdf/so101.urdf", None, "gripper_link"),
    ("talos_data/urdf/talos_left_arm.urdf", None, "gripper_left_base_link"),
    ("baxter_description/urdf/baxter.urdf", None, "left_gripper"),
    ("baxter_description/urdf/baxter.urdf", None, "right_gripper"),
    ("tiago_description/robots/tiago_no_hand.urdf", "torso_lift_link", "wrist_ft_tool_link"),
    ("pr2_description/urdf/pr2.urdf", "torso_lift_link", "l_gripper_tool_frame"),
    ("pr2_description/urdf/pr2.urdf", "torso_lift_link", "r_gripper_tool_frame"),
    ("romeo_description/urdf/romeo.urdf", "torso", "l_wrist"),
]


def robots_folder() -> Path:
    pin = pytest.importorskip("pinocchio", reason="pip install touchcell[kinematics]")
    folder = Path(pin.__file__).parents[4] / "share" / "example-robot-data" / "robots"
    return folder if folder.is_dir() else pytest.skip("pip install example-robot-data")


@pytest.mark.parametrize(("name", "base", "tip"), ROBOTS)
def test_arms_of_others_agree_with_pinocchios_reading_of_their_files(name: str, base: str | None, tip: str) -> None:
    file = next(iter(sorted(robots_folder().rglob(Path(name).name))))
    import pinocchio as pin

    chain = SerialChain(ChainDescription.named(f"{file}#{f'{base}:' if base else ''}{tip}"))
    model = pin.buildModelFromUrdf(str(file))
    data, names = model.createData(), chain.joint_names
    rng = np.random.default_rng(7)
    # Some files have ranges of no use, and continuous joints have none.
    low, high = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
    for q in rng.uniform(low, high, (10, chain.joint_count)):
        full = pin.neutral(model)
        for joint, angle in zip(names, q.tolist(), strict=True):
            joint_model = model.joints[model.getJointId(joint)]
            # Pinocchio keeps an endless joint as cosine and sine.
            full[joint_model.idx_q : joint_model.idx_q + joint_model.nq] = (
                [np.cos(angle), np.sin(angle)] if joint_model.nq == 2 else [angle]
            )
        pin.computeJointJacobians(model, data, full)
        pin.updateFramePlacements(model, data)
        tip_frame = model.getFrameId(tip)
        T_world_base = data.oMf[model.getFrameId(base)].homogeneous if base else np.eye(4)
        expected = np.linalg.inv(T_world_base) @ data.oMf[tip_frame].homogeneous
        T, J = chain.forward_and_jacobian(q)
        np.testing.assert_allclose(T, expected, atol=1e-12)
        theirs = pin.getFrameJacobian(model, data, tip_frame, pin.LOCAL_WORLD_ALIGNED)
        columns = [model.joints[model.getJointId(joint)].idx_v for joint in names]
        R = T_world_base[:3, :3].T
        np.testing.assert_allclose(J, np.vstack([R @ theirs[:3, columns], R @ theirs[3:, columns]]), atol=1e-12)


@pytest.mark.parametrize("name", ["ur5e", "fr3", "so101_5r", "generic_6r", "panda"])
def test_the_faster_engine_equals_the_plain_chain(name: str) -> None:
    pytest.importorskip("pinocchio", reason="pip install touchcell[kinematics]")
    tool = Tool(origin_mm=(10, -20, 80), rotation_deg=(10, 20, 30), mass_kg=0.4, com_mm=(1, 2, 40))
    tilted = (0.0, -4.0, -9.0)
    plain, fast = (SerialChain(ChainDescription.shipped(name), tool, tilted) for _ in range(2))
    assert fast.accelerate()
    for q in np.random.default_rng(3).uniform(-3.0, 3.0, (50, plain.joint_count)):
        np.testing.assert_allclose(fast.forward(q), plain.forward(q), atol=1e-12)
        for ours, theirs in zip(plain.forward_and_jacobian(q), fast.forward_and_jacobian(q), strict=True):
            np.testing.assert_allclose(theirs, ours, atol=1e-12)
        np.testing.assert_allclose(fast.gravity_torques(q), plain.gravity_torques(q), atol=1e-12)


def test_the_faster_engine_refuses_what_the_plain_chain_refuses() -> None:
    pytest.importorskip("pinocchio", reason="pip install touchcell[kinematics]")
    from touchcell.geometry.errors import GeometryError

    chain = SerialChain(ChainDescription.shipped("ur5e"))
    chain.accelerate()
    for wrong in (np.zeros(5), np.array([np.nan] * 6), np.array([np.inf] * 6)):
        with pytest.raises(GeometryError):
            chain.forward(wrong)


def test_threads_do_not_disturb_each_others_results() -> None:
    pytest.importorskip("pinocchio", reason="pip install touchcell[kinematics]")
    import threading

    chain = SerialChain(ChainDescription.shipped("ur5e"))
    chain.accelerate()
    wrong: list[int] = []

    def compute(seed: int) -> None:
        q = np.random.default_rng(seed).uniform(-3.0, 3.0, 6)
        expected = chain.forward_and_jacobian(q)[1]
        wrong.extend(k for k in range(2000) if not np.array_equal(chain.forward_and_jacobian(q)[1], expected))

    threads = [threading.Thread(target=compute, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
