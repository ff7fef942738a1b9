from drivers.conformance.suite import suite
from drivers.emulators.rigs.damiao_can import rig

TestDamiaoCan = suite(rig)
