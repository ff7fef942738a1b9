"""Tests against emulators run beside processes with clocks of their own.

A machine that is starved for a tenth of a second can make a lawful driver fault, as the real device would. Such tests
are tried again, twice at most, and pytest counts every such case in its summary; all others have to pass at once. They
run one after another (`-m emulated`), the others on all cores.
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
