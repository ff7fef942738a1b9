from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, Progress
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.errors import LifecycleError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain
from touchcell.drivers.kinematics.inverse import joints_for_pose
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.devices.joint_arm import TOOLS, SimJointArm
from touchcell.simulation.devices.tactip import SimTactip, SimTactipConfig
from touchcell.simulation.scene import SceneConfig

pytest.importorskip("mujoco")

DOWN = {"panda": (450.0, 50.0, 300.0, 180.0, 0.0, 0.0), "ur5e": (-450.0, -150.0, 300.0, 180.0, 0.0, 0.0)}


def make(clock: VirtualClock, model: str = "panda", scene: object = None, **changes: object) -> SimJointArm:
    spec = DRIVERS.load("sim_joint_arm")
    config = spec.config.model_validate({"model": model, "start_pose_mm_deg": DOWN[model], **changes})
    arm = spec.build("arm", config, DriverContext(clock, scene=scene))
    assert isinstance(arm, SimJointArm)
    return arm


def active(clock: VirtualClock, model: str = "panda", **changes: object) -> tuple[SimJointArm, Lease]:
    arm = make(clock, model, **changes)
    arm.connect()
    arm.configure()
    arm.activate()
    return arm, arm.acquire("test")


def follow(arm: SimJointArm, lease: Lease, clock: VirtualClock, twist: list[float], seconds: float) -> set[str]:
    """Returns what held the arm back."""
    limits = set()
    for _ in range(round(seconds / 0.01)):
        sent = arm.send_twist(TwistCommand(np.array(twist), TwistFrame.BASE, clock.now_ns(), 0.05), lease)
        limits |= {adjustment.limit for adjustment in sent.adjustments}
        clock.advance_s(0.01)
    return limits


def test_the_shipped_chains_match_their_manufacturers_tables() -> None:
    panda = SerialChain(ChainDescription.shipped("panda"))
    ready = np.radians([0, -45, 0, -135, 0, 90, 45])
    np.testing.assert_allclose(panda.forward(ready)[:3, 3], [0.3069, 0.0, 0.5903], atol=2e-4)
    ur5e = SerialChain(ChainDescription.shipped("ur5e"))
    np.testing.assert_allclose(ur5e.forward(np.zeros(6))[:3, 3], [-0.8172, -0.2329, 0.0628], atol=1e-4)


@pytest.mark.parametrize("model", ["panda", "ur5e"])
def test_it_starts_at_the_configured_pose_and_stays(model: str) -> None:
    clock = VirtualClock()
    arm = make(clock, model, base_pose_mm_deg=(0, 100, 0, 0, 0, 90))
    with pytest.raises(LifecycleError):
        arm.joints()
    arm.connect()
    clock.advance_s(1.0)
    np.testing.assert_allclose(arm.tcp().value.T_base_tcp, se3.from_euler_mm_deg(np.array(DOWN[model])), atol=1e-6)
    np.testing.assert_allclose(arm.T_world_tcp(), arm.T_world_base @ arm.tcp().value.T_base_tcp, atol=1e-9)
    assert arm.at_rest()


@pytest.mark.parametrize("model", ["panda", "ur5e"])
@pytest.mark.parametrize("twist", [[0.05, 0, 0, 0, 0, 0], [0, -0.04, 0.02, 0.1, 0, 0.2]])
def test_it_follows_twists_and_stops(model: str, twist: list[float]) -> None:
    clock = VirtualClock()
    arm, lease = active(clock, model)
    before = arm.tcp().value.T_base_tcp
    follow(arm, lease, clock, twist, 1.0)
    np.testing.assert_allclose(arm.tcp().value.twist, twist, atol=2e-3)
    clock.advance_s(0.5)
    assert arm.at_rest()
    after = arm.tcp().value.T_base_tcp
    # One second of speed, less and more what speeding up and slowing down take.
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], np.array(twist[:3]) * 1.05, atol=0.006)
    turned = se3.log(after @ se3.inverse(before))[3:]
    np.testing.assert_allclose(turned, np.array(twist[3:]) * 1.05, atol=0.03)


def test_it_slows_down_before_it_is_stretched_out() -> None:
    clock = VirtualClock()
    arm, lease = active(clock, "ur5e", limits={"tcp_speed_m_s": 0.1})
    fastest = 0.0
    for _ in range(60):
        limits = follow(arm, lease, clock, [-0.1, 0, 0, 0, 0, 0], 0.1)
        fastest = max(fastest, float(np.abs(arm.joints().value.dq).max()))
    assert "singularity" in limits
    assert fastest < 1.5
    assert np.linalg.norm(arm.tcp().value.twist) < 0.03


