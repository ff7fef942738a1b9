"""The UR driver beside its emulator, on one simulated time."""

from touchcell.drivers.ur.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestUr = suite(rig_in_step)
