"""Animations of runs: outlines of solids, and a GIF that moves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from touchcell.cell.cli.main import main
from touchcell.cell.experiments.trials import Perform, Trial
from touchcell.geometry import se3
from touchcell.simulation.objects import BallShape, BottleShape, BoxShape, HexagonShape
from touchcell.simulation.outlines import ABOVE, SIDE, height_mm, solid_outlines_mm, tip_outlines_mm
from touchcell.simulation.surfaces import Dome, Ramp, Surface


def area(outline):
    x, y = outline[:-1].T
    return 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))


def turned(*pose):
    return se3.from_euler_mm_deg(np.array(pose, dtype=float))


@pytest.mark.parametrize(
    ("shape", "view", "areas"),
    [
        (BoxShape(kind="box", size_mm=(80, 60, 40)), ABOVE, [80 * 60]),
        (BoxShape(kind="box", size_mm=(80, 60, 40)), SIDE, [80 * 40]),
        (HexagonShape(kind="hexagon", width_mm=80, height_mm=60), ABOVE, [np.sqrt(3) / 2 * 80**2]),
        (BottleShape(kind="bottle", sections_mm=((100, 60), (50, 30))), SIDE, [100 * 60, 50 * 30]),
        (BallShape(kind="ball", diameter_mm=60), SIDE, [np.pi * 30**2]),
    ],
)
def test_outlines_have_the_size_of_the_solid(shape, view, areas):
    outlines = solid_outlines_mm(shape.build(), np.eye(4), view)
    assert [area(outline) for outline in outlines] == pytest.approx(areas, rel=0.01)


def test_outlines_move_and_turn_with_the_solid():
    (outline,) = solid_outlines_mm(
        BoxShape(kind="box", size_mm=(80, 60, 40)).build(), turned(100, 50, 0, 0, 0, 90), ABOVE
    )
    np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [[70, 10], [130, 90]], atol=0.01)


def test_a_tip_has_its_body_behind_it():
    body, tip = tip_outlines_mm(turned(0, 0, 30, 0, 90, 0), 0.020, ABOVE)
    assert area(tip) == pytest.approx(np.pi * 400, rel=0.01)
    assert body[:, 0].min() == pytest.approx(-45)
    assert body[:, 0].max() == pytest.approx(0, abs=0.1)


def test_heights_match_the_surface():
    x_m = np.array([-0.1, 0.0, 0.02])
    np.testing.assert_allclose(height_mm(Surface(Dome(0.05)), x_m, 0.0, 0.0), [0.0, 50.0, 45.83], atol=0.1)
    rising = height_mm(Surface(Ramp(0.1, np.radians(30))), np.array([0.2]), 0.0, 0.0)
    np.testing.assert_allclose(rising, 1e3 * (0.1 * (1 - np.cos(np.pi / 6)) + 0.15 * np.tan(np.pi / 6)), atol=0.1)


def test_report_animates_a_run(tmp_path, capsys):
    from PIL import Image

    from touchcell.cell.experiments.animation import animate

    changes = {"sensors.sensor.estimator": {"kind": "true_contact"}, "task.distance_mm": 20}
    Perform(lambda run: {}, tmp_path)(Trial("it", "it", "surface_follow_sim.yaml", changes))

    path = animate(tmp_path / "it", max_frames=5)
    with Image.open(path) as picture:
        assert picture.n_frames == 5
        frames = []
        for i in range(5):
            picture.seek(i)
            frames.append(np.asarray(picture.convert("L"), dtype=int))
    assert all((a != b).mean() > 0.001 for a, b in itertools.pairwise(frames))
    assert path.stat().st_size < 500_000
    assert main(["report", str(tmp_path / "nothing"), "--animate"]) == 2
    assert "nothing" in capsys.readouterr().err
