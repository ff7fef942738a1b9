"""``touchcell new hil``: the module that it writes is green on its cell, and red on a cell that is protected less."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers.sampling import sampled
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.paths import CONFIGS
from touchcell.testing.generated import BENCH_TAKEN


@pytest.fixture
def module(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    cell = tmp_path / "cell.yaml"
    cell.write_text((CONFIGS / "surface_follow_bench.yaml").read_text())
    assert main(["new", "hil", str(cell), "--out", str(tmp_path)]) == EXIT_OK
    capsys.readouterr()
    return tmp_path / "test_cell_hil.py"


def run(module: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the module in a session of its own."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", module.name, *arguments]
    return subprocess.run(
        command, cwd=module.parent, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )


def changed(module: Path, name: str, change: dict[str, Any] | None) -> None:
    cell = module.with_name("cell.yaml")
    data = yaml.safe_load(cell.read_text())
    if change is None:
        del data["interlocks"][name]
    else:
        data["interlocks"][name] |= change
    cell.write_text(yaml.safe_dump(data))


def test_it_is_green_in_simulation_and_leaves_evidence(module: Path, tmp_path: Path) -> None:
    page, junit = tmp_path / "evidence.html", tmp_path / "junit.xml"
    done = run(module, "-k", "stale_arm or in_run", f"--hil-report={page}", f"--junitxml={junit}")
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout
    text = page.read_text()
    assert "3 passed" in text
    assert "data:image/png;base64," in text
    assert "sha256" in text
    assert "first cause stale_arm" in text
    assert junit.is_file()


@pytest.mark.parametrize(
    ("name", "change"),
    sampled(
        [
            ("stale_arm", None),
            ("stale_arm", {"limit_ms": 800}),
            ("tilt", {"limit_deg": 60}),
            ("tcp_speed", {"limit_m_s": 0.25}),
            ("workspace", {"max_mm": [610, -50, 460]}),
            ("uncertain", {"hold_ms": 1500}),
            ("shear", {"severity": "limit"}),
        ],
        3,
    ),
)
def test_a_cell_that_is_protected_less_is_red(module: Path, name: str, change: dict[str, Any] | None) -> None:
    changed(module, name, change)
    done = run(module, "-k", f"interlock_{name}")
    # A cell that is refused for it, because nothing else guards an arm, is an error of the session.
    assert done.returncode in (pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED), done.stdout + done.stderr
    assert f"interlock_{name}" in done.stdout or "InvalidCell" in done.stdout


def test_on_the_bench_it_asks_a_person_and_without_a_terminal_says_how_in_one_line(module: Path) -> None:
    done = run(module, "-m", "hil", "-k", "stale_arm")
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "--hil-yes" in done.stdout + done.stderr


def test_a_bench_that_is_taken_has_an_exit_code_of_its_own(module: Path) -> None:
    from touchcell.cell.config.schema import plan_in_world
    from touchcell.cell.runtime.bench_lock import bench_lock

    host = {"arms.arm.host": "192.0.2.77"}
    cell = module.with_name("cell.yaml")
    cell.write_text(cell.read_text().replace("192.168.1.10", host["arms.arm.host"]))
    with bench_lock(plan_in_world(cell, "bench")):
        done = run(module, "-m", "hil", "--hil-yes", "-k", "stale_arm")
    assert done.returncode == BENCH_TAKEN
    assert "is in use by" in done.stdout + done.stderr


def test_a_module_that_is_there_is_not_overwritten(module: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "hil", str(module.with_name("cell.yaml")), "--out", str(module.parent)]) == EXIT_BAD_INPUT
    assert "is there already" in capsys.readouterr().err
