"""The Damiao driver beside its emulator, on one simulated time."""

from touchcell.drivers.damiao.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestDamiaoCan = suite(rig_in_step)
