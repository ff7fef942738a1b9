from pathlib import Path

import numpy as np
import pytest
import yaml

from touchcell.errors import ConfigError
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import SHIPPED, TipFile, load_tip, save_tip


def test_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "sensor.yaml"
    tip = TipParameters(focal_px=512.5, centre_px=(330.0, 240.5), rings=9)
    saved = TipFile(tip=tip, rig=MountModel(offset_m=(1e-3, 0.0)), measured={"frames": 20})
    save_tip(saved, path)
    found = load_tip(str(path))
    assert found.tip.centre_px == (330.0, 240.5)
    assert found.tip.rings == 9
    assert found.rig == saved.rig
    assert found.measured == {"frames": 20}
    for name in TipParameters.__dataclass_fields__:
        np.testing.assert_allclose(getattr(found.tip, name), getattr(tip, name), rtol=1e-5)


@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED.glob("*.yaml")))
def test_what_ships_is_a_sensor(name: str) -> None:
    sensor = load_tip(name)
    tip = Tip(sensor.tip)
    rest = tip.project(tip.rest_positions)
    assert rest.shape == (331, 2)
    assert ((rest > 20) & (rest < [620, 460])).all()
    assert sensor.measured["train, held out px"] < 2.0


def test_what_is_unknown_is_told_with_its_likeliest_name(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "tip": {"focal_pixel": 500.0}}))
    with pytest.raises(ConfigError, match="focal_px"):
        load_tip(str(path))


@pytest.mark.parametrize("text", ["tip: [", "schema: 1", "schema: 2\ntip: {}", "schema: 1\ntip: {rings: many}", "7"])
def test_what_makes_no_sense_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_tip(str(path))
    assert caught.value.file == str(path)


def test_a_missing_file_says_what_ships() -> None:
    with pytest.raises(ConfigError, match="franka_tactip_1"):
        load_tip("nobody.yaml")
