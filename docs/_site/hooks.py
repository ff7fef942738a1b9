"""Hooks of the site: the references of command line and cell files are made by what they describe."""

from __future__ import annotations

import contextlib
import io
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PLACE = "<!-- generated: command line -->"


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add a page of keys for each kind of thing that a cell file may name."""
    from touchcell.cell.cli.reference import write_reference

    with tempfile.TemporaryDirectory() as folder:
        for page in write_reference(Path(folder)):
            content = page.read_text(encoding="utf-8")
            files.append(File.generated(config, f"reference/{page.name}", content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the place of generated text on a page."""
    return markdown.replace(PLACE, command_line()) if PLACE in markdown else markdown


def command_line() -> str:
    """Return the help of touchcell and of each of its commands, as Markdown."""
    overview = _help()
    names = re.findall(r"^ {4}([a-z][a-z-]*)(?: |$)", overview, re.MULTILINE)
    sections = [f"```text\n{overview}```"]
    # The options of emulate are those of the emulators that are installed.
    named = [name for name in dict.fromkeys(names) if name != "emulate"]
    sections += [f"## touchcell {name}\n\n```text\n{_help(name)}```" for name in named]
    return "\n\n".join(sections)


def _help(*words: str) -> str:
    from touchcell.cell.cli.main import main

    printed = io.StringIO()
    columns, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "100"
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        if columns is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns
    return printed.getvalue()
