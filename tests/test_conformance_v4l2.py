from drivers.conformance.suite import suite
from drivers.emulators.rigs.v4l2 import rig

TestDriver = suite(rig)
