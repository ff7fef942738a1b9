"""One place of the matrix of emulated arms for each kind of answer; ``touchcell bench faults`` runs all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.emulated_matrix import ARMS, HANG, VANISH, places, run_case


def test_every_fault_of_the_rig_is_tried_in_every_state(tmp_path: Path) -> None:
    found = [(fault, state) for _, _, fault, state in places("franka", tmp_path)]
    assert len(found) == len(set(found))
    faults, states = {fault for fault, _ in found}, {state for _, state in found}
    assert faults >= {"reflex", "pause", "drop_states", HANG, VANISH}
    assert states == {"prepare", "approach", "settle", "run", "retract"}
    assert len(found) == len(faults) * len(states)


@pytest.mark.parametrize("driver", ARMS)
def test_an_arm_that_hangs_while_it_follows_a_surface_ends_the_run(driver: str, tmp_path: Path) -> None:
    pytest.importorskip({"ur": "rtde_receive"}.get(driver, "numpy"))
    [(rig, path, fault, state)] = [place for place in places(driver, tmp_path) if place[2:] == ("pause", "run")]
    case = run_case(rig, path, fault, state)
    assert case.problem == ""
    assert case.ended_by
    assert case.detection_s is not None


def test_lost_packets_end_nothing(tmp_path: Path) -> None:
    [(rig, path, fault, state)] = [
        place for place in places("damiao_can", tmp_path) if place[2:] == ("drop", "approach")
    ]
    case = run_case(rig, path, fault, state)
    assert (case.problem, case.ended_by, case.lawful) == ("", "", "transient")
