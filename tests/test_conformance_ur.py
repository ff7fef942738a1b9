from drivers.conformance.suite import suite
from drivers.emulators.rigs.ur import rig

TestDriver = suite(rig)
