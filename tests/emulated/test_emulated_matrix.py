"""A few places of the matrix of emulated devices; ``touchcell bench faults`` runs all of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.fault_injection import faults
from tests.fault_injection.emulated_cells import FAULT_ROLES
from tests.fault_injection.emulated_matrix import (
    ARMS,
    CAMERAS,
    DEVICES,
    HANG,
    REACH,
    SERVO,
    VANISH,
    Bench,
    EmulatedCase,
    Place,
    faults_of,
    places,
    states_of,
)
from touchcell.drivers.damiao.emulator import DamiaoArm
from touchcell.drivers.feetech.emulator import FeetechArm
from touchcell.drivers.franka.emulator.server import FrankaEmulator
from touchcell.drivers.net_ft.emulator import NetFtBox
from touchcell.drivers.robotiq.emulator import RobotiqHand
from touchcell.drivers.ur.emulator.server import UrEmulator
from touchcell.drivers.v4l2.emulator.server import V4l2Emulator

EMULATORS = {
    "ur": UrEmulator,
    "franka": FrankaEmulator,
    "damiao_can": DamiaoArm,
    "feetech_serial": FeetechArm,
    "v4l2": V4l2Emulator,
    "net_ft": NetFtBox,
    "robotiq": RobotiqHand,
}


@pytest.mark.parametrize("driver", [*ARMS, *CAMERAS, *DEVICES])
def test_every_fault_of_the_emulator_is_in_the_matrix(driver: str, tmp_path: Path) -> None:
    # A reset is not a fault: it returns everything to the start.
    assert faults_of(driver, tmp_path).keys() == {*EMULATORS[driver].faults, HANG, VANISH} - {"reset"}


def test_every_state_of_every_task_is_tested_or_equal_to_a_tested_one(tmp_path: Path) -> None:
    found = dict(places("franka", tmp_path))
    assert {(place.task, place.role, place.state) for place in found} == {
        (task, role, state) for task, roles in FAULT_ROLES.items() for role in roles for state in states_of(task)[0]
    }
    ending = [place for place, rule in found.items() if place.fault == "reflex" and not rule]
    tried = {
        (place.task, place.role): [each.state for each in ending if each.role == place.role and each.task == place.task]
        for place in ending
    }
    assert tried == {
        ("surface_following", "arm"): ["prepare", "approach", "settle", "run", "retract"],
        ("object_tracking", "arm"): ["run"],
        ("single_arm_pushing", "arm"): ["run"],
        ("dual_arm_pushing", "leader"): ["run"],
        ("dual_arm_pushing", "follower"): ["run"],
        ("data_collection", "arm"): ["prepare", "press", "grab", "roam", "retract"],
    }
    assert found[Place("franka", "reflex", "object_tracking", "arm", "settle")] == SERVO
    assert found[Place("franka", "reflex", "data_collection", "arm", "tilt")] == REACH
    assert {place.task for place, _ in places("v4l2", tmp_path)} == {*FAULT_ROLES, "observe"}


@pytest.mark.parametrize("driver", ARMS)
def test_an_arm_that_hangs_while_it_follows_a_surface_ends_the_run(driver: str, tmp_path: Path) -> None:
    pytest.importorskip({"ur": "rtde_receive", "franka": "franky"}.get(driver, "numpy"))
    case = Bench(tmp_path, 300_000).run(Place(driver, "pause", "surface_following", "arm", "run"))
    assert case.problem == ""
    assert case.ended_by
    assert case.detection_s is not None


@pytest.mark.parametrize(
    ("place", "ended_by"),
    [
        (Place("damiao_can", "drop", "surface_following", "arm", "approach"), ""),
        (Place("v4l2", "freeze_frame", "object_tracking", "sensor", "settle"), "frozen_frame"),
        (Place("v4l2", "unplug", "dual_arm_pushing", "follower_sensor", "run"), "DeviceGone"),
    ],
)
def test_lost_frames_do_not_end_the_run_but_a_failed_camera_does(place: Place, ended_by: str, tmp_path: Path) -> None:
    case = Bench(tmp_path, 310_000).run(place)
    assert (case.problem, case.ended_by) == ("", ended_by)


@pytest.mark.parametrize(
    ("place", "ended_by"),
    [
        (Place("net_ft", "status", "surface_following", "device", "run"), "DeviceFault"),
        (Place("robotiq", "unplug", "surface_following", "device", "run"), "DeviceGone"),
    ],
)
def test_a_failed_sensor_or_gripper_ends_the_run(place: Place, ended_by: str, tmp_path: Path) -> None:
    case = Bench(tmp_path, 320_000).run(place)
    assert (case.problem, case.ended_by) == ("", ended_by)


def test_an_interrupted_run_continues_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Place] = []

    def answer(worker: object, place: Place) -> EmulatedCase:
        asked.append(place)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return EmulatedCase(place, "fault", "stale_arm", 0.3)

    monkeypatch.setattr(faults._Worker, "run", answer)
    arguments = ["franka", "--state", "press", "--jobs", "1"]
    faults.run(arguments, tmp_path)
    kept = [json.loads(line)["place"] for line in (tmp_path / faults.PART).read_text().splitlines()]
    assert kept == [
        {"driver": "franka", "fault": place.fault, "task": "data_collection", "role": "arm", "state": "press"}
        for place in asked[:2]
    ]
    first = len(asked)
    faults.run(arguments, tmp_path)
    assert not set(asked[:2]) & set(asked[first:])
    assert not (tmp_path / faults.PART).exists()
    report = json.loads((tmp_path / "faults.json").read_text())
    assert len(report["cases"]) == sum(not rule for place, rule in places("franka", tmp_path) if place.state == "press")
    assert "as expected: 13 of 13 places tried" in capsys.readouterr().out
