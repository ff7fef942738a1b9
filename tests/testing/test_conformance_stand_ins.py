"""The conformance suite on the simulated stand-ins of real arms: each keeps what its driver declares."""

from __future__ import annotations

from pathlib import Path

from touchcell.drivers.damiao import rig as damiao
from touchcell.drivers.feetech import rig as feetech
from touchcell.drivers.franka import rig as franka
from touchcell.drivers.ur import rig as ur
from touchcell.simulation.devices.rig import stand_in_of
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


TestUr = suite(ur_stand_in)
TestFranka = suite(franka_stand_in)
TestDamiao = suite(damiao_stand_in)
TestFeetech = suite(feetech_stand_in)
