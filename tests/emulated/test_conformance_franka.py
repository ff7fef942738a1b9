import pytest

from touchcell.drivers.franka.rig import rig
from touchcell.testing.conformance.suite import suite

pytest.importorskip("franky")

TestFranka = suite(rig)
