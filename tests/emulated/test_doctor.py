"""``touchcell doctor`` beside emulated devices that have what people report."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import pytest

from touchcell.cell.cli.doctor import Diagnosis, diagnose
from touchcell.testing.emulation.rig import RIGS

ADDRESSES = itertools.count(9_000_000 + os.getpid() % 15_000 * 100)


def diagnosed(driver: str, faults: dict[str, Any], folder: Path) -> tuple[Diagnosis, int]:
    """Return what is found, and how many messages that change power, mode or zero were sent for it."""
    pytest.importorskip({"ur": "rtde_control", "franka": "franky"}.get(driver, "numpy"))
    fixture = RIGS.load(driver)(folder, next(ADDRESSES))
    assert fixture.start is not None
    emulated = fixture.start()
    try:
        for fault, value in faults.items():
            emulated.fault(fault, value)
        energising = 0 if fixture.energising is None else emulated.state()[fixture.energising]
        found = diagnose(fixture.build(fixture.clock()), driver)
        after = 0 if fixture.energising is None else emulated.state()[fixture.energising]
    finally:
        emulated.stop()
    return found, after - energising


@pytest.mark.parametrize("driver", ["ur", "franka", "damiao_can", "feetech_serial", "v4l2"])
def test_a_healthy_device_has_no_fault_and_is_not_touched(driver: str, tmp_path: Path) -> None:
    found, energising = diagnosed(driver, {}, tmp_path)
    assert found.is_healthy, found
    assert energising == 0


@pytest.mark.parametrize(
    ("driver", "faults", "what", "report"),
    [
        ("damiao_can", {"registers": [2, 10, 3]}, "control mode 3", "openarm_can 64"),
        ("damiao_can", {"turn_off": [1, 2]}, "outside its limits", "axol 208"),
        ("feetech_serial", {"registers": [2, 31, "6400"]}, "homing_offset_ticks", "lerobot 1360"),
        ("feetech_serial", {"fault_bits": [1, 1]}, "servo 2", "SO-ARM100 174"),
        ("ur", {"local_control": True}, "local control", "Universal_Robots_ROS2_Driver 181"),
        ("ur", {"registers_in_use": True}, "in use by another client", "Universal_Robots_ROS_Driver 28"),
        ("franka", {"reflex": "self_collision_avoidance_violation"}, "self_collision", "libfranka 23"),
        ("v4l2", {"only_format": ["YUYV", 640, 480]}, "YUYV", "lerobot 1225"),
        ("v4l2", {"busy": True}, "another program", "lerobot 3569"),
    ],
)
def test_a_reported_fault_is_named_with_its_remedy_and_its_report(
    driver: str, faults: dict[str, Any], what: str, report: str, tmp_path: Path
) -> None:
    found, energising = diagnosed(driver, faults, tmp_path)
    assert not found.is_healthy
    assert energising == 0
    named = [finding for finding in found.findings if what in finding.what and report in finding.reports]
    assert named, found
    assert named[0].remedy


def test_a_device_that_does_not_answer_is_told_apart_from_a_faulty_one(tmp_path: Path) -> None:
    found, _ = diagnosed("feetech_serial", {"silent": 2}, tmp_path)
    assert not found.answers
    assert not found.is_healthy


def test_advice_does_not_make_a_device_faulty(tmp_path: Path) -> None:
    found, _ = diagnosed("ur", {"speed_slider": 0.5}, tmp_path)
    assert found.is_healthy
    assert any("speed slider" in finding.what and not finding.is_fault for finding in found.findings)
