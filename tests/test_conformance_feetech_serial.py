from drivers.conformance.suite import suite
from drivers.emulators.rigs.feetech_serial import rig

TestFeetechSerial = suite(rig)
