"""The C extensions for tests that compare them with the plain code."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import pytest

from touchcell.compiled import REQUIRE


def extension(name: str) -> Any:
    """The C extension; without it the test is skipped, or fails if ``TOUCHCELL_REQUIRE_COMPILED`` is set."""
    if os.environ.get(REQUIRE):
        return import_module(name)
    return pytest.importorskip(name)
