import pytest

from drivers.conformance.suite import suite
from drivers.emulators.rigs.franka import rig

pytest.importorskip("franky")

TestFranka = suite(rig)
