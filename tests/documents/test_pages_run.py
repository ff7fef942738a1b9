"""Pages that are followed literally, from top to bottom, in an empty folder.

A block with ``title="FILE"`` is written there. ``sh`` blocks run in a shell that stops at the first failure; a comment
``exits with N`` above one says which exit code is right, ``not run: REASON`` leaves one out. ``python`` blocks without
a title run in the folder. A ``pyproject.toml`` counts as installed: its entry points are found, nothing is downloaded.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.documents.pages import DOCS, FOLLOWED, Block, blocks
from touchcell.paths import CHECKOUT

_TIMEOUT_S = 300


def _names(page: Path) -> str:
    return str(page.relative_to(CHECKOUT))


def _run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    env = {**os.environ, "PATH": path, "PYTHONPATH": str(folder), "MPLBACKEND": "Agg"}
    return subprocess.run(
        command,
        cwd=folder,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_TIMEOUT_S,
        check=False,
    )


def _install(pyproject: str, folder: Path) -> None:
    project = tomllib.loads(pyproject)["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8"
    )
    sections = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in points.items())])
        for group, points in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def _follow(block: Block, folder: Path) -> None:
    if block.title:
        file = folder / block.title
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(block.text, encoding="utf-8")
        if file.name == "pyproject.toml":
            _install(block.text, folder)
        return
    if block.note.startswith("not run:") or block.language not in {"sh", "python"}:
        return
    wanted = re.search(r"exits with (\d+)", block.note)
    shell = ["bash", "-euo", "pipefail", "-c"]
    done = _run([*shell, block.text] if block.language == "sh" else [sys.executable, "-c", block.text], folder)
    assert done.returncode == (int(wanted[1]) if wanted else 0), f"{block}:\n{block.text}\n{done.stdout[-4000:]}"
    assert "Traceback" not in done.stdout, f"{block}:\n{done.stdout[-4000:]}"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "page",
    # A dozen whole runs; tests/cell/sweeps has shorter ones of each kind.
    [pytest.param(page, marks=[pytest.mark.exhaustive] * (page.name == "sweep.md")) for page in FOLLOWED],
    ids=_names,
)
def test_a_page_followed_literally_does_what_it_says(page: Path, tmp_path: Path) -> None:
    followed = list(blocks(page))
    assert followed
    for block in followed:
        _follow(block, tmp_path)


@pytest.mark.slow
def test_the_python_program_of_the_readme_runs(tmp_path: Path) -> None:
    (program,) = [block for block in blocks(CHECKOUT / "README.md") if block.language == "python"]
    assert len(program.text.splitlines()) <= 5
    _follow(program, tmp_path)


def test_every_python_block_compiles() -> None:
    pages = sorted([CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
    for block in (block for page in pages for block in blocks(page) if block.language == "python"):
        compile(block.text, str(block), "exec")


@pytest.mark.parametrize("page", [page for page in sorted(DOCS.rglob("*.md")) if page not in FOLLOWED], ids=_names)
def test_pages_that_are_not_followed_have_no_python_that_nobody_runs(page: Path) -> None:
    # Code of the package that tests/packaging/test_plugins.py installs is held to it there.
    python = [block for block in blocks(page) if block.language == "python" and not block.text.startswith("# acme/")]
    assert [str(block) for block in python] == []
