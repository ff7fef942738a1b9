"""Tests on real hardware ask the operator; without a terminal there is one clear line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def _pytest(folder: Path, cell: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-m", "hil", "--cell", cell, "-q"]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, stdin=subprocess.DEVNULL, check=False)


def test_without_a_terminal_one_line_says_what_to_do(tmp_path: Path) -> None:
    """The cell ships, and is found by its name."""
    ran = _pytest(tmp_path, "surface_follow_sim.yaml")
    assert ran.returncode == 4
    assert "Exit: tests on a bench ask a person first:" in ran.stdout
    assert "--hil-yes" in ran.stdout
    assert "Traceback" not in ran.stdout + ran.stderr


def test_a_cell_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    ran = _pytest(tmp_path, "nothere.yaml")
    assert ran.returncode == 4
    assert "--cell nothere.yaml: no such file" in ran.stdout + ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr
