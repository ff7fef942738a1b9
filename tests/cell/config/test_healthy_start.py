"""What would trip, or fail, before or although nothing is wrong is refused by `check`, at the key that says so."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers.unforeseen import sway
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.paths import CONFIGS

FOLLOW, MESH, PUSH, STEPS, EDGE, PAIR = (
    yaml.safe_load((CONFIGS / f"{name}_sim.yaml").read_text())
    for name in ("surface_follow", "surface_mesh", "single_push", "steps", "edge_follow", "dual_push")
)


def changed(data: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A copy with values at paths, whose keys are parted by two underscores."""
    cell: dict[str, Any] = copy.deepcopy(data)
    for path, value in changes.items():
        *parts, last = path.split("__")
        inner = cell
        for part in parts:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return cell


@pytest.fixture
def said(tmp_path: Path) -> Callable[[dict[str, Any]], dict[str, str]]:
    """What `check` says of a cell: a message by key; nothing if it is valid."""

    def check(data: dict[str, Any]) -> dict[str, str]:
        path = tmp_path / "cell.yaml"
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        try:
            problems = plan_cell(path).foreseen
        except InvalidCell as error:
            problems = error.problems
        assert all(problem.line > 0 for problem in problems)
        return {problem.key: str(problem) for problem in problems}

    return check


Said = Callable[[dict[str, Any]], dict[str, str]]


# --- data as old as the devices give it


@pytest.mark.parametrize(
    ("changes", "rules"),
    [
        ({"sensors__sensor__rate_hz": 2}, {"stale_frame", "frozen_frame"}),
        ({"sensors__sensor__latency_ms": 140}, {"stale_frame"}),
        ({"sensors__sensor__latency_ms": 130}, {"stale_frame"}),
        ({"sensors__sensor__latency_ms": 100}, set()),
        ({"interlocks__frozen_frame__limit_ms": 25}, {"frozen_frame"}),
        ({"interlocks__late": {"kind": "overrun", "limit_ms": 9}}, {"late"}),
        ({"interlocks__late": {"kind": "overrun", "limit_ms": 10.5}}, set()),
        ({"rate_hz": 50}, set()),
    ],
)
def test_a_limit_below_what_a_healthy_device_needs_is_named(said: Said, changes: Any, rules: set[str]) -> None:
    found = said(changed(FOLLOW, **changes))
    assert set(found) == {f"interlocks.{rule}.limit_ms" for rule in rules}
    assert all("although nothing is wrong" in text or "without a fault" in text for text in found.values())


# --- where the arms stand


@pytest.mark.parametrize(("tilt_deg", "refused"), [(180, False), (140, False), (130, True), (90, True)])
def test_a_start_outside_its_cone_is_named(said: Said, tilt_deg: float, refused: bool) -> None:
    found = said(sway(changed(FOLLOW, arms__arm__start_pose_mm_deg=[-80, 0, 60, tilt_deg, 0, 0])))
    assert set(found) == ({"arms.arm.start_pose_mm_deg"} if refused else set())
    assert all("interlocks.tilt would trip at once" in message for message in found.values())


@pytest.mark.parametrize(("height_mm", "refused"), [(10, False), (60, True)])
def test_a_start_too_near_an_obstacle_is_named(said: Said, height_mm: float, refused: bool) -> None:
    cell = changed(
        FOLLOW,
        arms__arm__start_pose_mm_deg=[-80, 0, 40, 180, 0, 0],
        arms__arm__body=[{"from_mm": [0, 0, -100], "to_mm": [0, 0, -20], "radius_mm": 20}],
        obstacles={"post": {"size_mm": [20, 20, height_mm], "pose_mm_deg": [-80, 0, height_mm / 2, 0, 0, 0]}},
        interlocks__clear={"kind": "clearance", "limit_mm": 18, "slow_mm": 20},
    )
    found = said(cell)
    assert set(found) == ({"arms.arm.start_pose_mm_deg"} if refused else set())
    assert all("interlocks.clear would trip at once" in message for message in found.values())


@pytest.mark.parametrize(("z_mm", "refused"), [(20.5, False), (19.5, True), (5, True)])
def test_a_start_in_contact_is_named_where_the_task_starts_free(said: Said, z_mm: float, refused: bool) -> None:
    found = said(changed(FOLLOW, arms__arm__start_pose_mm_deg=[-80, 0, z_mm, 180, 0, 0]))
    assert set(found) == ({"arms.arm.start_pose_mm_deg"} if refused else set())
    base = {
        "arms__arm__base_pose_mm_deg": [0, 0, 30, 0, 0, 0],
        "interlocks__workspace__min_mm": [-150, -50, -60],
    }
    assert not said(changed(FOLLOW, arms__arm__start_pose_mm_deg=[-80, 0, max(z_mm, 11), 180, 0, 0], **base))


def test_an_object_that_a_tip_starts_in_is_named(said: Said) -> None:
    found = said(changed(PUSH, scene__objects__prism__pose_mm_deg=[-40, 0, 0, 0, 0, 0]))
    assert "mm deep in something there" in found["arms.arm.start_pose_mm_deg"]


# --- where the task leads


