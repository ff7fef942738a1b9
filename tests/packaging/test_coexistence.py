"""touchcell beside packages of the names that its own rooms have."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.packaging.conftest import Distributions
from tests.packaging.environments import Environment

CELL = "configs/surface_follow_sim.yaml"
USES_PYTHON_CONTROL = "import control; print(control.tf([1], [1, 1]))"


def _both_work(environment: Environment) -> None:
    assert "TransferFunction" in environment.python("-c", USES_PYTHON_CONTROL)
    assert "is valid" in environment.touchcell("check", CELL)


@pytest.fixture(scope="module")
def with_scipy(installed: Environment) -> Environment:
    """python-control needs scipy; touchcell does not."""
    installed.install("scipy")
    return installed


def test_python_control_installed_after_touchcell_works_and_leaves_without_it(with_scipy: Environment) -> None:
    with_scipy.install("--no-deps", "control")
    _both_work(with_scipy)
    with_scipy.uninstall("control")
    assert "is valid" in with_scipy.touchcell("check", CELL)


def test_touchcell_installed_after_python_control_works_and_leaves_without_it(
    with_scipy: Environment, distributions: Distributions
) -> None:
    with_scipy.uninstall("touchcell")
    with_scipy.install("--no-deps", "control")
    with_scipy.install("--no-deps", distributions.wheel)
    _both_work(with_scipy)
    with_scipy.uninstall("touchcell")
    assert "TransferFunction" in with_scipy.python("-c", USES_PYTHON_CONTROL)
    with_scipy.uninstall("control")
    with_scipy.install("--no-deps", distributions.wheel)


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """A user's project with packages of our rooms' names, and a test of its own."""
    for name in ("benchmarks", "cell", "configs", "control", "drivers", "geometry", "perception", "tasks"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text('OWN = "the user\'s"\n')
    (tmp_path / "test_own.py").write_text(
        "import control, drivers, tasks\n\n\ndef test_own():\n    assert control.OWN == drivers.OWN == tasks.OWN\n"
    )
    return tmp_path


def test_pytest_with_our_plugin_runs_in_a_folder_with_packages_of_the_same_names(
    installed: Environment, crowded: Path
) -> None:
    printed = installed.python("-m", "pytest", "-q", cwd=crowded)
    assert "1 passed" in printed
    assert "--hil-yes" in installed.python("-m", "pytest", "--help", cwd=crowded)


@pytest.mark.parametrize("pythonpath", ["", "."])
def test_touchcell_runs_in_a_folder_with_packages_of_the_same_names(
    installed: Environment, crowded: Path, pythonpath: str
) -> None:
    extra = {"PYTHONPATH": pythonpath} if pythonpath else {}
    printed = installed.touchcell("run", CELL, "--out", "run", cwd=crowded, **extra)
    assert "done" in printed
    assert (crowded / "run" / "result.json").is_file()
