"""Cell files are found by path, or by the name of a shipped one."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchcell.cell.config.find import find_cell
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


@pytest.mark.parametrize("name", ["surface_follow_sim", "surface_follow_sim.yaml", "configs/surface_follow_sim.yaml"])
def test_a_shipped_cell_is_found_from_any_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_cell(Path(name)) == SHIPPED


@pytest.mark.parametrize("name", ["surface_follow_sim", "surface_follow_sim.yaml"])
def test_a_file_of_ones_own_comes_before_a_shipped_one(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "surface_follow_sim").mkdir()
    (tmp_path / "surface_follow_sim.yaml").touch()
    assert find_cell(Path(name)) == Path("surface_follow_sim.yaml")


@pytest.mark.parametrize("name", ["nothing", "nothing.yaml", ".", "..", ""])
def test_what_is_not_found_stays_as_it_was_given(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_cell(Path(name)) == Path(name)
