"""``python -m touchcell.cell.cli.reference DIR``: a page of Markdown for each kind of thing in cell files."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from touchcell.cell.cli.catalog import KINDS, Entry, Key, describe, names

_TITLES = {
    "section": "Sections of a cell file",
    "driver": "Drivers",
    "task": "Tasks",
    "interlock": "Interlocks",
    "estimator": "Estimators",
    "architecture": "Architectures of model files",
    "trainer": "Trainers",
    "filter": "Filters",
    "surface": "Surfaces of a simulated scene",
    "object": "Shapes of objects in a simulated scene",
}
_HEAD = ("key", "type", "unit", "default", "limits", "meaning")


def write_reference(folder: Path) -> list[Path]:
    """Write the pages into ``folder``, made where it is not there, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = []
    for kind in KINDS:
        page = folder / f"keys-{kind}.md"
        page.write_text("\n".join(page_of(kind)) + "\n")
        pages.append(page)
    return pages


def page_of(kind: str) -> Iterator[str]:
    """Yield the lines of the page of a kind."""
    yield f"# {_TITLES[kind]}"
    yield ""
    yield f"Made from what is installed; `touchcell describe {kind} NAME` prints the same."
    for name in names(kind):
        entry = describe(kind, name)
        yield from ("", f"## {name}", "", _sentence(entry.summary))
        if entry.text:
            yield from ("", entry.text)
        if entry.keys:
            yield from ("", *table(entry))


def table(entry: Entry) -> Iterator[str]:
    """Yield the keys of an entry as lines of a Markdown table."""
    yield f"| {' | '.join(_HEAD)} |"
    yield f"|{'---|' * len(_HEAD)}"
    for key in entry.keys:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in _cells(key))} |"


def _cells(key: Key) -> tuple[str, ...]:
    default = "required" if key.default is None else f"`{key.default}`"
    return f"`{key.name}`", key.type, key.unit, default, key.limits, key.meaning.replace("``", "`")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m touchcell.cell.cli.reference DIR")
    for written in write_reference(Path(sys.argv[1])):
        print(written)
