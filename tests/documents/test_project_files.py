"""What the project says about itself is the same everywhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from tests.documents.pages import DOCS
from touchcell.paths import CHECKOUT

README = (CHECKOUT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
FIGURES = re.findall(r"^\| (.+?) \| (.+?) \| \[[a-z-]+\]\(docs/benchmarks/([a-z-]+\.txt)\) \|$", README, re.MULTILINE)


def test_one_version() -> None:
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    released = re.findall(r"^## \[(\d\S*)\]", (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert citation["version"] == released[0] == PROJECT["version"]


def test_the_readme_fits_its_bounds() -> None:
    assert len(README.splitlines()) <= 150
    assert len(FIGURES) == 7


@pytest.mark.parametrize(("what", "figure", "file"), FIGURES)
def test_figures_of_the_readme_stand_in_the_output_that_they_name(what: str, figure: str, file: str) -> None:
    output = (DOCS / "benchmarks" / file).read_text(encoding="utf-8")
    numbers = re.findall(r"\d+(?:\.\d+)?", figure)
    assert numbers
    assert [number for number in numbers if not re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.]*\d)", output)] == []


def test_ci_covers_the_pythons_that_the_metadata_names() -> None:
    workflow = yaml.safe_load((CHECKOUT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    classified = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if "Python :: 3." in c}
    assert set(workflow["jobs"]["test"]["strategy"]["matrix"]["python"]) == classified


@pytest.mark.parametrize("form", sorted((CHECKOUT / ".github").rglob("*.yml")), ids=lambda file: file.name)
def test_files_of_the_hosting_service_are_yaml(form: Path) -> None:
    assert yaml.safe_load(form.read_text(encoding="utf-8"))
