"""The JSON Schema of cell files accepts what ships, refuses mistakes, and knows everything that is installed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from touchcell.cell.cli.catalog import KINDS, describe, names
from touchcell.cell.config.json_schema import cell_schema
from touchcell.cell.config.meanings import meanings
from touchcell.paths import CONFIGS

jsonschema = pytest.importorskip("jsonschema")

SHIPPED = sorted(CONFIGS.glob("*.yaml"))


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = cell_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.fixture
def cell() -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    return content


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_cell_that_ships_is_valid(path: Path, validator: Any) -> None:
    assert [error.message for error in validator.iter_errors(yaml.safe_load(path.read_text()))] == []


MISTAKES: dict[str, Callable[[dict[str, Any]], object]] = {
    "unknown section": lambda cell: cell.update(armss={}),
    "unknown driver": lambda cell: cell["arms"]["arm"].update(driver="sim_am"),
    "unknown key of a driver": lambda cell: cell["arms"]["arm"].update(latency=3),
    "key of another driver": lambda cell: cell["arms"]["arm"].update(host="127.0.0.2"),
    "missing key of a driver": lambda cell: cell["arms"]["arm"].pop("start_pose_mm_deg"),
    "pose of five numbers": lambda cell: cell["arms"]["arm"].update(start_pose_mm_deg=[0, 0, 0, 0, 0]),
    "speed above its limit": lambda cell: cell["arms"]["arm"]["limits"].update(tcp_speed_m_s=2),
    "no deactivate": lambda cell: cell["arms"]["arm"].pop("deactivate"),
    "unknown estimator": lambda cell: cell["sensors"]["sensor"]["estimator"].update(kind="nettwork"),
    "unknown key of a filter": lambda cell: cell["sensors"]["sensor"]["estimator"]["filter"].update(drift=1),
    "unknown interlock": lambda cell: cell["interlocks"]["tilt"].update(kind="tillt"),
    "limit of zero": lambda cell: cell["interlocks"]["tilt"].update(limit_deg=0),
    "unknown surface": lambda cell: cell["scene"]["surfaces"]["ramp"].update(kind="rampp"),
    "unknown task": lambda cell: cell["task"].update(name="surface_folowing"),
    "unknown key of a task": lambda cell: cell["task"].update(sped_mm_s=1),
    "text for a number": lambda cell: cell["task"].update(speed_mm_s="fast"),
    "no task": lambda cell: cell.pop("task"),
    "rate of zero": lambda cell: cell.update(rate_hz=0),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused(mistake: str, validator: Any, cell: dict[str, Any]) -> None:
    wrong = copy.deepcopy(cell)
    MISTAKES[mistake](wrong)
    assert not validator.is_valid(wrong)


def test_a_file_that_extends_another_needs_nothing_and_anchors_are_free(validator: Any, cell: dict[str, Any]) -> None:
    assert validator.is_valid({"extends": "base.yaml", "task": {"speed_mm_s": 3}})
    assert validator.is_valid({**cell, "x-mine": {"anything": 1}})
    assert not validator.is_valid({**cell, "y-mine": {}})


def test_steps_name_the_task(validator: Any, cell: dict[str, Any]) -> None:
    steps = [{"move": {"by_mm_deg": [0, 0, 10]}}, {"hold": {"time_s": 1}}]
    assert validator.is_valid({**cell, "task": {"steps": steps}})
    assert not validator.is_valid({**cell, "task": {"steps": [{"jump": {}}]}})
    assert not validator.is_valid({**cell, "task": {}})


def everything() -> list[tuple[str, str]]:
    return [(kind, name) for kind in KINDS for name in names(kind)]


@pytest.mark.parametrize(("kind", "name"), everything())
def test_every_key_has_a_meaning(kind: str, name: str) -> None:
    entry = describe(kind, name)
    assert entry.summary
    assert [key.name for key in entry.keys if not key.meaning] == []
    assert [key.name for key in entry.keys if key.type == "anything"] == []


def test_a_key_without_meaning_is_found() -> None:
    from pydantic import BaseModel, Field

    class Base(BaseModel):
        """Base.

        Attributes:
            first, second: of the base,
                in two lines.
        """

        first: int
        second: int = 0

    class Mine(Base):
        """Mine.

        Attributes:
            second: of mine.
        """

        second: int = 1
        third: int = Field(default=2, description="by its field")
        fourth: int = 3

    assert meanings(Mine) == {"first": "of the base, in two lines.", "second": "of mine.", "third": "by its field"}
