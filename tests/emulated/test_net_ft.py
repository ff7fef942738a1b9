"""A run that a force-torque sensor ends, beside the emulated box in a process of its own."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import pytest

from tests.drivers.net_ft.test_cell import cell_file
from tests.helpers.bus_arms import running
from touchcell.cell.cli.main import main
from touchcell.drivers.net_ft.rig import rig

ADDRESSES = itertools.count(os.getpid() % 30_000 * 16 + 8)


def test_a_push_on_the_sensor_stops_the_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fixture = rig(tmp_path, next(ADDRESSES))
    assert fixture.config is not None
    monkeypatch.chdir(tmp_path)
    for box in running(fixture):
        box.fault("wrench", [0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
        code = main(["run", str(cell_file(tmp_path, str(fixture.config.host))), "--quiet"])  # type: ignore[attr-defined]
    assert code == 3
    assert "pushed: ft: force on the tool 30 N, limit 20 N" in capsys.readouterr().out
