"""Cell files that build on others: what wins, and where each value is said to come from."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from touchcell.cell.config.layers import explain, load_layers
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.settings import parse_settings, with_settings
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(SHIPPED.read_text())
    path = tmp_path / "bench.yaml"
    path.write_text(
        "extends: base.yaml\nname: bench\ntask:\n  depth_mm: 2\ninterlocks:\n  indentation: {limit_mm: 5}\n"
    )
    return path


def test_mappings_are_merged_and_other_values_replaced(cell: Path) -> None:
    plan = plan_cell(cell)
    task = plan.task_config.model_dump()
    assert (plan.cell.name, task["depth_mm"], task["speed_mm_s"]) == ("bench", 2.0, 20.0)
    assert plan.cell.interlocks["indentation"].model_dump()["limit_mm"] == 5.0


def test_a_mistake_names_the_file_and_line_it_stands_in(cell: Path) -> None:
    base = cell.parent / "base.yaml"
    base.write_text(base.read_text().replace("speed_mm_s: 20", "speed_mm_s: fast"))
    line = next(n for n, text in enumerate(base.read_text().splitlines(), 1) if "fast" in text)
    with pytest.raises(ConfigError) as caught:
        plan_cell(cell)
    assert (caught.value.file, caught.value.line, caught.value.key) == (str(base), line, "task.speed_mm_s")
    cell.write_text(cell.read_text().replace("depth_mm: 2", "depth_mm: deep"))
    with pytest.raises(ConfigError) as caught:
        plan_cell(cell)
    assert (caught.value.file, caught.value.line) == (str(cell), 4)


def test_a_setting_is_checked_like_the_file_and_named_as_its_source(cell: Path) -> None:
    assert plan_cell(cell, settings={"task.depth_mm": 4}).task_config.model_dump()["depth_mm"] == 4.0
    with pytest.raises(ConfigError) as caught:
        plan_cell(cell, settings=parse_settings(["task.depth_mm=very"]))
    assert (caught.value.file, caught.value.key) == ("--set", "task.depth_mm")
    with pytest.raises(ConfigError, match="unknown key") as caught:
        plan_cell(cell, settings={"task.dept_mm": 4})
    assert "depth_mm" in caught.value.hint


def test_keys_for_anchors_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    text = SHIPPED.read_text().replace("limits: {tcp_speed_m_s: 0.10, tcp_accel_m_s2: 0.5}", "limits: *slow")
    path.write_text("x-limits: &slow {tcp_speed_m_s: 0.05, tcp_accel_m_s2: 0.5}\n" + text)
    assert plan_cell(path).arms["arm"].config.model_dump()["limits"]["tcp_speed_m_s"] == 0.05


def test_every_value_is_explained_with_its_source(cell: Path) -> None:
    text = explain(load_layers(cell, {"task.speed_mm_s": 10}))
    rows = {row.split(":")[0].strip(): row for row in text.splitlines()}
    assert rows["depth_mm"].endswith(f"# {cell}:4")
    assert rows["direction_deg"].split("#")[1].strip().startswith(str(cell.parent / "base.yaml"))
    assert rows["speed_mm_s"].endswith("# --set")
    assert yaml.safe_load(text) == load_layers(cell, {"task.speed_mm_s": 10}).data


def test_what_is_written_into_the_run_folder_means_the_same(cell: Path, tmp_path: Path) -> None:
    plan = plan_cell(cell, settings={"task.speed_mm_s": 10})
    copy = tmp_path / "copy.yaml"
    copy.write_text(plan.text())
    assert plan_cell(copy).cell == plan.cell
    assert plan_cell(SHIPPED).text() == SHIPPED.read_text()


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"a.yaml": "extends: a.yaml"}, "back to a file"),
        ({"a.yaml": "extends: b.yaml", "b.yaml": "extends: a.yaml"}, "back to a file"),
        ({"a.yaml": "extends: none.yaml"}, "no such file"),
        ({"a.yaml": "extends: 3"}, "no path"),
        ({"a.yaml": "extends: [b.yaml]"}, "no path"),
        (
            {f"{chr(97 + i)}.yaml": f"extends: {chr(98 + i)}.yaml" for i in range(12)} | {"m.yaml": "schema: 1"},
            "more than 8 files",
        ),
    ],
)
def test_a_base_that_cannot_be_used_is_refused(files: dict[str, str], reason: str, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text + "\n")
    with pytest.raises(ConfigError, match=reason) as caught:
        load_layers(tmp_path / "a.yaml")
    assert caught.value.key == "extends"


def test_a_base_is_found_beside_the_file_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "base.yaml").write_text(SHIPPED.read_text())
    (tmp_path / "inner" / "middle.yaml").write_text("extends: base.yaml\nname: middle\n")
    (tmp_path / "top.yaml").write_text("extends: inner/middle.yaml\nseed: 9\n")
    plan = plan_cell(tmp_path / "top.yaml")
    assert (plan.cell.name, plan.cell.seed) == ("middle", 9)


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("a.b=1", 1),
        ("a.b=1.5", 1.5),
        ("a.b=yes", "yes"),
        ("a.b=[1, 2]", [1, 2]),
        ("a.b={c: 1}", {"c": 1}),
        ("a.b=", None),
    ],
)
def test_values_of_settings_are_written_as_in_a_cell_file(argument: str, value: object) -> None:
    assert parse_settings([argument]) == {"a.b": value}


@pytest.mark.parametrize("argument", ["a", "=1", ".a=1", "a..b=1", "a=[1", "a={"])
def test_what_is_no_setting_is_refused(argument: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_settings([argument])
    assert caught.value.file == "--set"


DATA = st.recursive(
    st.integers() | st.text("ab"),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=8,
)


@given(base=st.dictionaries(st.sampled_from("abc"), DATA, max_size=3), key=st.sampled_from(["a", "b.a", "c.b.a"]))
def test_a_setting_changes_its_key_and_no_other(base: dict[str, object], key: str) -> None:
    before = yaml.safe_dump(base)
    try:
        after = with_settings(base, {key: "new"})
    except ConfigError:
        return
    assert yaml.safe_dump(base) == before
    section: object = after
    for part in key.split("."):
        assert isinstance(section, dict)
        section = section[part]
    assert section == "new"
    top = key.split(".")[0]
    assert {name: value for name, value in after.items() if name != top} == {
        name: value for name, value in base.items() if name != top
    }
