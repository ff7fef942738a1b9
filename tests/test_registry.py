"""Plug-ins are found by name, and whatever is wrong with one is a ConfigError that names it and the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import pytest

from touchcell import registry
from touchcell.errors import ConfigError
from touchcell.registry import Registry


@dataclass(frozen=True)
class Spec:
    name: str


@runtime_checkable
class Shape(Protocol):
    def area(self) -> float: ...


SPECS = Registry("touchcell.test_specs", "specimen", Spec)
SHAPES = Registry("touchcell.test_specs", "shape", Shape)
MODULE = """
from tests.test_registry import Spec
GOOD = Spec("good")
OTHER = Spec("another")
class Square:
    def area(self): return 1.0
"""


class Site:
    """A folder on the path of modules in which distributions are put."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "registry_specimens.py").write_text(MODULE)

    def add(self, distribution: str, **points: str) -> None:
        folder = self._folder / f"{distribution}-1.2.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n")
        lines = [f"{name} = {value}" for name, value in points.items()]
        (folder / "entry_points.txt").write_text("\n".join(["[touchcell.test_specs]", *lines]) + "\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.syspath_prepend(tmp_path)
    _forget()
    yield Site(tmp_path)
    _forget()


def _forget() -> None:
    registry._everywhere.cache_clear()
    registry._points.cache_clear()


def test_specs_are_loaded_by_name(site):
    site.add("acme", good="registry_specimens:GOOD")
    assert SPECS.names() == ("good",)
    assert SPECS.load("good") == Spec("good")


def test_a_protocol_may_be_what_is_wanted(site):
    site.add("acme", square="registry_specimens:Square", good="registry_specimens:GOOD")
    assert SHAPES.load("square")().area() == 1.0
    with pytest.raises(ConfigError, match="leads to a Spec, not to a Shape"):
        SHAPES.load("good")


def test_an_unknown_name_is_answered_with_a_suggestion(site):
    site.add("acme", good="registry_specimens:GOOD")
    with pytest.raises(ConfigError, match="unknown specimen 'goodd'") as caught:
        SPECS.load("goodd")
    assert (caught.value.key, caught.value.value) == ("specimen", "goodd")
    assert caught.value.hint == "did you mean 'good'?"


@pytest.mark.parametrize(
    ("value", "reason", "hint"),
    [
        (
            "no_such_module:SPEC",
            "cannot be imported: ModuleNotFoundError: No module named 'no_such_module'",
            "acme 1.2",
        ),
        ("registry_specimens:MISSING", "cannot be imported: AttributeError", "repair or uninstall acme 1.2"),
        ("registry_specimens:Square", "leads to a type, not to a Spec", "point it at the Spec"),
        ("registry_specimens:OTHER", "leads to the Spec of 'another'", "one name"),
    ],
)
def test_a_broken_entry_point_is_named_with_its_distribution_and_the_remedy(site, value, reason, hint):
    site.add("acme", good=value)
    with pytest.raises(ConfigError) as caught:
        SPECS.load("good")
    assert f"entry point good = '{value}' of acme 1.2 {reason}" in caught.value.reason
    assert hint in caught.value.hint


def test_a_module_that_fails_while_it_is_imported_is_no_traceback(site, tmp_path):
    (tmp_path / "registry_broken.py").write_text("raise RuntimeError('no licence')")
    site.add("acme", good="registry_broken:SPEC")
    with pytest.raises(ConfigError, match="RuntimeError: no licence"):
        SPECS.load("good")


def test_two_distributions_may_not_claim_one_name(site):
    site.add("acme", good="registry_specimens:GOOD")
    site.add("emca", good="registry_specimens:GOOD")
    assert SPECS.names() == ("good",)
    with pytest.raises(ConfigError, match="is claimed by") as caught:
        SPECS.load("good")
    assert "acme 1.2" in caught.value.reason
    assert "emca 1.2" in caught.value.reason
    assert caught.value.hint == "uninstall all but one of them"
