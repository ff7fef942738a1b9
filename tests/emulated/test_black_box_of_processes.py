"""A cell of several processes whose task's process is killed: the black box is there, and the watchdog's note."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.emulated.test_process_cell import separate_cell
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.runtime.black_box import read_left_ring
from touchcell.cell.runtime.watchdog import NOTES


def test_the_task_is_killed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell, out = separate_cell(tmp_path), tmp_path / "run"
    command = [sys.executable, "-m", "tests.helpers.dying_run", "60", "SIGKILL", str(cell), str(out)]
    dead = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert dead.returncode < 0, dead.stdout + dead.stderr
    _, messages = read_left_ring(out)
    # The messages of a cycle are kept together.
    assert 60 <= len(messages) < 80
    assert main(["why", str(out)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "ended without a result" in told
    assert "evidence: blackbox.ring" in told
    if (out / NOTES).exists():
        assert "the watchdog noted" in told
