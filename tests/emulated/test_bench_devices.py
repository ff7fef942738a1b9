"""``touchcell bench devices`` measures a driver and, where it is installed, the vendor's client on the emulator."""

from __future__ import annotations

import json
from pathlib import Path

from touchcell.cell.cli.main import main


def test_every_figure_of_an_arm_is_measured(tmp_path: Path) -> None:
    assert main(["bench", "devices", "--out", str(tmp_path), "--", "feetech_serial"]) == 0
    rows = json.loads((tmp_path / "devices.json").read_text())["rows"]
    ours = rows["feetech_serial"]
    assert "error" not in ours
    assert set(ours) >= {"connect_s", "rate_hz", "age_ms", "wire_ms", "cycle_cpu_us", "stop_kill_mm", "frozen_ms"}
    assert rows["feetech_serial, vendor"].get("rate_hz") or "No module named" in rows["feetech_serial, vendor"]["error"]
