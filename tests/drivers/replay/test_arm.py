"""The replay arm reports the sensor pose of each image of a data set."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import ConnectError, StaleData
from touchcell.drivers.replay.arm import ReplayArm, ReplayArmConfig
from touchcell.drivers.replay.dataset import IMAGE_COLUMN, IMAGE_FOLDER, LABEL_COLUMNS
from touchcell.geometry import se3

CONTACTS = {
    "image_10.png": [1, 2, 3, 4, 5, 6],
    "image_2.png": [0.5, 0, 2, -10, 3, -1],
    "image_1.png": [0, 0, 1, 0, 0, 0],
}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "val"
    (folder / IMAGE_FOLDER).mkdir(parents=True)
    rows = [",".join([IMAGE_COLUMN, *LABEL_COLUMNS])]
    for name, contact in CONTACTS.items():
        cv2.imwrite(str(folder / IMAGE_FOLDER / name), np.zeros((8, 8), np.uint8))
        rows.append(",".join([name, *map(str, contact)]))
    (folder / "targets_images.csv").write_text("\n".join(rows) + "\n")
    return tmp_path


def test_poses_come_in_the_order_of_the_images(data: Path) -> None:
    clock = VirtualClock(5)
    with ReplayArm("arm", ReplayArmConfig(data=data, split="val", rate_hz=10), clock) as arm:
        for seq, name in enumerate(["image_1.png", "image_2.png", "image_10.png"]):
            sample = arm.tcp()
            assert (sample.seq, sample.t_ns) == (seq, 5 + seq * 100_000_000)
            np.testing.assert_allclose(sample.value.T_base_tcp, se3.from_euler_mm_deg(CONTACTS[name]), atol=1e-15)
            clock.advance_s(0.1)
        assert arm.tcp().seq == 2


def test_old_poses_are_stale(data: Path) -> None:
    clock = VirtualClock()
    with ReplayArm("arm", ReplayArmConfig(data=data, split="val", rate_hz=10), clock) as arm:
        clock.advance_s(0.05)
        assert arm.tcp(max_age_s=0.06).seq == 0
        with pytest.raises(StaleData):
            arm.tcp(max_age_s=0.04)


def test_missing_data_is_reported_at_connect(tmp_path: Path) -> None:
    arm = ReplayArm("arm", ReplayArmConfig(data=tmp_path, split="val"), VirtualClock())
    with pytest.raises(ConnectError, match="no such folder"):
        arm.connect()
    assert arm.state.value == "disconnected"
