"""Edge following on a simulated cell: loops closed, corners turned, both directions, curved sheets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchcell.cell.analysis.run_folder import RunFolder, during
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.control.curvature import CurvatureEstimator
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.paths import CONFIGS
from touchcell.perception.features.feature_model import TouchedFeature
from touchcell.simulation.closed_forms import Box, Cylinder
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.motions import Still
from touchcell.simulation.surfaces import Plane, Surface
from touchcell.tasks.edge_following import EdgeFollowingConfig, FollowEdge

CELL = CONFIGS / "edge_follow_sim.yaml"


def over(x_mm: float, y_mm: float, z_mm: float, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.from_euler_mm_deg(np.array([x_mm, y_mm, z_mm, 180.0, 0.0, yaw_deg]))


TRUE_EDGE: dict[str, Any] = {
    "sensors.sensor.estimator": {"kind": "true_edge", "noise_mm": 0.1, "noise_deg": 0.5},
    "sensors.sensor.feels": "plane",
}


def run(settings: dict[str, Any], folder: Path, *, learned: bool = False) -> tuple[Any, np.ndarray, Any]:
    """Return the result, true edge poses (n, 6) in mm and degrees while the task ran, and the task."""
    plan = plan_cell(CELL, settings=settings if learned else {**TRUE_EDGE, **settings})
    (folder / "cell.yaml").write_text(plan.text())
    cell = compose(plan)
    with Recorder(folder / "run.mcap") as recorder, cell:
        result = RunLoop(cell, recorder).run()
    found = RunFolder(folder)
    series = found.recording.series("/sensors/sensor/true_edge")
    assert series is not None
    return result, series.poses()[during(found, series)], cell.task


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_the_rim_of_a_disc_is_followed_once_around(direction: str, tmp_path: Path) -> None:
    result, edge, _ = run({"task.direction": direction}, tmp_path)
    assert result.outcome.value == "done", result.reason
    assert rms(edge[:, 0]) < 0.3
    assert rms(edge[:, 2] - 3.0) < 0.2
    assert rms(edge[:, 5]) < 2.0
    assert len(edge) / 100.0 == pytest.approx(2.0 * math.pi * 50.0 / 30.0, rel=0.06)


def test_a_tip_that_leans_along_the_edge_is_not_sheared_by_that(tmp_path: Path) -> None:
    settings = {
        "scene.surfaces": {"block": {"kind": "box", "size_mm": [80, 80, 20]}},
        "arms.arm.start_pose_mm_deg": [38, 0, 45, 155, 0, 0],
        "task.dimensions": 3,
        "task.close_loop": False,
        "task.distance_mm": 10,
    }
    result, edge, _ = run(settings, tmp_path)
    assert result.outcome.value == "done", result.reason
    assert np.abs(edge[:, 3] - edge[0, 3]).max() < 2.0
    assert abs(edge[0, 3]) > 20.0
    assert np.abs(edge[:, 1]).max() < 0.01


def test_the_network_that_ships_follows_a_rim(tmp_path: Path) -> None:
    settings = {"task.close_loop": False, "task.distance_mm": 60}
    result, edge, task = run(settings, tmp_path, learned=True)
    assert result.outcome.value == "done", result.reason
    assert task.transitions[1].target == "check"
    assert rms(edge[:, 0]) < 0.8
    assert rms(edge[:, 2] - 3.0) < 0.2
    assert rms(edge[:, 5]) < 4.0


def test_corners_of_a_square_are_turned_without_losing_the_contact(tmp_path: Path) -> None:
    box = {"kind": "box", "size_mm": [80, 80, 20]}
    result, edge, task = run(
        {"scene.surfaces.disc": box, "arms.arm.start_pose_mm_deg": [38, 5, 45, 180, 0, 0]}, tmp_path
    )
    assert result.outcome.value == "done", result.reason
    assert not [each for each in task.transitions if each.event == "lost"]
    assert np.median(np.abs(edge[:, 0])) < 0.3


def test_two_dimensions_leave_depth_and_tilt_alone(tmp_path: Path) -> None:
    result, edge, _ = run({"task.dimensions": 2}, tmp_path)
    assert result.outcome.value == "done", result.reason
    assert rms(edge[:, 0]) < 0.3


def test_a_loop_that_does_not_close_is_no_success(tmp_path: Path) -> None:
    result, _, task = run({"task.distance_mm": 60}, tmp_path)
    assert result.outcome.value == "failed"
    assert "not closed" in task.transitions[-2].reason


def test_an_estimator_of_surfaces_is_refused_by_check() -> None:
    with pytest.raises(ConfigError, match="of a surface") as caught:
        plan_cell(CELL, settings={"sensors.sensor.estimator": {"kind": "true_contact"}})
    assert caught.value.key == "sensors.sensor.estimator.kind"
    with pytest.raises(ConfigError, match="of an edge"):
        plan_cell(CONFIGS / "surface_follow_sim.yaml", settings={"sensors.sensor.estimator": {"kind": "true_edge"}})


def test_a_filter_of_surfaces_is_refused_for_edges() -> None:
    drift = {"drift_mm_per_sqrt_s": 1.0, "drift_deg_per_sqrt_s": 5.0}
    with pytest.raises(ConfigError, match="it predicts the motion of a surface, and edge_network estimates an edge"):
        plan_cell(CELL, settings={"sensors.sensor.estimator.filter": drift})


def test_the_edge_frame_points_off_the_face_and_along_the_edge() -> None:
    box = Surface(Box((0.08, 0.08, 0.02)))
    T_world_s = over(43.0, 10.0, 37.0)
    T_world_e = nearest_edge([box], T_world_s, 0.0, 0.020)
    assert T_world_e is not None
    np.testing.assert_allclose(T_world_e[:3, 0], [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(T_world_e[:3, 2], [0.0, 0.0, -1.0], atol=1e-9)
    np.testing.assert_allclose(T_world_e[:3, 3], [0.04, 0.01, 0.04], atol=1e-9)
    x, y, z, alpha, beta, gamma = se3.to_euler_mm_deg(se3.compose(se3.inverse(T_world_e), T_world_s))
    np.testing.assert_allclose([x, y, z, alpha, beta, gamma], [3.0, 0.0, 3.0, 0.0, 0.0, 0.0], atol=1e-6)


def test_the_edge_frame_does_not_depend_on_the_world_frame() -> None:
    rng = np.random.default_rng(5)
    shape = Cylinder(0.05, 0.02)
    for _ in range(20):
        T_move = se3.exp(rng.uniform(-1.0, 1.0, 6))
        T_world_s = over(*rng.uniform([46.0, -8.0, 36.0], [54.0, 8.0, 38.0]), rng.uniform(-30.0, 30.0))
        still = nearest_edge([Surface(shape)], T_world_s, 0.0, 0.020)

        moved = nearest_edge([Surface(shape, Still(T_move))], se3.compose(T_move, T_world_s), 0.0, 0.020)
        assert still is not None
        assert moved is not None
        np.testing.assert_allclose(se3.compose(se3.inverse(T_move), moved), still, atol=1e-9)


def test_surfaces_without_edges_have_none() -> None:
    assert nearest_edge([Surface(Plane())], over(0.0, 0.0, 17.0), 0.0, 0.020) is None


def test_the_bend_of_a_circle_is_one_over_its_radius() -> None:
    bend, radius_m = CurvatureEstimator(0.010), 0.050
    for i in range(30):
        angle = i * 0.001 / radius_m
        x_mm, y_mm = 50.0 * math.cos(angle), 50.0 * math.sin(angle)
        pose = se3.from_euler_mm_deg(np.array([x_mm, y_mm, 0.0, 0.0, 0.0, np.degrees(angle)]))
        bend.update(0.001, pose, np.eye(4))
    np.testing.assert_allclose(bend.per_m(), [0.0, 1.0, 0.0, 0.0, 0.0, 1.0 / radius_m], rtol=0.02, atol=1e-3)


def test_a_corner_that_is_felt_in_several_steps_is_no_bend() -> None:
    bend = CurvatureEstimator(0.005)
    for i, felt_deg in enumerate([0.0, 0.0, 0.0, 0.0, 11.0, 22.0, 33.0, 44.0, 44.0, 44.0, 44.0, 44.0, 44.0, 44.0]):
        pose = se3.from_euler_mm_deg(np.array([0.0, 0.4 * i, 0.0, 0.0, 0.0, felt_deg]))
        bend.update(0.0004, pose, np.eye(4))
    assert abs(bend.per_m()[5]) < 1.0


def twisted(behavior: FollowEdge, lean_rad_per_m: float, tilt_deg: float = 0.0) -> np.ndarray:
    """Return the feedforward after 20 mm along a straight edge whose face leans over more and more."""
    T_s_e, before = se3.from_euler_mm_deg(np.array([0.0, 0.0, 0.0, 0.0, tilt_deg, 0.0])), np.eye(4)
    for i in range(21):
        # The edge stays in its line, 20 mm ahead of the tip's middle.
        lean = lean_rad_per_m * 1e-3 * i
        T = np.eye(4)
        T[:3, :3] = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, lean, 0.0]))[:3, :3]
        T[:3, 3] = np.array([0.0, 1e-3 * i, 0.0]) - 0.020 * T[:3, 2]
        behavior.update(0.033, before, T, T_s_e.copy())
        before = T
    return np.array(behavior.feedforward)


def test_a_face_that_leans_over_takes_the_tip_across_the_edge() -> None:
    V = twisted(FollowEdge(EdgeFollowingConfig()), lean_rad_per_m=20.0)
    np.testing.assert_allclose(V, [-0.020 * 0.6, 0.030, 0.0, 0.0, 0.6, 0.0], rtol=0.02, atol=2e-3)


def test_a_tip_goes_slower_where_a_face_leans_over_fast_and_while_it_is_tilted() -> None:
    fast = twisted(FollowEdge(EdgeFollowingConfig(max_turn_deg_s=60.0)), lean_rad_per_m=40.0)
    assert fast[1] == pytest.approx(0.4 * math.radians(60.0) / 40.0, rel=0.02)
    assert twisted(FollowEdge(EdgeFollowingConfig()), 0.0, tilt_deg=2.5)[1] == pytest.approx(0.015, rel=0.01)
    # In three dimensions nobody tilts it back.
    assert twisted(FollowEdge(EdgeFollowingConfig(dimensions=3)), 0.0, tilt_deg=2.5)[1] == pytest.approx(0.030)


def test_a_mesh_is_followed_like_its_closed_form(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = Cylinder(0.05, 0.02).drawn()
    trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces, process=False).export(tmp_path / "disc.stl")
    result, edge, _ = run(
        {"scene.surfaces.disc": {"kind": "mesh", "file": str(tmp_path / "disc.stl"), "unit": "mm"}}, tmp_path
    )
    assert result.outcome.value == "done", result.reason
    assert rms(edge[:, 0]) < 0.3


EDGE = TouchedFeature(0.0, 0.1, 0.5, 0.4)
FACE = TouchedFeature(0.0, 0.97, 0.02, 0.01)


def test_no_edge_is_followed_where_there_is_none() -> None:
    behavior = FollowEdge(EdgeFollowingConfig())
    assert [behavior.astray(0.033, FACE) for _ in range(3)] == [""] * 3
    assert behavior.astray(0.033, FACE) == "touches no edge to follow: surface by 97 %"


def test_the_middle_of_a_plate_is_no_edge(tmp_path: Path) -> None:
    plate = {"plate": {"kind": "box", "size_mm": [400, 400, 20]}}
    plan = plan_cell(CELL, settings={"scene.surfaces": plate})
    cell = compose(plan)
    with Recorder(tmp_path / "run.mcap") as recorder, cell:
        result = RunLoop(cell, recorder).run()
    assert result.outcome.value == "failed"
    assert "touches no edge to follow: surface" in result.reason


def test_an_edge_that_is_lost_ends_the_task_after_a_while_and_corners_are_edges() -> None:
    behavior = FollowEdge(EdgeFollowingConfig(edge_lost_ms=350.0))
    assert behavior.astray(0.01, EDGE) == ""
    behavior.update(0.01, np.eye(4), np.eye(4), None)
    # A corner of a third of a second that looks like a face, and an edge again.
    assert [behavior.astray(0.1, each) for each in (FACE, FACE, EDGE, FACE, FACE, FACE)] == [""] * 6
    assert behavior.astray(0.1, FACE).startswith("lost the edge after 0 mm")
    assert behavior.telemetry()["edge_percent"] == pytest.approx(3.0)


def test_without_a_classifier_nothing_is_judged() -> None:
    behavior = FollowEdge(EdgeFollowingConfig())
    assert [behavior.astray(1.0, None) for _ in range(3)] == [""] * 3
    assert "edge_percent" not in behavior.telemetry()
