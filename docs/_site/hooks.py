"""Hooks of the site: references of the command line and of all keys, from the parsers and models themselves."""

from __future__ import annotations

import contextlib
import io
import os
import re
from typing import Any

COMMAND_LINE = "<!-- generated: command line -->"
KEYS = "<!-- generated: keys -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the places of generated text on a page."""
    for place, text in ((COMMAND_LINE, command_line), (KEYS, keys)):
        if place in markdown:
            markdown = markdown.replace(place, text())
    return markdown


def keys() -> str:
    """Return the reference of all keys of cell files, as Markdown, a level below the page's title."""
    from touchcell.cell.cli.catalog import KINDS
    from touchcell.cell.cli.reference import page_of

    lines = [line for kind in KINDS for line in (*page_of(kind), "")]
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in lines)


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
