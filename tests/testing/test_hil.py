"""Tests on real hardware ask the operator; without a terminal there is one clear line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from touchcell.paths import CONFIGS


def test_without_a_terminal_one_line_says_what_to_do(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-m", "hil", "--cell", str(CONFIGS / "surface_follow_sim.yaml"), "-q"]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, stdin=subprocess.DEVNULL)
    assert ran.returncode == 4
    assert "Exit: tests on a bench ask a person first:" in ran.stdout
    assert "--hil-yes" in ran.stdout
    assert "Traceback" not in ran.stdout + ran.stderr
