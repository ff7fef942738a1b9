"""A trip leaves a black box, and ``touchcell why`` explains it with text and a plot."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers import unforeseen
from touchcell.cell.analysis.trip_report import REMEDIES
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_TRIPPED
from touchcell.cell.cli.main import main
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.message_types import Encoder
from touchcell.cell.recording.messages import declared_type
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.paths import CONFIGS
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.faults import ArmFaults

ENCODER = Encoder(declared_type)

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


def run_into_the_wall(folder: Path, **arm: Any) -> Path:
    """Run the shipped cell on true contacts, with a workspace that ends 8 mm after the start."""
    data = yaml.safe_load(SHIPPED.read_text())
    put_on_true_contact(data)
    unforeseen.run_into_the_wall(data)
    data["arms"]["arm"] |= arm
    cell = folder / "cell.yaml"
    cell.write_text(yaml.safe_dump(data))
    assert main(["run", str(cell), "--out", str(folder / "run"), "--quiet"]) == EXIT_TRIPPED
    return folder / "run"


def test_the_ring_keeps_ten_seconds() -> None:
    with BlackBox() as box:
        for k in range(3000):
            box.add([("/task", k * 10_000_000, ENCODER.encode("/task", {"k": k}))])
        # Both ends included.
        assert [message.data["k"] for message in box.messages()] == list(range(1999, 3000))


def test_a_trip_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = run_into_the_wall(tmp_path)
    assert f"touchcell why {folder}" in capsys.readouterr().out
    about = json.loads((folder / "blackbox.json").read_text())
    assert about["cell_sha256"] == hashlib.sha256((folder / "cell.yaml").read_bytes()).hexdigest()
    first = about["causes"][0]
    assert (first["interlock"], first["severity"], first["subject"], first["unit"]) == ("workspace", "trip", "arm", "m")
    assert first["limit"] == pytest.approx(-0.072)
    assert first["value"] > -0.072
    stop = about["stops"]["arm"]
    assert (stop["category"], stop["kept"], stop["escalated"]) == (2, True, False)
    # 20 mm/s at 0.5 m/s^2.
    assert stop["speed_m_s"] == pytest.approx(0.02, rel=0.2)
    assert stop["time_s"] == pytest.approx(0.04, abs=0.02)
    assert stop["distance_m"] == pytest.approx(0.4e-3, rel=0.5)

    assert main(["why", str(folder)]) == EXIT_OK
    output = capsys.readouterr().out
    assert "first cause" in output
    assert "workspace (trip): arm: x = -71." in output
    assert "limit -72 mm" in output
    assert "settle -> run" in output
    assert "mm deep, frames up to" in output
    assert "stopped by category 2 from 2" in output
    assert "at rest after 0.0" in output
    assert (folder / "why.png").stat().st_size > 10_000


def test_the_black_box_holds_the_stop_and_nothing_sent_after_the_trip(tmp_path: Path) -> None:
    folder = run_into_the_wall(tmp_path)
    messages = list(read(folder / "blackbox.mcap"))
    trip_ns = json.loads((folder / "blackbox.json").read_text())["causes"][0]["t_ns"]
    topics = {message.topic for message in messages}
    assert topics >= {"/arms/arm/tcp", "/arms/arm/command", "/sensors/sensor/contact", "/task", "/safety", "/events"}
    assert max(m.t_ns for m in messages if m.topic == "/arms/arm/command") < trip_ns
    assert max(m.t_ns for m in messages if m.topic == "/arms/arm/tcp") > trip_ns
    verdict = next(m for m in messages if m.topic == "/safety")
    assert (verdict.t_ns, verdict.data["allow"]) == (trip_ns, False)
    assert verdict.data["violations"][0].startswith("trip workspace: arm")


def test_the_stop_category_of_the_cell_file_is_used(tmp_path: Path) -> None:
    folder = run_into_the_wall(tmp_path, stop_category=1)
    assert json.loads((folder / "blackbox.json").read_text())["stops"]["arm"]["category"] == 1


def test_a_folder_without_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["why", str(tmp_path)]) == EXIT_BAD_INPUT
    assert "holds nothing of a run" in capsys.readouterr().err


def test_an_arm_that_ignores_every_command_still_leaves_a_black_box(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    honest = SimArm.__init__

    def broken(arm: SimArm, *arguments: Any, **more: Any) -> None:
        honest(arm, *arguments, **more)
        arm.faults = ArmFaults(ignores_stops=True, drift_m_s=0.004)

    monkeypatch.setattr(SimArm, "__init__", broken)
    data = yaml.safe_load(SHIPPED.read_text())
    put_on_true_contact(data)
    unforeseen.run_into_the_wall(data)
    cell, folder = tmp_path / "cell.yaml", tmp_path / "run"
    cell.write_text(yaml.safe_dump(data))
    assert main(["run", str(cell), "--out", str(folder), "--quiet"]) == EXIT_TRIPPED
    capsys.readouterr()
    assert main(["why", str(folder)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "never seen at rest: does not come to rest by any means that its driver has: use the emergency stop" in told
    assert "then " in told
    assert "stop (fault): arm: not seen at rest" in told


def test_limited_tells_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = yaml.safe_load(SHIPPED.read_text())
    put_on_true_contact(data)
    data["arms"]["arm"]["limits"] |= {"tcp_rot_accel_rad_s2": 0.01}
    cell, folder = tmp_path / "cell.yaml", tmp_path / "run"
    cell.write_text(yaml.safe_dump(data))
    assert main(["run", str(cell), "--out", str(folder), "--quiet"]) == EXIT_TRIPPED
    capsys.readouterr()
    assert main(["why", str(folder)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "limited (trip): arm: limited by its gate" in told
    assert "what to do: lower the task's gains" in told


def test_every_kind_of_interlock_has_a_remedy() -> None:
    assert set(REMEDIES) == {*INTERLOCKS.names(), "finite", "missing"}
