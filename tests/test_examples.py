"""Every example runs by itself, from anywhere, and prints what it promises."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"

PRINTS = {
    "move_arm": r".*driver sim_arm, ready>\nat .* 49\.9 +150\.\d .*at .* 49\.9 +1(69|70)\.\d .*",
    "estimate_contact": r"(depth \d\.\d\d mm, standard deviation 0\.\d\d mm, in range: True\n){3}",
    "run_cell": r"<CellRun 'surface_follow_sim': done after .*",
    "compare_gains": r"gain 4 1/s: done, depth error \d\.\d+ mm RMS\ngain 8 1/s: done, depth error \d\.\d+ mm RMS\n",
    "plot_run": r"<RunRecording .*: done, .*wrote runs/surface_follow_sim-\d+-\d+/depth\.png\n",
    "own_task": r"<CellRun 'surface_follow_sim': done after \d\.\d\d s, .*",
    "own_interlock": r"z 0\.4 m: motion allowed\nz 0\.6 m: motion stopped: .*z = 600 mm.*\nz 0\.4 m: motion stopped.*",
    "own_camera": r"<ConnectedCamera 'camera': driver noise, ready> \[\(480, 640\), \(480, 640\), \(480, 640\)\]\n",
}


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("*.py") if path.stem != "__init__"))
def test_an_example_runs_and_prints_what_it_promises(name: str, tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:touchcell", EXAMPLES / f"{name}.py"],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert ran.returncode == 0, ran.stderr
    assert re.fullmatch(PRINTS[name], ran.stdout, re.DOTALL), ran.stdout


def test_an_example_is_short() -> None:
    for path in EXAMPLES.glob("*.py"):
        lines = [line for line in path.read_text().splitlines() if line.strip()]
        assert len(lines) <= 45, path.name
