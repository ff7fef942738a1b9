"""The linter's own rules about the layout."""

from __future__ import annotations

import subprocess
import sys

import pytest

from touchcell.paths import CHECKOUT

LINKS = ("control", "drivers", "perception", "tasks")


def _ruff(*arguments: str, source: str = "") -> str:
    pytest.importorskip("ruff", reason="ruff is not installed (extra `dev`)")
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", *arguments]
    return subprocess.run(command, cwd=CHECKOUT, input=source, capture_output=True, text=True, check=False).stdout


@pytest.mark.parametrize("name", ["cell", "configs", "control", "drivers", "geometry", "perception", "tasks"])
@pytest.mark.parametrize("form", ["import {}", "import {}.core", "from {} import core", "from {}.core import thing"])
def test_a_room_imported_by_its_bare_name_is_refused(name: str, form: str) -> None:
    printed = _ruff("--select", "TID", "--stdin-filename", "touchcell/example.py", "-", source=form.format(name) + "\n")
    assert f"Import touchcell.{name}." in printed


def test_each_file_is_checked_once_although_links_lead_to_some() -> None:
    checked = _ruff("--show-files").splitlines()
    assert [link for link in LINKS if not (CHECKOUT / link).is_symlink()] == []
    assert not [file for file in checked if any(file.startswith(f"{CHECKOUT / link}/") for link in LINKS)]
    assert str(CHECKOUT / "touchcell" / "drivers" / "__init__.py") in checked
