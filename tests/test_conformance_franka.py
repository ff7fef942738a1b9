from drivers.conformance.suite import suite
from drivers.emulators.rigs.franka import rig

TestDriver = suite(rig)
