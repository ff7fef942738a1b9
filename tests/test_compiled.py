"""A C extension that was not built is never missing in silence."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from touchcell import compiled
from touchcell.cell.cli.main import main

LOST = """
import importlib.abc, sys
class Lost(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name in NAMES:
            raise ImportError(f"{name} was not built")
sys.meta_path.insert(0, Lost())
"""


def without(names: list[str], code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    script = f"NAMES = {names!r}\n{LOST}\n{code}"
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={"PATH": "/usr/bin"} | environment
    )


@pytest.mark.parametrize(
    ("name", "user"),
    [
        ("touchcell.geometry._se3c", "touchcell.geometry.gaussian"),
        ("touchcell.perception._kernelsc", "touchcell.perception.kernels"),
        ("touchcell.simulation._paint", "touchcell.simulation.render"),
    ],
)
def test_a_missing_extension_is_a_warning_or_an_error_where_it_is_required(name: str, user: str) -> None:
    ran = without([name], f"import {user}")
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == f"C extension {name} is missing: {compiled.EXTENSIONS[name]}\n"
    required = without([name], f"import {user}", TOUCHCELL_REQUIRE_COMPILED="1")
    assert required.returncode == 1
    assert f"ExtensionMissing: the C extension {name} cannot be imported: {name} was not built" in required.stderr


def test_all_of_them_missing_is_still_one_warning() -> None:
    code = "import touchcell.geometry.se3, touchcell.perception.kernels, touchcell.simulation.render"
    assert without(list(compiled.EXTENSIONS), code).stderr.count("is missing") == 1


def test_plain_kernels_that_were_asked_for_are_no_loss() -> None:
    code = "import touchcell.geometry.se3 as se3; print(se3.BACKEND)"
    ran = without([], code, TOUCHCELL_PURE_PYTHON="1", TOUCHCELL_REQUIRE_COMPILED="1")
    assert (ran.stdout, ran.stderr) == ("python\n", "")


@pytest.fixture
def lost(monkeypatch: pytest.MonkeyPatch) -> str:
    name = "touchcell.perception._kernelsc"
    real = compiled.import_module  # type: ignore[attr-defined]

    def fail(wanted: str) -> object:
        if wanted == name:
            raise ImportError("not built")
        return real(wanted)

    monkeypatch.setattr(compiled, "import_module", fail)
    return name


def test_devices_and_list_name_what_is_missing(lost: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("devices", "list"):
        assert main([command]) == 0
        assert f"C extension {lost} is missing" in capsys.readouterr().out


def test_a_report_names_what_is_missing(lost: str, tmp_path: Path) -> None:
    import touchcell as tc

    run = tc.run(tc.load_cell("object_track_sim", set={"task.duration_s": 0.1}), out=tmp_path / "run")
    assert f"C extension {lost} is missing" in (run.folder / "summary.txt").read_text()


def test_a_complete_installation_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert all(compiled.extension(name) is not None for name in compiled.EXTENSIONS)
    assert compiled.missing() == []
    assert caplog.records == []
