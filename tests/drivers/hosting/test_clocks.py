"""Nothing between a task and its arms reads a clock that can be set, so a step of it changes nothing."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fault_injection.clock_step import clock_shim

ROOT = Path(__file__).parents[3]
SETTABLE = {
    "time.time",
    "time.time_ns",
    "time.localtime",
    "time.gmtime",
    "time.ctime",
    "time.strftime",
    "time.CLOCK_REALTIME",
    "time.CLOCK_TAI",
    "datetime.now",
    "datetime.utcnow",
    "datetime.today",
    "date.today",
}
FOR_PEOPLE = {
    ROOT / "touchcell" / "cell" / "runtime" / "bench_lock.py",
    ROOT / "touchcell" / "cell" / "runtime" / "run_directory.py",
    ROOT / "touchcell" / "cell" / "ui" / "runs.py",
    ROOT / "touchcell" / "cell" / "analysis" / "provenance.py",
    ROOT / "touchcell" / "cell" / "cli" / "run_description.py",
}
"""They say since when a bench is taken, name the run folder, and date a figure or a recording."""


def reads(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = f"{node.value.id}.{node.attr}"
            if name in SETTABLE:
                yield name
        if isinstance(node, ast.ImportFrom) and node.module in ("time", "datetime"):
            yield from (f"{node.module}.{alias.name}" for alias in node.names if f"time.{alias.name}" in SETTABLE)


def test_no_clock_that_can_be_set_is_read() -> None:
    found = {}
    for path in (ROOT / "touchcell").rglob("*.py"):
        # Emulators are the other side of the wire, and benchmarks run nothing that moves.
        if {"emulator", "emulator.py", "testing", "bench"} & set(path.parts) or path in FOR_PEOPLE:
            continue
        if names := list(reads(path.read_text())):
            found[str(path)] = names
    assert found == {}
    assert list(reads("import time\ntime.time()\n")) == ["time.time"], "the search finds what it looks for"


def test_the_shim_of_the_bench_steps_the_wall_clock_of_a_process_and_no_other_clock(tmp_path: Path) -> None:
    """``touchcell bench safety -- --processes`` sets the clock of a whole cell by it."""
    library = clock_shim(tmp_path)
    if library is None:
        pytest.skip("no C compiler")
    offset = tmp_path / "offset"
    offset.write_bytes((-3600).to_bytes(8, "little", signed=True))
    script = "import json, time; print(json.dumps([time.time(), time.monotonic()])); time.sleep(0.01)"
    before = time.time(), time.monotonic()
    run = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"LD_PRELOAD": str(library), "TOUCHCELL_CLOCK": str(offset)},
        capture_output=True,
        text=True,
        check=True,
    )
    wall_s, monotonic_s = json.loads(run.stdout)
    assert before[0] - 3600.0 <= wall_s <= time.time() - 3600.0
    assert before[1] <= monotonic_s <= time.monotonic()
