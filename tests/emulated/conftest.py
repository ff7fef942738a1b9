"""Tests here run in real time, as a cell does: where it is permitted they come before the machine's other load."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest

PRIORITY = -15


@pytest.fixture(scope="session", autouse=True)
def priority() -> Iterator[None]:
    """Emulators and clients that a test starts inherit it; so do its threads."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(before, PRIORITY))
    yield
    os.setpriority(os.PRIO_PROCESS, 0, before)
