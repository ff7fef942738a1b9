"""The Feetech driver beside its emulator, on one simulated time."""

from touchcell.drivers.feetech.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestFeetechSerial = suite(rig_in_step)
