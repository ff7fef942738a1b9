"""``configs/dual_push_emulated.yaml``: two arms and two cameras, each through its real driver, push a prism."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from touchcell.cell.analysis.run_data import load_run
from touchcell.cell.cli.emulate_cell import CellEmulator
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING
from touchcell.drivers.v4l2.shim import environment
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS
from touchcell.testing.emulation.process import EmulatorProcess

SHIPPED = CONFIGS / "dual_push_emulated.yaml"
SENSORS = ("leader_sensor", "follower_sensor")
_BUSY = 2.0


def shipped(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The shipped cell with a change."""
    data = yaml.safe_load(SHIPPED.read_text())
    change(data)
    path.write_text(yaml.safe_dump(data))
    return path


def push_shortly(data: dict[str, Any]) -> None:
    """A target a few centimetres away, other addresses, and patience with a machine on which much else runs."""
    data["arms"]["leader"]["host"], data["arms"]["follower"]["host"] = "127.97.3.2", "127.97.3.3"
    data["task"]["target_mm"] = [450, 5]
    data["interlocks"]["stale_frame"]["limit_ms"] = 1000
    data["interlocks"]["stale_arm"]["limit_ms"] = 1000
    for sensor in SENSORS:
        data["sensors"][sensor]["stall_s"] = 3.0


def test_emulated_arms_and_cameras_push_a_prism_unknown_to_the_cell(tmp_path: Path) -> None:
    pytest.importorskip("franky")
    pytest.importorskip("rtde_receive")
    cell, cameras, out = shipped(tmp_path / "cell.yaml", push_shortly), tmp_path / "cameras", tmp_path / "run"
    cameras.mkdir()
    with EmulatorProcess("cell", str(cell), "--folder", str(cameras), timeout_s=60.0) as emulator:
        before = np.array(emulator.state()["objects"]["prism"])[:3, 3]
        done = subprocess.run(
            [sys.executable, "-m", "touchcell", "run", str(cell), "--out", str(out), "--quiet"],
            env=os.environ | environment(cameras),
            capture_output=True,
            text=True,
            timeout=90,
            check=False,
        )
        state = emulator.state()
    if done.returncode and os.getloadavg()[0] > _BUSY * (os.cpu_count() or 1):
        pytest.skip(f"five processes keep no time on a machine as busy as this: {(done.stdout or done.stderr)[:200]}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((out / "result.json").read_text())["outcome"] == "done"
    # Its middle ends a contact's depth and half its width ahead of where the leader's tip stopped.
    after = np.array(state["objects"]["prism"])[:3, 3]
    assert after[0] - before[0] > 0.05
    np.testing.assert_allclose(1e3 * after[:2], [450, 5], atol=12)
    recording = load_run(out / RECORDING)
    for sensor in SENSORS:
        # Every frame used was sent by this camera, stamped by the kernel's clock.
        measured = recording.series(f"/sensors/{sensor}/measurement")
        assert measured is not None
        numbers = measured.column("seq")
        assert np.all(np.diff(numbers) > 0)
        assert len(numbers) > 30
        assert numbers[-1] <= state["cameras"][sensor]["sequence"]
        # The learned estimator saw the tip that this scene pressed in.
        contact = recording.series(f"/sensors/{sensor}/contact")
        assert contact is not None
        assert 1.0 < np.nanmedian(contact.column("z_mm")) < 5.0


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("emulated_scene", lambda data: data.pop("emulated_scene")),
        ("sensors.leader_sensor.device", lambda data: data["sensors"]["leader_sensor"].update(device="/dev/tip")),
        ("sensors.leader_sensor.mounted_on", lambda data: data["sensors"]["leader_sensor"].pop("mounted_on")),
        ("sensors.leader_sensor.driver", lambda data: data["sensors"]["leader_sensor"].update(driver="opencv_camera")),
    ],
)
def test_a_device_without_emulator_is_named(
    tmp_path: Path, key: str, change: Callable[[dict[str, Any]], object]
) -> None:
    plan = plan_cell(shipped(tmp_path / "cell.yaml", change), to_run=False)
    with pytest.raises(ConfigError) as refused:
        CellEmulator(plan, tmp_path)
    assert refused.value.key == key
