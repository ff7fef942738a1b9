"""The V4L2 driver beside its emulator, on one simulated time."""

from touchcell.drivers.v4l2.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestV4l2 = suite(rig_in_step)
