"""Every fault of the simulated devices in every state of every task ends as it has to."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from benchmarks.fault_matrix import FAULTS, cells, matrix, run_case
from cell.compose import MODELS
from drivers.simulation.faults import ArmFaults, FrameFaults
from tasks import registry


def test_every_fault_and_every_task_is_in_the_matrix() -> None:
    names = {fault.name for fault in FAULTS}
    assert {f"arm: {field.name}" for field in fields(ArmFaults)} <= names
    assert {f"camera: {field.name}" for field in fields(FrameFaults)} <= names
    assert set(cells()) == set(registry.installed())


@pytest.mark.slow
def test_faults_of_arms_in_every_state(tmp_path: Path) -> None:
    cases = list(matrix(tmp_path, ["arm"]))
    assert [f"{c.task}, {c.state}, {c.fault}: {c.problem}" for c in cases if c.problem] == []
    arm_faults = [fault for fault in FAULTS if fault.device == "arm"]
    # Two tasks with an arm, five states each.
    assert len(cases) == 2 * 5 * len(arm_faults)


@pytest.mark.slow
@pytest.mark.skipif(not (MODELS / "sim_gdn.safetensors").exists(), reason="needs the model that ships")
def test_faults_of_cameras_in_every_state(tmp_path: Path) -> None:
    cases = list(matrix(tmp_path, ["camera"]))
    assert [f"{c.task}, {c.state}, {c.fault}: {c.problem}" for c in cases if c.problem] == []
    assert len(cases) == 4 * (5 + 5 + 2)


def test_the_matrix_would_notice_a_missing_interlock(tmp_path: Path) -> None:
    data = cells()["surface_following"]
    data["sensors"]["sensor"]["estimator"] = {"kind": "true_contact"}
    for name, entry in list(data["interlocks"].items()):
        if entry["kind"] == "arm_state_age":
            data["interlocks"][name] = {**entry, "limit_ms": 10_000}
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    stale = next(fault for fault in FAULTS if fault.name == "arm: stale")
    assert "expected arm_state_age" in run_case(path, stale, "run").problem
