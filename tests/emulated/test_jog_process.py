"""A jog that is killed while it moves an emulated arm leaves that arm at rest."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.jog_terminal import JogTerminal
from touchcell.paths import CONFIGS
from touchcell.testing.emulation.world import running_emulators

_BUSY = 4.0
_MOVED_M = 2e-3
_STILL_M = 2e-5
_LONGEST_S = 1.5
"""Time-to-live, the controller's own watchdog and its braking, and as much for a busy machine."""


def test_an_arm_whose_jog_is_killed_stands_soon_after(tmp_path: Path) -> None:
    if os.getloadavg()[0] > _BUSY * (os.cpu_count() or 1):
        pytest.skip("three processes keep no time on a machine as busy as this")
    with running_emulators(CONFIGS / "surface_follow_bench.yaml") as cell:
        path = tmp_path / "cell.yaml"
        path.write_text(cell.plan.text())

        def place() -> np.ndarray:
            return np.array(cell.process.state()["sensors"]["sensor"])[:3, 3]

        start = place()
        with JogTerminal("jog", str(path), "--out", str(tmp_path / "run")) as terminal:
            terminal.hold(b"", terminal.shows("idle"), limit_s=60.0)
            terminal.hold(b"o", lambda: bool(np.linalg.norm(place() - start) > _MOVED_M))
            terminal.kill()
            killed_s = time.monotonic()
        while time.monotonic() < killed_s + _LONGEST_S:
            before = place()
        state = cell.process.state()
    after = np.array(state["sensors"]["sensor"])[:3, 3]
    assert np.linalg.norm(after - before) < _STILL_M
    assert after[2] - start[2] > 0.9 * _MOVED_M
    moved_s = (state["moved_ns"]["arm"] * 1e-9) - killed_s
    assert moved_s < 0.5 * _LONGEST_S
