"""A run that every time would trip or fail on what its task does is refused before, with the key that decides."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_TRIPPED
from touchcell.cell.cli.main import main
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHIPPED = {path.stem: load_layers(path).data for path in CONFIGS.glob("*_sim.yaml")}
FOLLOW, PUSH, STEPS, EDGE = "surface_follow_sim", "single_push_sim", "steps_sim", "edge_follow_sim"
MESH = "surface_mesh_sim"
BAR = {"kind": "box", "size_mm": [200, 26, 20], "pose_mm_deg": [0, 0, -20, 0, 0, 0]}
NOTCHED = {
    "kind": "extrusion",
    "outline_mm": [[-30, -40], [90, -40], [90, 40], [46, 40], [46, -20], [14, -20], [14, 40], [-30, 40]],
    "height_mm": 20,
    "pose_mm_deg": [0, 0, -20, 0, 0, 0],
}
TOUCH = {"move": {"by_mm_deg": [0, 0, 40], "until": {"contact": True}}}
PRESS = {"servo": {"depth_mm": 2, "until": {"time_s": 1}}}
Change = tuple[str, Any]


def changed(name: str, *changes: Change) -> dict[str, Any]:
    data = copy.deepcopy(dict(SHIPPED[name]))
    for path, value in changes:
        *above, key = path.split(".")
        at: Any = data
        for part in above:
            at = at[int(part)] if isinstance(at, list) else at[part]
        at[key] = value
    return data


@pytest.fixture
def cell(tmp_path: Path) -> Callable[..., Path]:
    def written(name: str, *changes: Change) -> Path:
        path = tmp_path / "cell.yaml"
        path.write_text(yaml.safe_dump(changed(name, *changes), sort_keys=False))
        return path

    return written


def problem(path: Path) -> ConfigError:
    """Return the one reason for which the cell is refused, or each run would trip."""
    try:
        (found,) = plan_cell(path).foreseen
    except InvalidCell as error:
        (found,) = error.problems
    assert found.line > 0
    return found


TIGHT = [
    (FOLLOW, [("interlocks.uncertain.limit_mm", 0.05)], "interlocks.uncertain.limit_mm", "the least that network"),
    (PUSH, [("interlocks.uncertain", {"kind": "uncertain", "limit_mm": 0.05})], "interlocks.uncertain.limit_mm", ""),
    (FOLLOW, [("interlocks.shear.limit_mm", 1.5)], "interlocks.shear.limit_mm", "as the tip slides at 3 mm of depth"),
    (FOLLOW, [("interlocks.shear.limit_mm", 0.05)], "interlocks.shear.limit_mm", "as task.check_shift_mm shears"),
    (PUSH, [("interlocks.shear.limit_mm", 0.1)], "interlocks.shear.limit_mm", "as task.check_shift_mm shears"),
    (
        FOLLOW,
        [("interlocks.slip", {"kind": "slip", "limit_ratio": 0.3, "hold_ms": 100})],
        "interlocks.slip.limit_ratio",
        "shear per depth 0.59",
    ),
    (FOLLOW, [("interlocks.limited.limit_ms", 5)], "interlocks.limited.limit_ms", "task.approach_speed_mm_s"),
    (PUSH, [("interlocks.limited.limit_ms", 25)], "interlocks.limited.limit_ms", "task.retract_speed_mm_s"),
    (STEPS, [("interlocks.limited.limit_ms", 10)], "interlocks.limited.limit_ms", "steps.0.move.speed_mm_s"),
    (FOLLOW, [("interlocks.inconsistent.limit_nis", 0.5)], "interlocks.inconsistent.limit_nis", "consistent filter"),
    (FOLLOW, [("interlocks.tcp_speed.limit_rad_s", 0.05)], "interlocks.tcp_speed.limit_rad_s", "check_tilt_deg turns"),
]
WAYS = [
    (FOLLOW, [("interlocks.workspace.max_mm", [50, 50, 150])], "task.distance_mm", "over the surface, .* x = 5"),
    (FOLLOW, [("task.direction_deg", 90)], "task.distance_mm", "y = -5"),
    ("surface_follow_dome_sim", [("task.distance_mm", 300)], "task.distance_mm", "x = 12"),
    ("surface_mesh_sim", [("interlocks.workspace.max_mm", [10, 100, 100])], "task.path", "x = 30 mm, limit 10 mm"),
    (FOLLOW, [("task.retract_mm", 140)], "task.retract_mm", "z = 1"),
    (
        "collect_sim",
        [("task.clearance_mm", 200)],
        "task.clearance_mm",
        "known surface 'sensor' leaves .* z = 220 mm",
    ),
]
WAYS += [
    ("object_track_sim", [("interlocks.workspace.max_mm", [30, 200, 120])], "task.duration_s", "x = .* limit 30 mm"),
]
TOUCHES = [
    (FOLLOW, [("task.depth_mm", 0.05)], "task.depth_mm", "is no contact to the gate"),
    (FOLLOW, [("task.depth_mm", 4.95)], "task.depth_mm", "known to 0.19 mm at best"),
    (
        FOLLOW,
        [("sensors.sensor.estimator.gate", {"touch_percent": 0.01, "release_percent": 0.005})],
        "sensors.sensor.estimator.gate.touch_percent",
        "noise alone",
    ),
    (STEPS, [("task.steps", [PRESS])], "task.steps.0.servo", "standing clear of the scene"),
    (STEPS, [("task.steps", [{"hold": {"time_s": 1}}, PRESS])], "task.steps.1.servo", "standing clear of the scene"),
    (STEPS, [("task.steps", [TOUCH, {"retract": {"distance_mm": 30}}, PRESS])], "task.steps.2.servo", "by 30 mm"),
    (
        STEPS,
        [("task.steps", [{"move": {"by_mm_deg": [0, 0, 5], "frame": "contact"}}])],
        "task.steps.0.move",
        "standing clear of the scene",
    ),
    (
        FOLLOW,
        [("sensors.sensor.estimator.gate", {"touch_percent": 60, "release_percent": 50})],
        "sensors.sensor.estimator.gate.touch_percent",
        "at about 6 mm of depth",
    ),
    (FOLLOW, [("task.check_press_mm", 6)], "task.check_press_mm", "6 mm is not below the limit"),
    (
        STEPS,
        [("task.steps.0.repeat.steps.0.move.speed_mm_s", 80)],
        "task.steps.0.repeat.steps.0.move.speed_mm_s",
        "deep before it stands",
    ),
]
TIMES = [
    (FOLLOW, [("task.max_frame_age_ms", 5)], "task.max_frame_age_ms", "come after 10 ms"),
    (FOLLOW, [("task.kp_per_s", [0, 0, 300, 8, 8, 0])], "task.kp_per_s", "overshoots by more than the error"),
    (FOLLOW, [("task.check_shift_mm", 10)], "task.check_shift_mm", "less than or equal to 5"),
    (FOLLOW, [("task.kp_per_s", [0, 0, -8, 8, 8, 0])], "task.kp_per_s.2", "greater than or equal to 0"),
]


@pytest.mark.parametrize(("name", "changes", "key", "words"), [*TIGHT, *WAYS, *TOUCHES, *TIMES])
def test_it_is_refused_with_the_key_that_decides(
    cell: Callable[..., Path], name: str, changes: list[Change], key: str, words: str
) -> None:
    found = problem(cell(name, *changes))
    assert found.key == key
    assert re.search(words, found.reason), found.reason


FAILING = [
    (PUSH, [("task.target_mm", [-120, 0])], "task.target_mm", "is behind the sensor"),
    (
        STEPS,
        [("task.steps", [{"move": {"by_mm_deg": [0, 0, 10], "until": {"contact": True}}}])],
        "task.steps.0.move.by_mm_deg",
        "touches nothing at all",
    ),
    (
        STEPS,
        [("task.steps", [{"move": {"by_mm_deg": [0, 0, 21], "until": {"depth_mm": 4}}}])],
        "task.steps.0.move.by_mm_deg",
        "touches nothing 4 mm deep",
    ),
    (FOLLOW, [("arms.arm.start_pose_mm_deg", [-80, 0, 100, 180, 0, 0])], "task.approach_distance_mm", "meets nothing"),
    (PUSH, [("arms.arm.start_pose_mm_deg", [-140, 0, 30, 180, 0, 0])], "task.approach_distance_mm", "meets nothing"),
    (
        STEPS,
        [("task.steps.0.repeat.steps.5.move.timeout_s", 1)],
        "task.steps.0.repeat.steps.5.move.timeout_s",
        "1.25 s",
    ),
    (
        STEPS,
        [("task.steps.0.repeat.steps.4.retract.timeout_s", 0.5)],
        "task.steps.0.repeat.steps.4.retract.timeout_s",
        "takes 1 s",
    ),
    (
        STEPS,
        [("task.steps", [TOUCH, {"servo": {"depth_mm": 2, "until": {"distance_mm": 10}}}])],
        "task.steps.1.servo.timeout_s",
        "never ends",
    ),
    (FOLLOW, [("task.settle_timeout_s", 0.2)], "task.settle_timeout_s", "0.3 s at least to settle"),
    (FOLLOW, [("task.prepare_timeout_s", 0.1)], "task.prepare_timeout_s", "0.2 s at least to back off"),
    (PUSH, [("task.push_timeout_s", 1)], "task.push_timeout_s", "at least to push so far"),
    (
        "object_track_sim",
        [("scene.surfaces.plate.motion.period_s", 2), ("task.duration_s", 10)],
        "arms.arm.limits.tcp_speed_m_s",
        "150 mm/s is less than what 'sensor' is carried along with: it falls 60 mm behind",
    ),
    (
        EDGE,
        [("interlocks.workspace.min_mm", [-40, -120, 10])],
        "task.distance_mm",
        r"mm the edge leads out of interlocks.workspace, which would trip: x = -4",
    ),
    (EDGE, [("task.distance_mm", 200)], "task.distance_mm", "200 mm along the edge do not lead back"),
    (
        MESH,
        [("scene.surfaces", {"bar": BAR})],
        "task.path",
        r"leads off what it touches: below \(\d+, \d+\) mm of it is",
    ),
    (
        MESH,
        [("scene.surfaces", {"plate": NOTCHED}), ("task.path", {"kind": "through", "points_mm": [[60, 0]]})],
        "task.path",
        r"leads (off what it touches|to where the surface leans)",
    ),
    (
        MESH,
        [("interlocks.tilt.limit_deg", 12)],
        "task.path",
        r"leans by 1\d deg, .* interlocks.tilt would trip at 12 deg",
    ),
    (
        EDGE,
        [("task.dimensions", 3), ("arms.arm.start_pose_mm_deg", [35, 0, 44, 180, 40, 0])],
        "task.dimensions",
        "its face leans by more than 35 deg against the tip, which stays as it starts: up to 40 deg",
    ),
]


@pytest.mark.parametrize(("name", "changes", "key", "words"), FAILING)
def test_a_run_that_would_end_as_failed_is_said_and_not_refused(
    cell: Callable[..., Path], name: str, changes: list[Change], key: str, words: str
) -> None:
    """It may be meant: a test of that very end."""
    said = [note for note in plan_cell(cell(name, *changes)).notes if note.startswith("each run would fail: ")]
    assert len(said) == 1
    assert f"{key}: " in said[0]
    assert re.search(words, said[0])


ACCEPTED = [
    ("collect_sim", [("task.clearance_mm", 40)]),
    (FOLLOW, [("interlocks.uncertain.limit_mm", 0.2)]),
    (FOLLOW, [("interlocks.shear.limit_mm", 4)]),
    (PUSH, [("interlocks.shear.limit_mm", 1)]),
    (FOLLOW, [("interlocks.limited.limit_ms", 100)]),
    (FOLLOW, [("interlocks.tcp_speed.limit_rad_s", 0.5)]),
    (FOLLOW, [("interlocks.workspace.max_mm", [110, 50, 150])]),
    (FOLLOW, [("task.depth_mm", 4.5)]),
    (EDGE, [("task.close_loop", False), ("task.distance_mm", 200)]),
    # A run may be ended before its task is.
    (FOLLOW, [("max_duration_s", 5)]),
    (PUSH, [("task.target_mm", [-120, 0]), ("task.goal_heading_deg", 180)]),
    ("object_track_sim", [("task.duration_s", 1), ("interlocks.workspace.max_mm", [30, 200, 120])]),
    # A contact is felt, or the step ends, before it would trip.
    (STEPS, [("task.steps", [{"servo": {"depth_mm": 2, "until": {"time_s": 0.3}}}])]),
    (STEPS, [("task.steps", [{"servo": {"depth_mm": 2, "until": {"contact": False}}}])]),
    (STEPS, [("task.steps", [{"move": {"by_mm_deg": [0, 0, 22]}}, PRESS])]),
    (STEPS, [("task.steps", [TOUCH, {"retract": {"distance_mm": 1}}, PRESS])]),
    # Whether nothing is met on half the way does not matter where time may end it.
    (STEPS, [("task.steps", [{"move": {"by_mm_deg": [0, 0, 10], "until": {"contact": True, "time_s": 0.1}}}])]),
]


@pytest.mark.parametrize(("name", "changes"), ACCEPTED)
def test_what_a_run_may_well_do_is_accepted(cell: Callable[..., Path], name: str, changes: list[Change]) -> None:
    assert not plan_cell(cell(name, *changes)).foreseen


@pytest.mark.parametrize("period_s", [20, 6])
def test_an_object_that_the_arm_keeps_up_with_is_nothing_to_speak_of(
    cell: Callable[..., Path], period_s: float
) -> None:
    path = cell("object_track_sim", ("scene.surfaces.plate.motion.period_s", period_s))
    assert not [note for note in plan_cell(path).notes if "each run would fail" in note]


def test_check_refuses_what_each_run_would_trip_on_and_a_run_says_so_and_trips(
    cell: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(cell(FOLLOW, ("interlocks.workspace.max_mm", [-60, 50, 150])))
    assert main(["check", path]) == EXIT_BAD_INPUT
    assert "task.distance_mm: leads out of interlocks.workspace" in capsys.readouterr().err
    assert main(["run", path, "--quiet", "--out", str(tmp_path / "run")]) == EXIT_TRIPPED
    assert "each run would trip: " in capsys.readouterr().err


def test_without_a_model_nothing_is_checked_by_a_motion_and_nothing_backs_off(cell: Callable[..., Path]) -> None:
    """The true contact is not checked, so that neither shift nor tilt nor the way back is made."""
    data = changed(FOLLOW)
    kept = {rule: entry for rule, entry in data["interlocks"].items() if rule in ("workspace", "tilt", "tcp_speed")}
    kept |= {rule: data["interlocks"][rule] for rule in ("indentation", "stale_frame", "stale_arm")}
    kept["tcp_speed"] = {**kept["tcp_speed"], "limit_rad_s": 0.05}
    changes = [
        ("interlocks", {**kept, "shear": {"kind": "shear", "limit_mm": 0.05, "hold_ms": 100}}),
        ("sensors.sensor.estimator", {"kind": "true_contact"}),
        ("task.prepare_timeout_s", 0.1),
        ("task.distance_mm", 2),
    ]
    plan_cell(cell(FOLLOW, *changes))
