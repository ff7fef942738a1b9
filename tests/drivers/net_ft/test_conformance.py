"""The Net F/T driver beside its emulator, on one simulated time."""

from touchcell.drivers.net_ft.rig import rig_in_step
from touchcell.testing.conformance.suite import suite

TestNetFt = suite(rig_in_step)
