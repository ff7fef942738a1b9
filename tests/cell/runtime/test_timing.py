from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.cell.runtime.test_run import true_contact_cell
from touchcell.cell.cli.main import main
from touchcell.cell.recording.mcap import read
from touchcell.cell.runtime.timing import MOST_KEPT, CycleTimes


def test_a_cycle_adds_up_its_sensors() -> None:
    times = CycleTimes()
    times.begin()
    times.add("read frame", 1_000_400)
    times.add("read frame", 2_000_000)
    times.add("cycle", 5_000_000)
    assert times.message() == {"read_frame_us": 3000, "cycle_us": 5000}
    times.begin()
    times.add("cycle", 7_000_000)
    assert times.message() == {"cycle_us": 7000}
    assert list(times.rows["read frame"]) == [1_000_400, 2_000_000]
    assert list(times.rows["cycle"]) == [5_000_000, 7_000_000]


def test_a_long_run_takes_no_more_memory() -> None:
    times = CycleTimes()
    for k in range(2 * MOST_KEPT + 10):
        times.add("cycle", k)
    kept = np.array(times.rows["cycle"])
    assert MOST_KEPT // 2 <= len(kept) <= MOST_KEPT
    np.testing.assert_array_equal(kept, np.arange(kept[0], 2 * MOST_KEPT + 10))


def test_stages_are_on_file_and_in_the_report(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert main(["run", str(true_contact_cell(tmp_path)), "--out", str(folder), "--quiet"]) == 0
    rows = [message.data for message in read(folder / "run.mcap") if message.topic == "/timing"]
    assert len(rows) == json.loads((folder / "result.json").read_text())["cycles"]
    parts = ("read_arms_us", "sense_us", "task_and_control_us", "supervisor_us", "gate_and_send_us")
    assert set(parts) < set(rows[0])
    for row in rows:
        # Sensing includes reading the arms; every figure is rounded.
        assert abs(sum(row[part] for part in parts[1:]) - row["cycle_us"]) <= 4
        assert row["read_arms_us"] <= row["sense_us"] + 1
    assert (folder / "budget.png").stat().st_size > 5_000
