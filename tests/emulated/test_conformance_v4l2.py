from touchcell.drivers.v4l2.rig import rig
from touchcell.testing.conformance.suite import suite

TestV4l2 = suite(rig)
