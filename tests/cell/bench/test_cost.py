"""``touchcell bench cost`` measures a process that does the same as ``touchcell run``."""

from __future__ import annotations

from pathlib import Path

from touchcell.cell.bench.cost import measure, replaying
from touchcell.cell.bench.perception import write_simulated
from touchcell.drivers.replay.dataset import IMAGE_FOLDER


def test_a_serving_process_tells_what_it_takes(tmp_path: Path) -> None:
    write_simulated(tmp_path, 6)
    row = measure(replaying(tmp_path / IMAGE_FOLDER), "run", starts=1)
    assert 40.0 < row["memory_mb"] <= row["peak_mb"] < 300.0
    assert 0.0 < row["ready_cpu_s"] < 60.0
    assert row["cycle_us"] > 0.0
    assert row["heavy"] == ["cv2", "onnxruntime"]
