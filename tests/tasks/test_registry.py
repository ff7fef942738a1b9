"""Tasks are found by name, their specs are consistent, and their documentation page is up to date."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from touchcell.errors import ConfigError
from touchcell.tasks import diagrams
from touchcell.tasks.interface import TASKS, TaskContext, TaskSpec


@pytest.mark.parametrize("name", ["data_collection", "object_tracking", "observe", "surface_following"])
def test_specs(name):
    assert name in TASKS.names()
    spec = TASKS.load(name)
    assert isinstance(spec, TaskSpec)
    assert spec.name == name
    assert spec.summary
    task = spec.build(spec.config(), TaskContext(100.0, {role: np.eye(4) for role in spec.sensors}))
    assert not task.finished
    assert task.transitions == ()


def test_an_unknown_task_is_answered_with_a_suggestion():
    with pytest.raises(ConfigError) as caught:
        TASKS.load("surface_folowing")
    assert caught.value.key == "task"
    assert "surface_following" in caught.value.hint


def test_listing_imports_no_task():
    code = "import sys; from touchcell.tasks.interface import TASKS; TASKS.names(); print('transitions' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_diagrams_in_the_documentation_are_those_of_the_code():
    page = diagrams.PAGE.read_text(encoding="utf-8")
    assert diagrams.redrawn(page) == page, "run: python -m touchcell.tasks.diagrams"
    assert page.count("```mermaid") == len(diagrams.tables())


def test_diagrams_can_be_redrawn_anywhere(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# x\n<!-- diagram: observe -->\nold\n<!-- end of diagram -->\nrest\n")
    diagrams.main([str(page)])
    text = page.read_text()
    assert "old" not in text
    assert text.startswith("# x\n")
    assert text.endswith("<!-- end of diagram -->\nrest\n")
    assert "wait --> observe: frame" in text
