"""Single-arm pushing: whole cells in quasi-static physics."""

from __future__ import annotations

import pytest

from tests.helpers.pushing_cell import cell_file, push

TOUCH = [("prepare", "ready", "approach"), ("approach", "contact", "settle"), ("settle", "settled", "run")]
TO_MIDDLE = [("run", "aside", "sidestep"), ("sidestep", "placed", "approach"), *TOUCH[1:]]
START = [*TOUCH, *TO_MIDDLE]
END = [("run", "finished", "retract"), ("retract", "retracted", "done")]
MISSED = [("run", "missed", "retract"), ("retract", "retracted", "failed")]
SHORT = {"task__target_mm": [120, 5], "task__retract_mm": 12, "task__push_speed_mm_s": 30, "scene__step_ms": 10}
CELL = "single_push_sim.yaml"
ROUND = {"kind": "cylinder", "diameter_mm": 80, "height_mm": 60}


def why_missed(pushed):
    """Return the reason for which the push was given up."""
    return next(each.reason for each in pushed.cell.task.transitions if each.event == "missed")


@pytest.mark.parametrize(
    ("shape", "mass_g", "friction"),
    [(None, 479, "mdf"), (ROUND, 363, "foam")],
)
def test_the_object_is_brought_to_the_target(tmp_path, shape, mass_g, friction):
    changes = {"scene__table__friction": friction, "scene__step_ms": 10, "task__target_mm": [200, 25]}
    data = cell_file(CELL, **changes, task__side_width_mm=None, task__sides="flat" if shape is None else "round")
    prism = data["scene"]["objects"]["prism"]
    prism |= {"mass_g": mass_g} if shape is None else {"mass_g": mass_g, "shape": shape}
    pushed = push(data, tmp_path)
    assert pushed.path == ([*START, *END] if shape is None else [*TOUCH, *END])
    assert "object_center_offset_mm is right (60 mm were told)" in pushed.result.rests_on[0]
    # That the contact is 3 mm beside the centre is found out.
    assert pushed.object_mm_deg[:2] == pytest.approx(data["task"]["target_mm"], abs=0.6)


def test_a_lost_object_is_searched_for_and_pushed_again(tmp_path):
    """The object is displaced 15 mm ahead while it is pushed."""
    moved = []

    def snatch(cell):
        if cell.task.state == "run" and len(cell.task.transitions) == len(START) and not moved:
            slider = cell.scene.world._sliders["prism"]
            moved.append(slider.move((0.015, 0.0, 0.0), 0.0))

    # Where the side was touched again, no edge was felt.
    data = cell_file(CELL, **SHORT | {"task__target_mm": [80, 0], "task__arrival_tolerance_mm": 8})
    pushed = push(data, tmp_path, snatch)
    assert pushed.path == [*START, ("run", "lost", "approach"), *TOUCH[1:], *END]
    assert "sensor" in pushed.cell.task.transitions[len(START)].reason
    assert pushed.object_mm_deg[0] == pytest.approx(80.0, abs=5.0)


def test_without_an_object_it_fails(tmp_path):
    data = cell_file(CELL, task__approach_distance_mm=10.0)
    data["scene"]["objects"]["prism"]["pose_mm_deg"] = [200, 0, 0, 0, 0, 0]
    pushed = push(data, tmp_path)
    assert pushed.path[-2:] == [("approach", "no_contact", "retract"), ("retract", "retracted", "failed")]


def test_the_object_is_brought_to_a_full_pose(tmp_path):
    data = cell_file(CELL, scene__step_ms=10, task__target_mm=[180, 30], task__goal_heading_deg=20.0)
    pushed = push(data, tmp_path)
    assert pushed.path[-2:] == END
    assert pushed.object_mm_deg[:2] == pytest.approx((180.0, 30.0), abs=1.0)
    assert pushed.object_mm_deg[2] == pytest.approx(20.0, abs=2.0)


def test_a_centre_of_mass_10_mm_beside_the_middle_is_told_from_it(tmp_path):
    data = cell_file(CELL, scene__step_ms=10, task__target_mm=[200, 25])
    data["scene"]["objects"]["prism"]["center_of_mass_mm"] = [0, 10]
    pushed = push(data, tmp_path)
    assert pushed.path[-1] == END[-1]
    assert pushed.object_mm_deg[:2] == pytest.approx((200.0, 25.0), abs=0.6)


def test_without_a_path_past_the_obstacle_it_faults_before_it_pushes(tmp_path):
    pushed = push(cell_file(CELL, task__obstacles_mm=[[90, 0, 20]]), tmp_path)
    assert pushed.cell.task.state == "faulted"
    assert "no path" in pushed.cell.task.transitions[-1].reason
    assert pushed.object_mm_deg[:2] == pytest.approx((0.0, 3.0), abs=0.1)