def test_a_joint_goal_is_reached() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    goal = arm.joints().value.q + 0.2
    arm.go_to_joints(goal, lease, speed_fraction=0.5)
    clock.advance_s(0.2)
    assert not arm.at_rest()
    clock.advance_s(6.0)
    assert arm.at_rest()
    np.testing.assert_allclose(arm.joints().value.q, goal, atol=1e-4)


@pytest.mark.parametrize("physics", ["kinematic", "dynamic"])
def test_contact_forces_act_on_the_arm(physics: str) -> None:
    clock = VirtualClock()
    scene = SceneConfig.model_validate({"physics": physics, "surfaces": {"table": {"kind": "plane"}}}).build(clock)
    # The tip's centre 17 mm above the table: 3 mm deep.
    arm = make(clock, scene=scene, start_pose_mm_deg=(450, 50, 17, 180, 0, 0))
    SimTactip("tip", SimTactipConfig(mounted_on="arm"), clock, scene, arm)
    clock.advance_s(1.0)
    state = scene.contact("tip").value
    sag_mm = 1e3 * arm.T_world_tcp()[2, 3] - 17.0
    assert state.normal_force_n == pytest.approx(1.5 * (3.0 - sag_mm), rel=0.02)
    assert 0.2 < sag_mm < 1.0
    assert np.abs(arm.T_world_tcp()[1, 3] - 0.05) < 1e-4
    if physics == "dynamic":
        # Springs have the stiffness of the depth one step ago.
        stiffness = ContactLaw().shear_stiffness_n_m(state.depth_m)
        np.testing.assert_allclose(state.shear_force_n, -stiffness * state.T_f_s[:2, 3], rtol=1e-2)


def test_a_snapshot_brings_the_joints_back() -> None:
    clock = VirtualClock()
    scene = SceneConfig.model_validate({"surfaces": {"table": {"kind": "plane"}}}).build(clock)
    arm, lease = active(clock, scene=scene)
    follow(arm, lease, clock, [0.05, 0, 0, 0, 0, 0.1], 0.2)
    arm.joints()
    restore = scene.snapshot()
    ends = []
    for _ in range(2):
        # The gate's history is not part of the simulation.
        arm.stop()
        follow(arm, lease, clock, [0.0, 0.05, 0, 0, 0, 0], 0.2)
        ends.append(arm.joints().value.q)
        restore()
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_a_panda_tracks_a_moving_plate_in_a_dynamic_scene(tmp_path: Path) -> None:
    data = yaml.safe_load(Path("configs/object_track_panda_sim.yaml").read_text())
    data["task"]["duration_s"] = 3
    put_on_true_contact(data)
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    depths_mm = []

    def watch(progress: Progress) -> None:
        if progress.state == "run" and progress.t_s > 2.0:
            depths_mm.append(1e3 * cell.scene.contact("sensor").value.depth_m)

    cell = compose(plan_cell(path))
    with cell:
        result = RunLoop(cell, None, on_cycle=watch).run()
    assert result.outcome is Outcome.DONE, result.reason
    assert len(depths_mm) > 100
    assert np.sqrt(np.mean((np.array(depths_mm[50:]) - data["task"]["depth_mm"]) ** 2)) < 0.5


def test_an_unreachable_pose_is_reported() -> None:
    with pytest.raises(ConfigError, match="no inverse kinematics solution"):
        make(VirtualClock(), start_pose_mm_deg=(1500, 0, 300, 180, 0, 0))
    with pytest.raises(ConfigError, match="is not 7 angles"):
        make(VirtualClock(), near_joints_deg=(0, 0, 0, 0, 0, 0))
    with pytest.raises(ValidationError):
        make(VirtualClock(), model="panda", tool="left_angle")


def test_a_right_angle_bracket_reaches_along_the_table() -> None:
    chain = SerialChain(ChainDescription.shipped("panda"), TOOLS["right_angle"])
    along_x = se3.from_euler_mm_deg(np.array([450.0, 0.0, 40.0, 0.0, 90.0, 0.0]))
    q = joints_for_pose(chain, along_x, np.radians([0, 20, 0, -120, 0, 140, 45]))
    np.testing.assert_allclose(chain.forward(q), along_x, atol=1e-8)
    assert ((q > chain.lower) & (q < chain.upper)).all()
