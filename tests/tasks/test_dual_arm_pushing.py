"""Dual-arm pushing: whole cells in quasi-static physics, and how the two arms wait for each other."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.pushing_cell import cell_file, push
from touchcell.cell.runtime.stop_request import StopRequest

CELL = "dual_push_sim.yaml"
START = [("prepare", "ready", "approach"), ("approach", "contact", "settle"), ("settle", "settled", "run")]
END = [("run", "finished", "retract"), ("retract", "retracted", "done")]
SHORT = {"task__target_mm": [50, 3], "task__retract_mm": 12, "scene__step_ms": 10}


def test_both_arms_bring_the_object_to_the_target(tmp_path):
    """The follower moves ahead of it."""
    depths, apart = [], []

    def look(cell):
        contacts = {role: cell.scene.contact(role).value for role in cell.sensors}
        if cell.task.state == "run":
            depths.append([1e3 * contacts[role].depth_m for role in ("leader_sensor", "follower_sensor")])
        if cell.task.state == "settle":
            apart.append([contact.in_contact for contact in contacts.values()])

    pushed = push(
        cell_file(CELL, **SHORT | {"task__follower__active": True, "task__target_mm": [70, 3]}), tmp_path, look
    )
    assert pushed.path == [*START, *END]
    assert all(map(all, apart))
    assert abs(pushed.error_mm) < 3.0
    late = np.array(depths[len(depths) // 2 :])
    assert np.abs(late[:, 1] - 2.0).max() < 1.0
    # The follower's contact force and friction, 0.6 N/mm and 0.3 x 479 g.
    assert (late[:, 0] - late[:, 1]).mean() == pytest.approx(0.3 * 0.479 * 9.81 / 0.6, abs=0.2)


def test_the_leader_waits_while_the_follower_searches_for_its_lost_contact(tmp_path):
    lost, leader_x = [], []

    def look(cell):
        follower = cell.arms["follower"]
        if cell.task.state == "run" and cell.clock.now_ns() > 2.5e9 and not lost:
            lost.append(True)
            follower._body.T_base_tcp[0, 3] -= 0.012
        if cell.task.state == "approach" and lost:
            leader_x.append(cell.arms["leader"].T_world_tcp()[0, 3])

    pushed = push(cell_file(CELL, **SHORT), tmp_path, look)
    assert pushed.path == [*START, ("run", "lost", "approach"), *START[1:], *END]
    assert "follower_sensor" in pushed.cell.task.transitions[3].reason
    assert 1e3 * (leader_x[-1] - leader_x[0]) < 1.0


def test_both_stop_when_one_has_no_fresh_frame(tmp_path):
    moving = []

    def look(cell):
        if cell.clock.now_ns() > 2.5e9:
            cell.sensors["follower_sensor"].source.update = lambda now_ns: None
            moving.append([float(np.abs(arm.tcp().value.twist).max()) > 0.0 for arm in cell.arms.values()])

    pushed = push(cell_file(CELL, **SHORT), tmp_path, look)
    assert pushed.cell.task.state == "tripped"
    assert not np.any(moving[20:])


def test_an_operators_stop_withdraws_both(tmp_path):
    stop, gaps = StopRequest(), []

    def look(cell):
        if cell.task.state == "run":
            stop.ask() if not stop.count else None
        gaps.append([-1e3 * cell.scene.contact(role).value.depth_m for role in cell.sensors])

    pushed = push(cell_file(CELL, **SHORT), tmp_path, look, stop=stop)
    assert pushed.cell.task.state == "stopped"
    assert min(gaps[-1]) > 8.0
