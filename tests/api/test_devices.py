"""Devices of the Python API are given back however the block that uses them ends."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import touchcell as tc
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import LifecycleError, Rejection

START = [0.0, 0.0, 200.0, 180.0, 0.0, 0.0]


def move_until_interrupted(arm: tc.ConnectedArm) -> None:
    with arm.control() as control:
        control.send_twist([0.05, 0, 0, 0, 0, 0])
        raise KeyboardInterrupt


def test_an_arm_moves_and_is_given_back() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm:
        assert arm.state == "ready"
        with arm.control() as control:
            control.move([0.0, 0.0, 0.01, 0.0, 0.0, 0.0], duration_s=1.0)
            assert arm.device.at_rest()  # type: ignore[attr-defined]
        assert arm.state == "ready"
        assert arm.pose_mm_deg()[2] == pytest.approx(210.0, abs=0.5)
    assert arm.state == "disconnected"


def test_an_arm_goes_to_a_pose_and_stands_there() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=np.array(START)) as arm, arm.control() as control:
        control.move_to([10, 30, 180, 170, 0, 20], speed_mm_s=50)
        np.testing.assert_allclose(arm.pose_mm_deg(), [10, 30, 180, 170, 0, 20], atol=0.15)
        assert arm.device.at_rest()  # type: ignore[attr-defined]


def test_an_exception_while_moving_stops_the_arm_and_gives_up_the_lease() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm:
        with pytest.raises(KeyboardInterrupt):
            move_until_interrupted(arm)
        assert arm.state == "ready"
        assert arm.device.owner is None  # type: ignore[attr-defined]
        before = arm.pose()
        np.testing.assert_array_equal(arm.pose(), before)


def test_an_arm_that_does_not_arrive_is_stopped() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm, arm.control() as control:
        with pytest.raises(tc.NotArrived) as caught:
            control.move_to([0, 0, 400, 180, 0, 0], speed_mm_s=10, timeout_s=0.5)
        assert arm.device.at_rest()  # type: ignore[attr-defined]
        assert 0.2 < caught.value.T_base_tcp[2, 3] < 0.21


def test_two_programs_cannot_command_one_arm() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm, arm.control(owner="first"):
        with pytest.raises(tc.CommandRejected) as caught, arm.control(owner="second"):
            pass
        assert caught.value.reason is Rejection.LEASE
        assert arm.state == "active"


def test_what_is_not_finite_is_refused() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm, arm.control() as control:
        with pytest.raises(tc.CommandRejected) as caught:
            control.send_twist([np.nan, 0, 0, 0, 0, 0])
        assert caught.value.reason is Rejection.NON_FINITE


def test_control_is_only_inside_its_block() -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=START) as arm:
        with arm.control() as control:
            pass
        with pytest.raises(tc.CommandRejected):
            control.send_twist(np.zeros(6))
    with pytest.raises(LifecycleError):
        arm.pose()


def test_mistakes_name_the_driver_and_the_key() -> None:
    with pytest.raises(tc.ConfigError, match="did you mean 'sim_arm'"):
        tc.connect_arm("sim_am")
    with pytest.raises(
        tc.ConfigError, match=r"sim_arm: start_pose: unknown key \(did you mean 'start_pose_mm_deg'\?\)"
    ):
        tc.connect_arm("sim_arm", start_pose=START, start_pose_mm_deg=START)
    with pytest.raises(tc.ConfigError, match="drives no camera"):
        tc.connect_camera("sim_arm", start_pose_mm_deg=START)
    with pytest.raises(tc.ConfigError, match="drives no arm"):
        tc.connect_arm("replay_camera", data=".")


def test_a_camera_delivers_each_image_once_and_ends(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"image_{number}.png"), np.full((8, 8), 10 * number, np.uint8))
    with tc.connect_camera("replay_camera", data=str(tmp_path)) as camera:
        assert [int(image[0, 0]) for image in camera] == [0, 10, 20]
    assert repr(camera) == "<ConnectedCamera 'camera': driver replay_camera, disconnected>"


def test_the_devices_of_a_cell_share_its_scene() -> None:
    with tc.connect_cell("surface_follow_sim") as cell:
        estimator = tc.load_estimator()
        with cell.arms["arm"].control() as control:
            control.move([0, 0, -0.008, 0, 0, 0], duration_s=1.0)
            contact = estimator.predict(cell.cameras["sensor"].read())
        assert "sim_tactip, ready" in repr(cell)
    assert contact.pose_mm_deg[2] == pytest.approx(3.0, abs=0.5)
    assert (contact.sigma_mm_deg > 0.0).all()
    assert all(device.state == "disconnected" for device in (*cell.arms.values(), *cell.cameras.values()))


def test_what_is_printed_of_a_device_names_it_and_its_state() -> None:
    arm = tc.connect_arm("sim_arm", name="leader", start_pose_mm_deg=START)
    assert repr(arm) == "<ConnectedArm 'leader': driver sim_arm, disconnected>"
    assert repr(arm.device) == "<SimArm 'leader': disconnected>"
    assert arm.device.state is Lifecycle.DISCONNECTED
