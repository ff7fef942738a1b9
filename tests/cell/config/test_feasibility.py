"""What `touchcell run` would refuse or surely trip on, `touchcell check` names with file, line, key and remedy."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS, MODELS

SHIPPED = (CONFIGS / "surface_follow_sim.yaml").read_text()
MODEL = "model: builtin:sim_tips"


def written(folder: Path, *changes: tuple[str, str], text: str = SHIPPED) -> Path:
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "cell.yaml"
    path.write_text(text)
    return path


def only_problem(path: Path, **options: Any) -> ConfigError:
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path, **options)
    (problem,) = caught.value.problems
    assert problem.file == str(path)
    assert problem.line > 0
    return problem


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (
            ("depth_mm: 3", "depth_mm: 8"),
            "task.depth_mm",
            "8 mm is not below the limit of interlocks.indentation",
        ),
        (("speed_mm_s: 20", "speed_mm_s: 500"), "task.speed_mm_s", "500 mm/s is more than any arm may move"),
        (("distance_mm: 180", "distance_mm: 1e6"), "task.distance_mm", "longer than the largest workspace"),
        (("[-80, 0, 25,", "[-800, 0, 25,"), "arms.arm.start_pose_mm_deg", "x = -800 mm, limit -150 mm"),
        (("sensor: sensor, min", "sensor: sensr, min"), "interlocks.workspace.sensor", "no sensor 'sensr'"),
        (
            ("release_percent: 2.5", "release_percent: 4.5"),
            "sensors.sensor.estimator.gate",
            "is not below touch",
        ),
        ((MODEL, "model: builtin:sim_gnd"), "sensors.sensor.estimator.model", "no 'sim_gnd' ships"),
        ((MODEL, "model: none.safetensors"), "sensors.sensor.estimator.model", "no such file"),
        ((MODEL, "model: ."), "sensors.sensor.estimator.model", "is no file"),
        ((MODEL, "model: cell.yaml"), "sensors.sensor.estimator.model", "is no model file"),
        (
            (MODEL, f"{MODEL}\n      calibration: none.yaml"),
            "sensors.sensor.estimator.calibration",
            "no such file",
        ),
        (("latency_ms: 10", "tip: none"), "sensors.sensor.tip", "no such file"),
        (("latency_ms: 10", f"tip: {'9' * 5000}x"), "sensors.sensor.tip", "no such file"),
        (("[-80, 0, 25,", "[-80, 0, 1e8,"), "arms.arm.start_pose_mm_deg", "is outside interlocks.workspace"),
        (("name: surface_follow_sim", "name: ../../evil"), "name", "run folders"),
        (("name: surface_follow_sim", "name: ''"), "name", "run folders"),
        (("name: surface_follow_sim", f"name: {'x' * 400}"), "name", "run folders"),
        (("name: surface_follow_sim", "name: a/b"), "name", "run folders"),
    ],
)
def test_check_names_it(tmp_path: Path, change: tuple[str, str], key: str, words: str) -> None:
    path = written(tmp_path, change)
    problem = only_problem(path)
    assert problem.key == key
    assert words in problem.reason
    assert problem.hint or "at most" in problem.reason or "not below" in problem.reason


def test_the_shipped_models_are_listed(tmp_path: Path) -> None:
    shipped = {path.stem for path in MODELS.glob("*.safetensors")}
    hint = only_problem(written(tmp_path, (MODEL, "model: none.safetensors"))).hint
    assert shipped
    assert all(f"builtin:{name}" in hint for name in shipped)
    assert "sim_gdn" in only_problem(written(tmp_path, (MODEL, "model: builtin:sim_gnd"))).hint


@pytest.mark.parametrize("name", ["surface_follow_sim", "a b", "böhm-2.1+x", "7"])
def test_names_that_can_name_a_folder(tmp_path: Path, name: str) -> None:
    assert plan_cell(written(tmp_path, ("name: surface_follow_sim", f"name: '{name}'"))).cell.name == name


def test_simulated_sensors_need_a_scene(tmp_path: Path) -> None:
    data = yaml.safe_load(SHIPPED)
    del data["scene"]
    problem = only_problem(written(tmp_path, text=yaml.safe_dump(data)))
    assert problem.key == "sensors.sensor.driver"
    assert "scene" in problem.reason


def test_an_empty_scene_has_nothing_to_touch(tmp_path: Path) -> None:
    data = yaml.safe_load(SHIPPED) | {"scene": {}}
    with pytest.raises(InvalidCell, match="neither surfaces nor objects"):
        plan_cell(written(tmp_path, text=yaml.safe_dump(data)))


def test_a_dynamic_scene_needs_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    text = (CONFIGS / "dual_push_tall_sim.yaml").read_text()
    plan_cell(written(tmp_path, text=text))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mujoco" else found(name))
    problem = only_problem(written(tmp_path, text=text))
    assert problem.key == "scene.physics"
    assert "touchcell[physics]" in problem.hint


def test_files_beside_the_cell_file_are_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cell").mkdir()
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(MODELS / "sim_gdn.safetensors", tmp_path / "cell" / "mine.safetensors")
    path = written(tmp_path / "cell", (MODEL, "model: mine.safetensors"))
    monkeypatch.chdir(tmp_path / "elsewhere")
    for cell in (path, Path("../cell/cell.yaml")):
        estimator: Any = plan_cell(cell).cell.sensors["sensor"].estimator
        assert Path(estimator.model).is_absolute()
        assert Path(estimator.model).samefile(tmp_path / "cell" / "mine.safetensors")


def test_a_file_that_is_only_in_the_working_directory_is_refused_with_the_right_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cells").mkdir()
    shutil.copy(MODELS / "sim_gdn.safetensors", tmp_path / "mine.safetensors")
    path = written(tmp_path / "cells", (MODEL, "model: mine.safetensors"))
    monkeypatch.chdir(tmp_path)
    assert "write ../mine.safetensors" in only_problem(path).hint
    written(tmp_path / "cells", (MODEL, "model: ../mine.safetensors"))
    plan_cell(path)


def test_a_model_of_the_command_line_is_relative_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cells").mkdir()
    shutil.copy(MODELS / "sim_gdn.safetensors", tmp_path / "mine.safetensors")
    path = written(tmp_path / "cells", (MODEL, "model: none.safetensors"))
    monkeypatch.chdir(tmp_path)
    plan_cell(path, model="mine.safetensors")


def test_a_tip_file_beside_the_cell_file(tmp_path: Path) -> None:
    from touchcell.simulation.tip_file import SHIPPED as TIPS

    tip = next(TIPS.glob("*.yaml"))
    shutil.copy(tip, tmp_path / "mine.yaml")
    path = written(tmp_path, ("latency_ms: 10", "tip: mine.yaml"))
    assert main(["run", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == EXIT_OK
    plan_cell(written(tmp_path, ("latency_ms: 10", f"tip: {tip.stem}")))


def test_the_folder_of_a_run_is_read_although_its_files_are_gone(tmp_path: Path) -> None:
    path = written(tmp_path, (MODEL, "model: gone.safetensors"))
    assert plan_cell(path, to_run=False).cell.name == "surface_follow_sim"


def test_a_data_set_that_nothing_reads_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path)
    assert main(["run", str(path), "--data", str(tmp_path), "--out", str(tmp_path / "run")]) == EXIT_BAD_INPUT
    assert "no device reads" in capsys.readouterr().err


def test_a_base_whose_name_is_too_long_for_a_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="extends: no such file"):
        plan_cell(written(tmp_path, ("schema: 1", f"schema: 1\nextends: {'9' * 5000}x")))


@pytest.mark.parametrize("cell", ["surface_follow_sim", "object_track_sim", "single_push_sim", "dual_push_sim"])
def test_a_filter_that_counts_from_first_touch_is_refused_where_the_contact_glides(cell: str) -> None:
    path = CONFIGS / f"{cell}.yaml"
    name = next(iter(yaml.safe_load(path.read_text())["sensors"]))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path, settings={f"sensors.{name}.estimator.filter": {"model": "slip_aware"}})
    (problem,) = caught.value.problems
    assert problem.key == f"sensors.{name}.estimator.filter.model"
    assert problem.hint == "model: stick_slip"
