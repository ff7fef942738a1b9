from pathlib import Path

import numpy as np
import pytest
import yaml

from touchcell.errors import ConfigError
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import SHIPPED, TipFile, load_tip, save_tip


def test_a_saved_tip_loads_unchanged(tmp_path: Path) -> None:
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
def test_shipped_tip_files_are_valid(name: str) -> None:
    sensor = load_tip(name)
    tip = Tip(sensor.tip)
    rest = tip.project(tip.rest_positions)
    assert rest.shape == (331, 2)
    assert ((rest > 20) & (rest < [620, 460])).all()
    assert sensor.measured["train, held out px"] < 2.0


def test_an_unknown_key_is_reported_with_a_suggestion(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "tip": {"focal_pixel": 500.0}}))
    with pytest.raises(ConfigError, match="focal_px"):
        load_tip(str(path))


@pytest.mark.parametrize("text", ["tip: [", "schema: 1", "schema: 2\ntip: {}", "schema: 1\ntip: {rings: many}", "7"])
def test_invalid_values_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_tip(str(path))
    assert caught.value.file == str(path)


def test_a_missing_file_lists_the_shipped_tips() -> None:
    with pytest.raises(ConfigError, match="franka_tactip_1"):
        load_tip("nobody.yaml")
