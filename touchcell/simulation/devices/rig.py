"""Test fixtures of in-process devices on virtual time, with a stand-in for the emulator."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchcell.drivers.core.behaviour import CameraBehaviour
from touchcell.drivers.core.clock import Clock, VirtualClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.spec import AnyDriver, DriverConfig, DriverContext
from touchcell.drivers.core.stand_in import Placement
from touchcell.drivers.replay import camera as replay_camera
from touchcell.simulation.devices import arm as sim_arm
from touchcell.simulation.devices import joint_arm as sim_joint_arm
from touchcell.simulation.devices import tactip as sim_tactip
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.devices.joint_arm import SimJointArm
from touchcell.simulation.devices.stand_in_arm import StandInArm, stand_in
from touchcell.simulation.devices.stand_in_camera import stand_in as camera_stand_in
from touchcell.simulation.faults import FrameFaults
from touchcell.simulation.scene import SceneConfig
from touchcell.testing.emulation.rig import DeviceFixture, FixtureFactory

_START = (400.0, 0.0, 300.0, 180.0, 0.0, 30.0)
_IMAGES = 90


class StandIn:
    """Stand-in for the emulator of an in-process device, which provides the ground truth itself.

    Args:
        truth: returns the ground truth.
        faults: called when a fault begins (with its value) and ends (with None).
        end: called to make the emulator vanish.
    """

    def __init__(
        self,
        truth: Callable[[], dict[str, Any]] = dict,
        faults: dict[str, Callable[[Any], None]] | None = None,
        end: Callable[[], None] = lambda: None,
    ) -> None:
        self._truth = truth
        self._faults = faults or {}
        self._end = end

    def state(self) -> dict[str, Any]:
        return self._truth()

    def fault(self, name: str, value: Any = True) -> dict[str, Any]:
        self._faults[name](value)
        return self.state()

    def clear(self, name: str) -> dict[str, Any]:
        self._faults[name](None)
        return self.state()

    def freeze(self) -> None:
        """Do nothing: an in-process device cannot hang while its client runs."""

    def thaw(self) -> None:
        """Do nothing: it never hangs."""

    def kill(self) -> None:
        self._end()

    def stop(self) -> None:
        self._end()


def sim_arm_rig(folder: Path, address: int) -> DeviceFixture:
    """Build a simulated arm without a scene."""
    return _arm_rig(sim_arm.SPEC, sim_arm.SimArmConfig(start_pose_mm_deg=_START))


def sim_joint_arm_rig(folder: Path, address: int) -> DeviceFixture:
    """Build a simulated Panda without a scene."""
    return _arm_rig(sim_joint_arm.SPEC, sim_joint_arm.SimJointArmConfig(model="panda", start_pose_mm_deg=_START))


def _arm_rig(spec: AnyDriver, config: DriverConfig, state_rate_hz: float | None = None) -> DeviceFixture:
    arms: list[SimArm | SimJointArm | StandInArm] = []

    def build(clock: Clock) -> Device:
        arm = spec.build("arm", config, DriverContext(clock))
        assert isinstance(arm, SimArm | SimJointArm | StandInArm)
        arms.append(arm)
        return arm

    def truth() -> dict[str, Any]:
        # Simulated time advances on reads; in the scene the camera does that.
        arms[-1].health()
        T = arms[-1].T_world_tcp()
        return {"T_base_tcp": T.tolist(), "position_m": T[:3, 3].tolist()}

    return DeviceFixture(
        spec=spec,
        start=lambda: StandIn(truth),
        build=build,
        energising=None,
        pose="T_base_tcp",
        clock=VirtualClock,
        process=False,
        state_rate_hz=state_rate_hz,
    )


def sim_tactip_rig(folder: Path, address: int) -> DeviceFixture:
    """Build a simulated sensor on a simulated arm above a plane."""
    return _camera_rig(sim_tactip.SPEC, sim_tactip.SimTactipConfig(mounted_on="arm"))


def camera_stand_in_of(spec: AnyDriver, config: DriverConfig) -> DeviceFixture:
    """Build the simulated stand-in for the camera of another driver, on a simulated arm above a plane."""
    found = camera_stand_in(spec, Placement(mounted_on="arm"))
    behaviour = None if spec.behaviour is None else spec.behaviour(config)
    assert isinstance(behaviour, CameraBehaviour)
    return _camera_rig(found, config, behaviour.rate_hz)


def _camera_rig(spec: AnyDriver, config: DriverConfig, state_rate_hz: float | None = None) -> DeviceFixture:
    cameras: list[sim_tactip.SimTactip] = []

    def build(clock: Clock) -> Device:
        scene = SceneConfig.model_validate({"surfaces": {"table": {"kind": "plane"}}}).build(clock)
        context = DriverContext(clock, scene=scene)
        arm = sim_arm.SPEC.build("arm", sim_arm.SimArmConfig(start_pose_mm_deg=_START), context)
        camera = spec.build("tip", config, DriverContext(clock, {"arm": arm}, scene))
        assert isinstance(camera, sim_tactip.SimTactip)
        cameras.append(camera)
        return camera

    def pause(value: Any) -> None:
        last = cameras[-1].latest().seq if value is not None else None
        cameras[-1].faults = FrameFaults(last_seq=last)

    def delay(value: Any) -> None:
        cameras[-1].faults = FrameFaults(extra_latency_s=value or 0.0)

    return DeviceFixture(
        spec=spec,
        start=lambda: StandIn(faults={"pause": pause, "delay": delay}),
        build=build,
        energising=None,
        position=None,
        faults={"pause": (True, "stale"), "delay": (0.5, "stale")},
        clock=VirtualClock,
        process=False,
        state_rate_hz=state_rate_hz,
    )


def replay_camera_rig(folder: Path, address: int) -> DeviceFixture:
    """Build a camera that replays a folder of small images."""
    images = folder / "images"

    def start() -> StandIn:
        images.mkdir()
        for number in range(_IMAGES):
            image = np.full((48, 64), 2 * number, np.uint8)
            cv2.imwrite(str(images / f"image_{number}.png"), image)
        return StandIn(end=lambda: shutil.rmtree(images))

    config = replay_camera.ReplayCameraConfig(data=images, rate_hz=30.0)
    return DeviceFixture(
        spec=replay_camera.SPEC,
        start=start,
        build=lambda clock: replay_camera.SPEC.build("replay", config, DriverContext(clock)),
        energising=None,
        position=None,
        clock=VirtualClock,
        process=False,
    )


def stand_in_of(rig: FixtureFactory) -> DeviceFixture:
    """Build the simulated stand-in for the arm of another driver's fixture, with its configuration."""
    real = rig(Path(), 0)
    assert real.config is not None
    return _arm_rig(stand_in(real.spec, Placement()), real.config, real.state_rate_hz)
