"""Arms from a checkout of MuJoCo Menagerie, here a small one of our own with its folders and names."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.drivers.kinematics.chain import ChainDescription
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.simulation.devices.joint_arm import SimJointArm

mujoco = pytest.importorskip("mujoco")

FILES = {"panda": "franka_emika_panda/panda_nohand.xml", "ur5e": "universal_robots_ur5e/ur5e.xml"}
JOINTS = {
    "panda": [f"joint{i}" for i in range(1, 8)],
    "ur5e": [f"{each}_joint" for each in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")],
}
START = {"panda": (450.0, 50.0, 300.0, 180.0, 0.0, 0.0), "ur5e": (-450.0, -150.0, 300.0, 180.0, 0.0, 0.0)}
MASS_KG = 3.21


def checkout(root: Path, model: str, *, names: list[str] | None = None, longer_mm: float = 0.0) -> Path:
    """A folder with one arm: the chain's joints, a base that is turned, meshes that are not there, motors, a key."""
    mjcf = ElementTree.Element("mujoco")
    ElementTree.SubElement(mjcf, "compiler", angle="radian", meshdir="assets")
    assets = ElementTree.SubElement(mjcf, "asset")
    ElementTree.SubElement(assets, "mesh", name="shell", file="not_there.obj")
    world = ElementTree.SubElement(mjcf, "worldbody")
    body = ElementTree.SubElement(world, "body", name="base", quat="1 0 0 1")
    ElementTree.SubElement(body, "inertial", mass="4", pos="0 0 0", diaginertia="0.01 0.01 0.01")
    actuators = ElementTree.SubElement(mjcf, "actuator")
    chain = ChainDescription.shipped(model)
    for number, (joint, name) in enumerate(zip(chain.joints, names or JOINTS[model], strict=True)):
        T = joint.pose()
        if number == 0:
            # In a base rotated by 90 degrees the same joint is rotated by -90 degrees.
            T = se3.from_euler_mm_deg((0, 0, 0, 0, 0, -90)) @ T
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T[:3, :3]).ravel())
        place = T[:3, 3] + ([0.0, 0.0, 1e-3 * longer_mm] if number == 3 else [0.0, 0.0, 0.0])
        body = ElementTree.SubElement(body, "body", name=f"link{number}", pos=text(place), quat=text(quat))
        inertia = {"mass": str(MASS_KG), "pos": "0 0 0.05", "diaginertia": "0.02 0.02 0.02"}
        ElementTree.SubElement(body, "inertial", inertia)
        ElementTree.SubElement(
            body, "joint", name=name, axis=text(joint.axis), range="-6 6", damping="5", armature="0.1"
        )
        ElementTree.SubElement(body, "geom", type="mesh", mesh="shell")
        ElementTree.SubElement(actuators, "position", name=name, joint=name, kp="100")
    ElementTree.SubElement(ElementTree.SubElement(body, "body", name="attachment"), "site", name="attachment_site")
    keys = ElementTree.SubElement(mjcf, "keyframe")
    ElementTree.SubElement(keys, "key", name="home", qpos=text([0.0] * len(chain.joints)))
    path = root / FILES[model]
    path.parent.mkdir(parents=True)
    path.write_bytes(ElementTree.tostring(mjcf))
    return root


def text(values: object) -> str:
    """Numbers as MJCF has them."""
    return " ".join(f"{value:.9g}" for value in np.asarray(values))


def build(model: str, **changes: object) -> SimJointArm:
    spec = DRIVERS.load("sim_joint_arm")
    config = spec.config.model_validate({"model": model, "start_pose_mm_deg": START[model], **changes})
    arm = spec.build("arm", config, DriverContext(VirtualClock()))
    assert isinstance(arm, SimJointArm)
    return arm


@pytest.mark.parametrize("model", ["panda", "ur5e"])
def test_its_arm_has_our_kinematics_with_its_own_masses(tmp_path: Path, model: str) -> None:
    arms = [build(model), build(model, menagerie=str(checkout(tmp_path, model)))]
    moved = []
    for arm in arms:
        arm.connect()
        arm.configure()
        arm.activate()
        lease = arm.acquire("test")
        np.testing.assert_allclose(arm.T_world_tcp(), se3.from_euler_mm_deg(START[model]), atol=1e-4)
        for _ in range(50):
            twist = TwistCommand(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.1]), TwistFrame.BASE, arm._clock.now_ns(), 0.05)
            arm.send_twist(twist, lease)
            arm._clock.sleep_until_ns(arm._clock.now_ns() + 10_000_000)
        moved.append(arm.tcp().value.T_base_tcp)
    np.testing.assert_allclose(moved[1], moved[0], atol=2e-3)
    masses = arms[1]._body._model.body_mass
    assert np.count_nonzero(np.isclose(masses, MASS_KG)) == len(JOINTS[model])
    assert arms[1]._body._model.ngeom == 0


def test_the_environment_variable_is_the_fallback_of_the_cell_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", str(checkout(tmp_path, "panda")))
    assert np.count_nonzero(np.isclose(build("panda")._body._model.body_mass, MASS_KG)) == 7


def test_an_unusable_checkout_is_reported_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file") as missing:
        build("panda", menagerie=str(tmp_path / "empty"))
    assert missing.value.key == "menagerie"
    renamed = checkout(tmp_path / "renamed", "panda", names=[f"axis{i}" for i in range(7)])
    with pytest.raises(ConfigError, match="its joints are axis0"):
        build("panda", menagerie=str(renamed))
    with pytest.raises(ConfigError, match="differs from"):
        build("panda", menagerie=str(checkout(tmp_path / "longer", "panda", longer_mm=30.0)))
    broken = checkout(tmp_path / "broken", "panda")
    (broken / FILES["panda"]).write_text("<mujoco><worldbody>")
    with pytest.raises(ConfigError, match="cannot read it"):
        build("panda", menagerie=str(broken))
