"""``configs/dual_push_emulated.yaml``: two arms push through their real drivers, in a simulated scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from cell.compose import compose
from cell.config import plan_cell
from cell.loop import Outcome, RunLoop
from drivers.emulators.process import EmulatorProcess

SHIPPED = Path(__file__).parent.parent / "configs" / "dual_push_emulated.yaml"


def test_an_emulated_franka_and_an_emulated_ur_push_a_prism(tmp_path: Path) -> None:
    pytest.importorskip("franky")
    pytest.importorskip("rtde_receive")
    data = yaml.safe_load(SHIPPED.read_text())
    hosts = {"leader": "127.97.3.2", "follower": "127.97.3.3"}
    for arm, host in hosts.items():
        data["arms"][arm]["host"] = host
    for sensor in data["sensors"].values():
        sensor["estimator"] = {"kind": "true_contact"}
    data["task"]["target_mm"] = [440, 5]
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    with (
        EmulatorProcess("franka", "--host", hosts["leader"]),
        EmulatorProcess("ur", "--host", hosts["follower"]),
        compose(plan_cell(path)) as cell,
    ):
        assert cell.scene is not None
        before = cell.scene.objects().value["prism"][:3, 3]
        result = RunLoop(cell, None).run()
        after = cell.scene.objects().value["prism"][:3, 3]
    assert result.outcome is Outcome.DONE, result.reason
    np.testing.assert_allclose(1e3 * after[:2], [438, 6], atol=12)
    assert np.linalg.norm(after - before) > 0.05
