"""``touchcell probe`` and ``touchcell devices``."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from touchcell.cell.cli import discovery
from touchcell.cell.cli.devices import print_devices, probe_cell
from touchcell.cell.cli.discovery import Found
from touchcell.cell.cli.exit_codes import EXIT_DEVICE_LOST, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.drivers.damiao import rig as damiao_can
from touchcell.drivers.ur import rig as ur
from touchcell.paths import CONFIGS


def cell_of(path: Path, **arm: object) -> Path:
    """The simulated cell with its arm replaced by another driver's."""
    cell = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    cell["time"] = "real"
    cell["arms"]["arm"] = {"deactivate": "hold", **arm}
    cell["sensors"]["sensor"] = {
        "driver": "v4l2",
        "device": "/dev/no-such-camera",
        "estimator": {"kind": "network", "model": "builtin:sim_gdn"},
        "mounted_on": "arm",
    }
    del cell["scene"]
    path.write_text(yaml.safe_dump(cell))
    return path


def test_probe_reports_state_and_health_of_every_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["probe", str(CONFIGS / "surface_follow_sim.yaml")]) == EXIT_OK
    told = capsys.readouterr().out
    assert "arm (sim_arm): passive, answers" in told
    assert "tool at          [-80.0, 0.0, 25.0, 180.0, 0.0, 0.0] mm, deg" in told
    assert "sensor (sim_tactip): passive, answers" in told


def test_probe_energises_nothing_and_continues_after_a_missing_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = damiao_can.rig(tmp_path, 1)
    assert rig.start is not None
    emulator = rig.start()
    try:
        config = damiao_can.config(tmp_path / "can-1").model_dump(mode="json")
        path = cell_of(tmp_path / "cell.yaml", driver="damiao_can", **config)
        probes = probe_cell(path)
        assert emulator.state()["energising"] == 0
        assert not emulator.state()["energised"]
        arm, camera = probes
        assert arm.error is None
        assert dict(arm.readings)["enabled"] == "0"
        assert camera.error is not None
        assert camera.error.device == "sensor"
        assert main(["probe", str(path)]) == EXIT_DEVICE_LOST
        assert "sensor (v4l2): DOES NOT ANSWER" in capsys.readouterr().out
    finally:
        emulator.stop()


def test_probe_of_an_arm_that_is_off(tmp_path: Path) -> None:
    pytest.importorskip("rtde_receive")
    path = cell_of(tmp_path / "cell.yaml", driver="ur", host=ur.host_of(7), flange_to_tcp_mm_deg=[0] * 6)
    arm, _ = probe_cell(path)
    assert arm.error is not None
    assert arm.readings == ()


def test_devices_are_listed_with_what_they_need(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = Found("camera", "/dev/v4l/by-id/usb-TacTip", "/dev/video0", "TacTip on usb-1", ("may not be opened: join",))
    monkeypatch.setattr(discovery, "cameras", lambda: [found])
    monkeypatch.setattr(discovery, "serial_ports", lambda: [])
    monkeypatch.setattr(discovery, "can_interfaces", lambda: [])
    print_devices()
    assert capsys.readouterr().out.splitlines() == [
        "cameras",
        "  /dev/v4l/by-id/usb-TacTip (now /dev/video0): TacTip on usb-1",
        "    may not be opened: join",
        "serial ports: none",
        "CAN interfaces: none",
    ]
