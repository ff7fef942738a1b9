import pytest

from drivers.conformance.suite import suite
from drivers.emulators.rigs.ur import rig

pytest.importorskip("rtde_receive")

TestUr = suite(rig)
