"""The Robotiq driver beside its emulator, on one simulated time."""

from touchcell.drivers.robotiq.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestRobotiq = suite(rig_in_step)
