import numpy as np
import pytest
from pydantic import ValidationError

from touchcell.simulation.objects import ObjectConfig, TableConfig
from touchcell.simulation.shapes import Ball, Prism, Turned


def built(shape: dict, table: TableConfig | None = None):
    config = ObjectConfig.model_validate({"shape": shape, "mass_g": 250, "pose_mm_deg": [10, 0, 5, 0, 0, 90]})
    return config.build(table or TableConfig())


def test_an_object_stands_on_its_table() -> None:
    thing = built({"kind": "box", "size_mm": [80, 60, 40]}, TableConfig(height_mm=100, friction="foam"))
    assert thing.mass_kg == pytest.approx(0.25)
    assert thing.friction == 0.6
    np.testing.assert_allclose(thing.T_world_object[:3, 3], [0.010, 0.0, 0.105])
    assert isinstance(thing.solid, Prism)
    assert thing.solid.height_m == pytest.approx(0.04)
    np.testing.assert_allclose(np.ptp(thing.solid.outline_m, axis=0), [0.08, 0.06])


def test_a_hexagon_has_its_width_across_flats() -> None:
    solid = built({"kind": "hexagon", "width_mm": 80, "height_mm": 50}).solid
    assert isinstance(solid, Prism)
    corners = solid.outline_m
    assert np.ptp(corners[:, 0]) == pytest.approx(0.08)
    edges = np.roll(corners, -1, axis=0) - corners
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 0.08 / np.sqrt(3.0))
    area = 0.5 * np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1))
    assert area == pytest.approx(np.sqrt(3.0) / 2.0 * 0.08**2)


def test_round_things() -> None:
    bottle = built({"kind": "bottle", "sections_mm": [[120, 60], [40, 25]]}).solid
    assert isinstance(bottle, Turned)
    assert bottle.sections_m == ((0.12, 0.03), (0.04, 0.0125))
    assert bottle.height_m == pytest.approx(0.16)
    cylinder = built({"kind": "cylinder", "diameter_mm": 70, "height_mm": 60}).solid
    assert isinstance(cylinder, Turned)
    assert cylinder.sections_m == ((0.06, 0.035),)
    ball = built({"kind": "ball", "diameter_mm": 100}).solid
    assert ball == Ball(0.05)
    assert ball.height_m == pytest.approx(0.1)


def test_a_table_may_give_its_own_coefficient() -> None:
    assert TableConfig(friction=0.42).coefficient == 0.42
    assert TableConfig().coefficient == 0.3
    with pytest.raises(ValidationError):
        TableConfig.model_validate({"friction": "ice"})
