from touchcell.drivers.feetech.rig import rig
from touchcell.testing.conformance.suite import suite

TestFeetechSerial = suite(rig)
