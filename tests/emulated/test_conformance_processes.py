"""Checks for which another process uses the device, and those of a device that comes and goes, in real time."""

import pytest

from touchcell.drivers.damiao.rig import rig as damiao_can
from touchcell.drivers.feetech.rig import rig as feetech_serial
from touchcell.drivers.ur.rig import rig as ur
from touchcell.testing.conformance.suite import suite

pytest.importorskip("rtde_control")

_CHECKS = (
    "failed_connect_can_be_retried",
    "killed_client_leaves_the_arm_at_rest",
    "vanished_device_is_a_fault_and_can_return",
)

TestDamiaoCan = suite(damiao_can, only=_CHECKS)
TestFeetechSerial = suite(feetech_serial, only=_CHECKS)
TestUr = suite(ur, only=_CHECKS)
