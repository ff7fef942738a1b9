"""The site builds, strictly: every page is in its place, every link and anchor leads somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents.pages import DOCS
from touchcell.paths import CHECKOUT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (extra `docs`)")
    pytest.importorskip("mkdocstrings", reason="mkdocstrings is not installed (extra `docs`)")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=CHECKOUT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return folder


@pytest.mark.slow
def test_the_site_builds_strictly_with_every_page(site: Path) -> None:
    pages = {page.relative_to(DOCS).with_suffix("") for page in DOCS.rglob("*.md")}
    built = {page.relative_to(site).with_suffix("") for page in site.rglob("*.html")}
    index = {Path(str(page).replace("README", "index")) for page in pages}
    assert index <= built


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "check", "probe", "train", "experiment", "why"])
def test_the_command_line_reference_is_what_the_parsers_print(site: Path, command: str) -> None:
    page = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    assert re.search(rf'id="touchcell-{command}"', page)
    assert f"usage: touchcell {command}" in page


@pytest.mark.slow
def test_the_python_reference_names_what_the_package_exports(site: Path) -> None:
    import touchcell

    page = (site / "reference" / "api.html").read_text(encoding="utf-8")
    elsewhere = {"__version__", "CellPlan", "Cell", "compose", "CommandRejected", "DeviceError", "NotArrived"}
    assert [name for name in touchcell.__all__ if name not in elsewhere and f".{name}" not in page] == []
