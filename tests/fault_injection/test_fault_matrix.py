"""Every fault of the simulated devices in every state of every task ends as it has to."""

from __future__ import annotations

import itertools
from dataclasses import fields
from pathlib import Path
from typing import Literal

import pytest
import yaml

from tests.fault_injection.fault_matrix import FAULTS, Case, cells, places, run_case, run_place
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.paths import MODELS
from touchcell.simulation.faults import ArmFaults, FrameFaults
from touchcell.tasks.interface import TASKS


def test_every_fault_and_every_task_is_in_the_matrix() -> None:
    names = {fault.name for fault in FAULTS}
    assert {f"arm: {field.name}" for field in fields(ArmFaults)} <= names
    assert {f"camera: {field.name}" for field in fields(FrameFaults)} <= names
    assert set(cells()) == set(TASKS.names())


MOVING = (
    "surface_following",
    "object_tracking",
    "single_arm_pushing",
    "dual_arm_pushing",
    "data_collection",
    "steps",
    "edge_following",
    "jog",
)


def run_all(kind: Literal["arm", "camera"], task: str) -> list[Case]:
    """Run all cases of one task; none has a problem, and none is left out."""
    cases = [run_place(place) for place in places([kind], [task])]
    assert [f"{c.state}, {c.device}, {c.fault}: {c.problem}" for c in cases if c.problem] == []
    faults = {fault.name for fault in FAULTS if fault.device == kind}
    tried = {(case.fault, case.device, case.state) for case in cases}
    states, devices = {case.state for case in cases}, {case.device for case in cases}
    assert tried == set(itertools.product(faults, devices, states))
    assert len(devices) == (2 if task == "dual_arm_pushing" else 1)
    assert states >= ({"prepare", "approach", "run", "retract"} if task in MOVING[:4] else {"prepare"} & states)
    return cases


@pytest.mark.slow
@pytest.mark.parametrize("task", MOVING)
def test_faults_of_arms_in_every_state(task: str) -> None:
    run_all("arm", task)


@pytest.mark.slow
@pytest.mark.skipif(not (MODELS / "sim_gdn.safetensors").exists(), reason="needs the shipped model")
@pytest.mark.parametrize("task", ["surface_following", "object_tracking", "observe", "data_collection", "steps"])
def test_faults_of_cameras_in_every_state(task: str) -> None:
    """Those of the pushing tasks take minutes, and ``jog`` has no code for frames: ``touchcell bench safety``
    runs them."""
    run_all("camera", task)


def test_the_matrix_detects_a_missing_interlock(tmp_path: Path) -> None:
    data = cells()["surface_following"]
    put_on_true_contact(data)
    for name, entry in list(data["interlocks"].items()):
        if entry["kind"] == "arm_state_age":
            data["interlocks"][name] = {**entry, "limit_ms": 990}
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    stale = next(fault for fault in FAULTS if fault.name == "arm: stale")
    assert "expected arm_state_age" in run_case(path, stale, "arm", "run").problem