@pytest.mark.parametrize("cell", [CELL, "dual_push_sim.yaml"])
def test_an_object_that_is_lost_beside_its_path_is_not_done(tmp_path, cell):
    """Neither with one arm nor with two."""
    changes = {"task__max_cross_track_mm": 1.0, "task__steering": "bearing"}
    pushed = push(cell_file(cell, **SHORT | changes), tmp_path)
    assert ("run", "missed", "retract") in pushed.path
    assert pushed.cell.task.state == "failed"
    assert "beside its path, limit 1 mm" in why_missed(pushed)


def test_an_object_that_ends_beyond_the_tolerance_is_not_done(tmp_path):
    pushed = push(cell_file(CELL, **SHORT | {"task__arrival_tolerance_mm": 0.001}), tmp_path)
    assert pushed.path == [*START, *MISSED]
    assert "mm from the target, tolerance 0.001 mm" in why_missed(pushed)


def test_a_heading_beyond_the_tolerance_is_not_done(tmp_path):
    changes = {"task__goal_heading_deg": 10.0, "task__arrival_tolerance_deg": 0.001, "task__target_mm": [180, 15]}
    pushed = push(cell_file(CELL, **SHORT | changes), tmp_path)
    assert pushed.path[-1] == ("retract", "retracted", "failed")
    assert "deg off at the target" in why_missed(pushed)


def test_a_width_that_was_told_wrong_is_found_out(tmp_path):
    pushed = push(cell_file(CELL, scene__step_ms=10, task__target_mm=[120, 5], task__side_width_mm=95), tmp_path)
    assert pushed.path == [*START, *END]
    assert pushed.object_mm_deg[:2] == pytest.approx((120.0, 5.0), abs=0.6)


def test_an_object_that_is_first_touched_at_a_corner_between_two_sides_arrives(tmp_path):
    """The corner looks like a side of which nothing else is so."""
    changes = {"task__target_mm": [150, 20], "task__object_center_offset_mm": 55, "task__side_width_mm": 40.4}
    data = cell_file(CELL, scene__step_ms=10, **changes, arms__arm__start_pose_mm_deg=[-75, 0, 30, 180, 0, 0])
    hexagon = {"kind": "hexagon", "width_mm": 70, "height_mm": 60}
    data["scene"]["objects"]["prism"] |= {"shape": hexagon, "pose_mm_deg": [5.85, 12.6, 0, 0, 0, -18.2]}
    pushed = push(data, tmp_path)
    assert pushed.path[-1] == END[-1]
    assert pushed.object_mm_deg[:2] == pytest.approx((150.0, 20.0), abs=0.8)


def test_a_target_that_asks_for_more_tilt_than_is_allowed_is_given_up(tmp_path):
    pushed = push(cell_file(CELL, scene__step_ms=10, task__target_mm=[60, 200]), tmp_path)
    assert pushed.path[-2:] == MISSED
    assert "limit 60 deg; object" in why_missed(pushed)


def test_a_wall_of_the_workspace_is_not_run_into(tmp_path):
    changes = {"interlocks__workspace__max_mm": [60, 250, 120], "task__arrival_tolerance_mm": 90}
    pushed = push(cell_file(CELL, **SHORT | {"task__target_mm": [200, 0]} | changes), tmp_path)
    assert pushed.path[-2:] == MISSED
    assert "comes to a wall of its workspace" in why_missed(pushed)


def test_a_limit_near_the_target_does_not_undo_an_arrival_within_the_tolerance(tmp_path):
    changes = {"interlocks__workspace__max_mm": [60, 250, 120], "task__arrival_tolerance_mm": 190}
    pushed = push(cell_file(CELL, **SHORT | {"task__target_mm": [200, 0]} | changes), tmp_path)
    assert pushed.path[-2:] == END


@pytest.mark.parametrize("cell", [CELL, "dual_push_sim.yaml"])
def test_an_object_too_heavy_for_the_tip_is_given_up(tmp_path, cell):
    pushed = push(cell_file(cell, **SHORT, scene__objects__prism__mass_g=1600), tmp_path)
    assert pushed.path[-2:] == MISSED
    assert "needs more force" in why_missed(pushed)


def test_an_object_in_the_way_of_a_step_aside_is_not_pushed_along(tmp_path):
    """The object is moved 12 mm towards the sensor as that passes by, 8 mm clear of it."""
    cycles = []

    def move(cell):
        if cell.task.state == "sidestep":
            cycles.append(cell.task.state)
            if len(cycles) == 30:
                cell.scene.world._sliders["prism"].move((-0.012, 0.0, 0.0), 0.0)

    pushed = push(cell_file(CELL, **SHORT), tmp_path, move)
    assert pushed.path == [*TOUCH, TO_MIDDLE[0], ("sidestep", "missed", "retract"), MISSED[1]]
    assert "its way beside the object was taken for free" in why_missed(pushed)
