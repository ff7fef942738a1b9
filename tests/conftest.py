"""Tests in tests/emulated run beside processes with clocks of their own, one after another (`-m emulated`).

All others run on all cores; drivers are tested beside their emulators on one simulated time there.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

# The same examples every time, and however slow the machine.
settings.register_profile("touchcell", deadline=None, derandomize=True)
settings.load_profile("touchcell")

_EMULATED = Path(__file__).parent / "emulated"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(_EMULATED):
            item.add_marker(pytest.mark.emulated)