@pytest.mark.parametrize(("target_mm", "refused"), [([300, 60], False), ([440, 0], False), ([900, 0], True)])
@pytest.mark.parametrize("cell", [PUSH, PAIR], ids=["one arm", "two arms"])
def test_a_target_out_of_the_box_is_named(said: Said, cell: Any, target_mm: list[float], refused: bool) -> None:
    found = said(changed(cell, task__target_mm=target_mm))
    assert set(found) == ({"task.target_mm"} if refused else set())
    assert all(f"x = {target_mm[0]} mm, limit 400 mm" in message for message in found.values())


@pytest.mark.parametrize(
    ("path", "refused"),
    [
        ({"kind": "raster", "size_mm": [60, 40], "spacing_mm": 5}, False),
        ({"kind": "raster", "size_mm": [600, 40], "spacing_mm": 5}, True),
        ({"kind": "spiral", "radius_mm": 400, "spacing_mm": 5}, True),
        ({"kind": "through", "points_mm": [[50, 0], [0, 500]]}, True),
    ],
)
def test_a_path_out_of_the_box_is_named_once(said: Said, path: Any, refused: bool) -> None:
    assert set(said(changed(MESH, task__path=path))) == ({"task.path"} if refused else set())


def move(**fields: Any) -> dict[str, Any]:
    return {"move": {"frame": "base", **fields}}


OUT = "task.steps.{}.move.by_mm_deg"


@pytest.mark.parametrize(
    ("steps", "keys"),
    [
        ([move(by_mm_deg=[60, 0, 0])], []),
        ([move(by_mm_deg=[120, 0, 0])], [OUT.format(0)]),
        # The way of several moves adds up, and one that leads back does so too.
        ([move(by_mm_deg=[60, 0, 0]), {"hold": {"time_s": 1}}, move(by_mm_deg=[60, 0, 0])], [OUT.format(2)]),
        ([move(by_mm_deg=[60, 0, 0]), move(by_mm_deg=[-60, 0, 0]), move(by_mm_deg=[60, 0, 0])], []),
        ([{"move": {"by_mm_deg": [0, 0, 40]}}], [OUT.format(0)]),
        ([{"move": {"frame": "tool", "by_mm_deg": [0, 0, -50]}}], [OUT.format(0)]),
        ([move(to_mm_deg=[0, 0, 200, 180, 0, 0])], ["task.steps.0.move.to_mm_deg"]),
        ([{"retract": {"distance_mm": 50}}], ["task.steps.0.retract.distance_mm"]),
        ([{"repeat": {"times": 3, "steps": [move(by_mm_deg=[30, 0, 0])]}}], []),
        (
            [{"repeat": {"times": 5, "steps": [move(by_mm_deg=[30, 0, 0])]}}],
            ["task.steps.0.repeat.steps.0.move.by_mm_deg"],
        ),
        # Where a touch may end the move, or the contact leads the arm, nothing is known of what follows.
        ([{"move": {"by_mm_deg": [0, 0, 90], "until": {"contact": True}}}], []),
        (
            [{"move": {"by_mm_deg": [0, 0, 90], "until": {"contact": True}}}, move(by_mm_deg=[120, 0, 0])],
            [],
        ),
        (
            [{"move": {"by_mm_deg": [0, 0, 90], "until": {"contact": True}}}, move(to_mm_deg=[0, 0, 200, 180, 0, 0])],
            ["task.steps.1.move.to_mm_deg"],
        ),
    ],
)
def test_a_move_out_of_the_box_is_named(said: Said, steps: list[Any], keys: list[str]) -> None:
    assert list(said(changed(STEPS, task__steps=steps))) == keys


@pytest.mark.parametrize(("cell", "model"), [(EDGE, "builtin:sim_gdn"), (FOLLOW, "builtin:sim_edge")])
def test_a_shipped_network_of_another_feature_is_named(said: Said, cell: Any, model: str) -> None:
    found = said(changed(cell, sensors__sensor__estimator__model=model))
    assert "estimates the pose of" in found["sensors.sensor.estimator.model"]


def test_sections_and_lists_of_the_wrong_shape_are_named_without_names_of_classes(said: Said) -> None:
    assert "must be a mapping of keys" in "".join(
        said(changed(FOLLOW, sensors__sensor__estimator__gate=[4, 2.5])).values()
    )
    assert "needs at least 1, found 0" in "".join(said(changed(STEPS, task__steps=[])).values())


@pytest.mark.parametrize(
    ("key", "seed"), [("seed", -3), ("sensors__sensor__estimator", {"kind": "true_edge", "seed": -1})]
)
def test_a_negative_seed_is_named(said: Said, key: str, seed: Any) -> None:
    assert any("must be greater than or equal to 0" in text for text in said(changed(EDGE, **{key: seed})).values())


@pytest.mark.parametrize(
    ("surface", "key"),
    [({"kind": "plane"}, "scene.surfaces"), ({"kind": "cylinder", "radius_mm": 50, "height_mm": 20}, "")],
)
def test_edges_are_followed_only_where_there_are_some(said: Said, surface: Any, key: str) -> None:
    assert "".join(said(changed(EDGE, scene__surfaces={"it": surface}))) == key


def test_where_a_straight_way_ends_over_a_surface_that_moves_nobody_knows(said: Said) -> None:
    cell = changed(FOLLOW, interlocks__workspace__max_mm=[-10, 50, 150])
    assert "task.distance_mm" in said(cell)
    assert not said(sway(cell))
