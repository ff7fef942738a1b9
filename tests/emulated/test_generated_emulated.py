"""Modules of ``touchcell new hil`` on emulators, on a machine that is too slow for their pace."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.paths import CONFIGS

STALLED = """
import time

WAIT_S = iter((3.0, 0.0))


def test_it_is_kept_from_its_cycles_once(hil_cell):
    hil_cell.run_until("approach")
    time.sleep(next(WAIT_S))
    hil_cell.run_for(0.2)
    assert hil_cell.state == "approach"


def test_it_fails_for_another_reason(hil_cell):
    assert hil_cell.state == "approach"
"""


def test_a_test_whose_loop_the_machine_has_kept_from_a_cycle_is_repeated_at_half_the_pace(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text((CONFIGS / "surface_follow_bench.yaml").read_text())
    assert main(["new", "hil", str(cell), "--out", str(tmp_path)]) == EXIT_OK
    module = tmp_path / "test_cell_hil.py"
    module.write_text(module.read_text() + STALLED)
    chosen = ["-k", "kept_from_its_cycles or another_reason", "--on", "emulated", "--pace", "0.2"]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", module.name, *chosen]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert "1 failed, 1 passed" in done.stdout, done.stdout
    assert "cycles_once: repeated at a pace of 0.1: this machine was late for a control cycle" in done.stdout
    assert done.stdout.count("repeated at a pace") == 1
