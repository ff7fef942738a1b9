"""The conformance suite on the simulated stand-ins of real devices: each keeps what its driver declares."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.damiao import rig as damiao
from touchcell.drivers.feetech import rig as feetech
from touchcell.drivers.franka import rig as franka
from touchcell.drivers.opencv import driver as opencv
from touchcell.drivers.ur import rig as ur
from touchcell.drivers.v4l2 import driver as v4l2
from touchcell.simulation.devices.rig import camera_stand_in_of, stand_in_of
from touchcell.testing.conformance.suite import suite
from touchcell.testing.emulation.rig import DeviceFixture


def ur_stand_in(folder: Path, address: int) -> DeviceFixture:
    return stand_in_of(ur.rig)


def franka_stand_in(folder: Path, address: int) -> DeviceFixture:
    return stand_in_of(franka.rig)


def damiao_stand_in(folder: Path, address: int) -> DeviceFixture:
    return stand_in_of(damiao.rig)


def feetech_stand_in(folder: Path, address: int) -> DeviceFixture:
    return stand_in_of(feetech.rig)


def v4l2_stand_in(folder: Path, address: int) -> DeviceFixture:
    return camera_stand_in_of(v4l2.SPEC, v4l2.V4l2Config(device="/dev/v4l/by-id/usb-TacTip-video-index0", rate_hz=60))


def opencv_stand_in(folder: Path, address: int) -> DeviceFixture:
    return camera_stand_in_of(opencv.SPEC, opencv.OpencvCameraConfig(device="/dev/video0", color="bgr"))


TestUr = suite(ur_stand_in)
TestFranka = suite(franka_stand_in)
TestDamiao = suite(damiao_stand_in)
TestFeetech = suite(feetech_stand_in)
TestV4l2 = suite(v4l2_stand_in)
TestOpencv = suite(opencv_stand_in)


def test_a_camera_stand_in_has_its_drivers_rate_delay_size_and_colour() -> None:
    fixture = opencv_stand_in(Path(), 0)
    clock = fixture.clock()
    camera = fixture.build(clock)
    assert isinstance(camera, FrameSource)
    camera.connect()
    camera.configure()
    camera.activate()
    first = camera.next(-1, 2.0)
    second = camera.next(first.seq, 2.0)
    assert second.t_ns - first.t_ns == pytest.approx(1e9 / 30.0, rel=1e-6)
    # A USB camera delivers one period after the exposure.
    assert clock.now_ns() - second.t_ns >= 33_333_333
    assert second.value.image.shape == (480, 640, 3)
