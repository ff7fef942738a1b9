"""``describe`` and the reference pages show every key with unit, default, limits and meaning."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from touchcell.cell.cli.catalog import KINDS, describe, names
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.cli.reference import write_reference
from touchcell.units import unit_of


def test_a_key_is_described_with_unit_default_limits_and_meaning() -> None:
    keys = {key.name: key for key in describe("driver", "sim_arm").keys}
    speed = keys["limits.tcp_speed_m_s"]
    assert (speed.type, speed.unit, speed.default, speed.limits) == ("number", "m/s", "0.1", "> 0.0, <= 1.0")
    assert speed.meaning == "largest linear speed."
    start = keys["start_pose_mm_deg"]
    assert (start.type, start.unit, start.default) == ("list of 6 numbers", "mm, deg", None)


def test_sections_inside_lists_and_mappings_are_described_too() -> None:
    assert "motors[].esc_id" in {key.name for key in describe("driver", "damiao_can").keys}
    assert "objects.*.mass_g" in {key.name for key in describe("section", "scene").keys}
    assert "body[].radius_mm" in {key.name for key in describe("section", "arm").keys}


def test_sections_of_plugins_are_kinds_of_their_own() -> None:
    (interlocks,) = [key for key in describe("section", "file").keys if key.name == "interlocks"]
    assert interlocks.type == "mapping of names to section of an interlock"


def test_describe_goes_from_kinds_to_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe"]) == EXIT_OK
    assert "interlock: arm_state_age, clearance" in capsys.readouterr().out
    assert main(["describe", "interlock"]) == EXIT_OK
    assert "\nshear  " in capsys.readouterr().out
    assert main(["describe", "interlock", "shear"]) == EXIT_OK
    assert "limit_mm: number; mm; required; > 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        (["interlok"], "did you mean 'interlock'?"),
        (["interlock", "shera"], "did you mean 'shear'?"),
        (["section", "scne"], "did you mean 'scene'?"),
    ],
)
def test_a_typo_gets_a_suggestion(words: list[str], suggestion: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", *words]) == EXIT_BAD_INPUT
    assert suggestion in capsys.readouterr().err


def test_schema_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == EXIT_OK
    assert json.loads(capsys.readouterr().out)["$schema"].endswith("2020-12/schema")


def test_the_reference_has_every_key_of_everything(tmp_path: Path) -> None:
    pages = {page.stem.removeprefix("keys-"): page.read_text() for page in write_reference(tmp_path / "reference")}
    assert set(pages) == set(KINDS)
    for kind in KINDS:
        for name in names(kind):
            section = pages[kind].partition(f"\n## {name}\n")[2].partition("\n## ")[0]
            assert all(f"\n| `{key.name}` | " in section for key in describe(kind, name).keys), f"{kind} {name}"


@pytest.mark.parametrize(
    ("name", "unit"),
    [("drift_mm_per_sqrt_s", "mm/sqrt(s)"), ("kp_n_m_rad", "N m/rad"), ("s", ""), ("min_ticks", "ticks"), ("kind", "")],
)
def test_units_are_read_from_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit
