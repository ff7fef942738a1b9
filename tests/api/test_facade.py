"""``import touchcell`` offers its names, and costs nothing before they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import touchcell as tc

HEAVY = ("numpy", "pydantic", "yaml", "torch", "mujoco", "matplotlib", "onnxruntime", "cv2", "rich", "mcap")


def fresh(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_importing_touchcell_imports_none_of_its_own_modules_and_nothing_heavy() -> None:
    loaded = fresh(
        "import sys; before = set(sys.modules); import touchcell; print(*(set(sys.modules) - before))"
    ).split()
    assert [name for name in loaded if name.startswith("touchcell")] == ["touchcell"]
    assert not set(HEAVY) & set(loaded)


@pytest.mark.parametrize("name", ["torch", "mujoco", "matplotlib", "onnxruntime"])
def test_connecting_and_loading_import_nothing_that_they_do_not_need(name: str) -> None:
    used = "tc.connect_arm; tc.load_cell('surface_follow_sim'); tc.read_run"
    code = f"import sys, touchcell as tc; {used}; print(*sys.modules)"
    assert name not in fresh(code).split()


@pytest.mark.parametrize("name", tc.__all__)
def test_every_name_that_is_offered_exists(name: str) -> None:
    assert getattr(tc, name) is not None
    assert name in dir(tc)


def test_names_for_type_checkers_are_those_that_are_offered() -> None:
    import ast
    from pathlib import Path

    assert tc.__file__ is not None
    (checked,) = [node for node in ast.parse(Path(tc.__file__).read_text()).body if isinstance(node, ast.If)]
    sources = [node for node in checked.body if isinstance(node, ast.ImportFrom) and node.module != "typing"]
    imported = {alias.name for node in sources for alias in node.names}
    assert imported | {"__version__"} == set(tc.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="connect_gripper"):
        tc.connect_gripper  # type: ignore[attr-defined]  # noqa: B018
