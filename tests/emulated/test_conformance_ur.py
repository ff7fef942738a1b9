import pytest

from touchcell.drivers.ur.rig import rig
from touchcell.testing.conformance.suite import suite

pytest.importorskip("rtde_receive")

TestUr = suite(rig)
