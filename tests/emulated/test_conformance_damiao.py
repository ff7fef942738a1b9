from touchcell.drivers.damiao.rig import rig
from touchcell.testing.conformance.suite import suite

TestDamiaoCan = suite(rig)
