"""Tests against emulators run beside processes with clocks of their own.

A machine that is starved for a tenth of a second can make a lawful driver fault, as the real device would. Such tests
are tried again, twice at most, and pytest counts every such case in its summary; all others have to pass at once. They
run one after another (`-m emulated`), the others on all cores.
"""

from __future__ import annotations

import pytest
from hypothesis import settings

# The same examples every time, and however slow the machine.
settings.register_profile("touchcell", deadline=None, derandomize=True)
settings.load_profile("touchcell")

_BESIDE_EMULATORS = (
    "test_cell_devices",
    "test_conformance",
    "test_damiao",
    "test_emulated_matrix",
    "test_emulated_push",
    "test_emulator_",
    "test_feetech",
    "test_franka",
    "test_opencv_camera",
    "test_process_cell",
    "test_ur",
    "test_v4l2",
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name.startswith(_BESIDE_EMULATORS):
            item.add_marker(pytest.mark.emulated)
            item.add_marker(pytest.mark.flaky(reruns=2))
