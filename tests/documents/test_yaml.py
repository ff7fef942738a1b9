"""YAML in documents is what a cell file may hold.

A block with ``schema:`` is a whole cell. One of arms or sensors alone is held against its drivers. Others name the cell
that they belong to in a comment above: ``merged into configs/NAME.yaml``, with ``, run`` if it has to end as done.
``not a cell`` excuses a block; those of plugins.md come from the package of tests/packaging/acme.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.documents.pages import FOLLOWED, Block, all_blocks
from touchcell.cell.cli.main import main
from touchcell.cell.config.cell_plan import ArmSection, SensorSection
from touchcell.cell.config.schema import plan_cell
from touchcell.drivers.core.spec import DRIVERS
from touchcell.paths import CHECKOUT, CONFIGS

BLOCKS = [block for block in all_blocks("yaml", "yml") if block.page not in FOLLOWED]
_MERGED = re.compile(r"merged into configs/(\S+\.yaml)(, run)?")


def _merge(into: Any, what: Any) -> Any:
    if isinstance(into, dict) and isinstance(what, dict):
        return {**into, **{key: _merge(into.get(key), value) for key, value in what.items()}}
    return what


def _whole(block: Block, folder: Path) -> Path | None:
    values = yaml.safe_load(block.text)
    merged = _MERGED.search(block.note)
    if merged:
        values = _merge(yaml.safe_load((CONFIGS / merged[1]).read_text(encoding="utf-8")), values)
    if "schema" not in values:
        return None
    file = folder / (block.title or "cell.yaml")
    file.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    return file


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_yaml_is_accepted(block: Block, tmp_path: Path) -> None:
    if "not a cell" in block.note:
        assert yaml.safe_load(block.text) is not None
        return
    if block.page.name == "plugins.md":
        assert block.text in (CHECKOUT / "tests" / "packaging" / "acme" / "cell.yaml").read_text(encoding="utf-8")
        return
    whole = _whole(block, tmp_path)
    if whole is not None:
        assert plan_cell(whole).cell.name
        return
    values = yaml.safe_load(block.text)
    assert set(values) <= {"arms", "sensors"}, "name the cell that it belongs to in a comment above the block"
    for section, model in (("arms", ArmSection), ("sensors", SensorSection)):
        for device in values.get(section, {}).values():
            _holds(device, model)


def _holds(device: dict[str, Any], section: type[ArmSection] | type[SensorSection]) -> None:
    own = {key: value for key, value in device.items() if key not in section.model_fields}
    DRIVERS.load(device["driver"]).config.model_validate(own)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("block", [block for block in BLOCKS if block.note.endswith(", run")], ids=str)
def test_yaml_that_is_said_to_run_ends_as_done(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = _whole(block, tmp_path)
    assert whole is not None
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(whole), "--out", str(tmp_path / "run"), "--quiet"]) == 0, capsys.readouterr().out
