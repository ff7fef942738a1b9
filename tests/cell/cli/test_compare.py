"""``touchcell compare``: recordings that are identical, and the first difference of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from touchcell.cell.cli.main import main
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder


def run_folder(folder: Path, x: float, timing: int) -> Path:
    folder.mkdir()
    with Recorder(folder / RECORDING) as recorder:
        messages: list[tuple[str, int, dict[str, Any]]] = [("/a", 1, {"x": 0.5}), ("/a", 2, {"x": x})]
        for topic, t_ns, data in [*messages, ("/timing", 2, {"cycle_us": timing})]:
            recorder.write(topic, t_ns, data)
    return folder


def test_recordings_that_differ_in_durations_alone_are_identical(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = run_folder(tmp_path / "1", 0.1, 5), run_folder(tmp_path / "2", 0.1, 6)
    assert main(["compare", str(first), str(second / RECORDING)]) == 0
    assert "identical bit for bit: 2 messages of 1 topics" in capsys.readouterr().out


def test_the_first_difference_is_printed_and_the_exit_code_is_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = run_folder(tmp_path / "1", 0.1, 5), run_folder(tmp_path / "2", 0.2, 5)
    assert main(["compare", str(first), str(second)]) == 1
    assert "/a: message 1 at 2 ns: x is 0.1, then 0.2" in capsys.readouterr().out


def test_a_folder_without_recording_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = run_folder(tmp_path / "1", 0.1, 5)
    assert main(["compare", str(first), str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
