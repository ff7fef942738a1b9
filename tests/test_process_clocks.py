"""Nothing between a task and its arms reads a clock that can be set, so a step of it changes nothing."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
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
FOR_PEOPLE = {ROOT / "cell" / "run.py", ROOT / "cell" / "provenance.py"}
"""They name the run folder and date a figure."""


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
    for package in ("geometry", "drivers", "control", "perception", "tasks", "cell"):
        for path in (ROOT / package).rglob("*.py"):
            # Emulators are the other side of the wire.
            if "emulators" in path.parts or path in FOR_PEOPLE:
                continue
            if names := list(reads(path.read_text())):
                found[str(path)] = names
    assert found == {}
    assert list(reads("import time\ntime.time()\n")) == ["time.time"], "the search finds what it looks for"
