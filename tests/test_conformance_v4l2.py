from drivers.conformance.suite import suite
from drivers.emulators.rigs.v4l2 import rig

TestV4l2 = suite(rig)
