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
BEARING = SHORT | {"task__steering": "bearing", "task__push_speed_mm_s": 20, "task__side_width_mm": None}
ASIDE = [("run", "aside", "sidestep"), ("sidestep", "placed", "approach"), *START[1:]]


def test_both_arms_bring_the_object_to_the_target(tmp_path):
    """The follower moves ahead of it."""
    depths, apart = [], []

    def look(cell):
        contacts = {role: cell.scene.contact(role).value for role in cell.sensors}
        if cell.task.state == "run":
            depths.append([1e3 * contacts[role].depth_m for role in ("leader_sensor", "follower_sensor")])
        if cell.task.state == "settle":
            apart.append([contact.in_contact for contact in contacts.values()])

    pushed = push(cell_file(CELL, **BEARING | {"task__target_mm": [70, 3]}), tmp_path, look)
    assert pushed.path == [*START, *END]
    assert all(map(all, apart))
    assert abs(pushed.error_mm) < 3.0
    late = np.array(depths[len(depths) // 2 :])
    assert np.abs(late[:, 1] - 1.5).max() < 1.0
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

    pushed = push(cell_file(CELL, **BEARING), tmp_path, look)
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


@pytest.mark.parametrize(("aside_mm", "turn_deg"), [(8, 5), (-20, -20), (20, 0)])
def test_an_object_far_off_the_line_is_found_by_its_edge_and_arrives(tmp_path, aside_mm, turn_deg):
    """Both arms let go, the leader feels an edge, and both press opposite each other then."""
    data = cell_file(CELL, **SHORT | {"task__target_mm": [200, 40]})
    data["scene"]["objects"]["prism"]["pose_mm_deg"] = [0, aside_mm, 0, 0, 0, turn_deg]
    data["arms"]["leader"]["start_pose_mm_deg"][0] -= 20
    data["arms"]["follower"]["start_pose_mm_deg"][0] -= 25
    pushed = push(data, tmp_path)
    assert pushed.path[: len(START) + len(ASIDE)] == [*START, *ASIDE]
    assert pushed.path[-2:] == END
    assert pushed.object_mm_deg[:2] == pytest.approx((200.0, 40.0), abs=0.5)


def test_a_centre_of_mass_beside_the_middle_is_told_from_it(tmp_path):
    data = cell_file(CELL, **SHORT | {"task__target_mm": [200, 40]})
    data["scene"]["objects"]["prism"]["center_of_mass_mm"] = [0, 8]
    pushed = push(data, tmp_path)
    assert pushed.path[-1] == END[-1]
    assert pushed.object_mm_deg[:2] == pytest.approx((200.0, 40.0), abs=1.5)


@pytest.mark.parametrize("told_mm", [45, 60, 75])
def test_two_arms_measure_how_far_ahead_the_centre_is(tmp_path, told_mm):
    data = cell_file(CELL, **SHORT | {"task__target_mm": [70, 5], "task__object_center_offset_mm": told_mm})
    pushed = push(data, tmp_path)
    assert pushed.path[-1] == END[-1]
    assert pushed.object_mm_deg[:2] == pytest.approx((70.0, 5.0), abs=0.6)
    # That of the file is relied on only where it agrees.
    assert bool(pushed.result.rests_on) == (told_mm != 60)


def test_two_arms_feel_the_middle_of_a_side_whose_width_is_not_told(tmp_path):
    pushed = push(cell_file(CELL, **SHORT | {"task__side_width_mm": None}), tmp_path)
    assert pushed.path[-1] == END[-1]
    assert pushed.object_mm_deg[:2] == pytest.approx((50.0, 3.0), abs=1.0)


def test_the_follower_presses_less_where_the_leader_is_near_what_its_tip_bears(tmp_path):
    """The table holds 2.6 N, 4.3 mm of a tip of 0.6 N/mm, and the leader pushes what the follower presses, too."""
    deepest = {}
    for ease_from_mm in (4.0, 20.0):
        depths = deepest[ease_from_mm] = []

        def look(cell, depths=depths):
            if cell.task.state == "run":
                depths.append([1e3 * cell.scene.contact(role).value.depth_m for role in cell.sensors])

        changes = {"task__follower__ease_from_mm": ease_from_mm, "task__follower__reference_mm_deg": [0, 0, 2, 0, 0, 0]}
        data = cell_file(CELL, **SHORT | {"task__target_mm": [60, 3]} | changes)
        data["scene"]["table"]["friction"] = 0.55
        (folder := tmp_path / str(ease_from_mm)).mkdir()
        push(data, folder, look)
    eased, not_eased = (np.array(depths)[-30:].mean(axis=0) for depths in deepest.values())
    assert eased[1] < not_eased[1] - 0.5
    assert eased[0] < not_eased[0] - 0.5
