"""A force-torque sensor in a cell: a wrench on it stops the arm, as on an arm that measures its own."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import pytest
import yaml

from touchcell.cell.cli.main import main
from touchcell.paths import CONFIGS

ADDRESSES = itertools.count(os.getpid() % 30_000 * 16 + 600_000)


def cell_file(folder: Path, host: str, **changes: object) -> Path:
    cell = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    cell["time"] = "real"
    cell["devices"] = {"ft": {"driver": "net_ft", "host": host, "max_silence_s": 0.5}}
    cell["interlocks"]["pushed"] = {"kind": "wrench", "device": "ft", "limit_n": 20, "limit_nm": 2} | changes
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(cell))
    return path


def test_check_proves_that_the_wrench_of_a_sensor_trips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(cell_file(tmp_path, "127.0.0.1"))]) == 0
    assert "pushed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arm": "arm"}, "either the arm or the device"),
        ({"device": None}, "either the arm or the device"),
        ({"device": "tf"}, "known: ft"),
    ],
)
def test_a_wrench_of_no_or_of_two_sources_is_refused(
    changes: dict[str, object], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(cell_file(tmp_path, "127.0.0.1", **changes))]) != 0
    assert message in capsys.readouterr().err
