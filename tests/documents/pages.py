"""The documents of the repository, cut into links, headings and fenced blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from touchcell.paths import CHECKOUT

DOCS = CHECKOUT / "docs"
PAGES: tuple[Path, ...] = tuple(sorted([*CHECKOUT.glob("*.md"), *DOCS.rglob("*.md")]))
"""Pages at their place in the site: the pages of devices below docs/devices, where links lead to their folders."""

FOLLOWED: tuple[Path, ...] = (
    DOCS / "tutorials" / "first-run.md",
    DOCS / "tutorials" / "test-a-cell.md",
    DOCS / "how-to" / "write-a-task.md",
    DOCS / "how-to" / "write-a-driver.md",
    DOCS / "how-to" / "write-an-interlock.md",
    DOCS / "how-to" / "sweep.md",
)
"""Pages that a test follows from top to bottom."""

_FENCE = re.compile(r"^(?P<indent> *)```(?P<info>[^\n`]*)\n(?P<text>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"<!--\s*((?:(?!-->).)*?)\s*-->\s*\Z", re.DOTALL)
_TITLE = re.compile(r'title="([^"]*)"')
_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^()\s]+)\)")
_HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: file that holds it.
        line: of its first line of text, from 1.
        language: first word behind the fence.
        title: ``title="..."`` behind the fence: the file that the block is.
        note: HTML comment directly above it, which says how it is tested.
        text: what it holds.
    """

    page: Path
    line: int
    language: str
    title: str
    note: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(CHECKOUT)}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """All fenced blocks of a page, from top to bottom."""
    content = page.read_text(encoding="utf-8")
    for fence in _FENCE.finditer(content):
        note = _COMMENT.search(content[: fence.start()])
        title = _TITLE.search(fence["info"])
        yield Block(
            page,
            content.count("\n", 0, fence.start("text")) + 1,
            (fence["info"].split() or [""])[0],
            title[1] if title else "",
            note[1] if note else "",
            fence["text"],
        )


def all_blocks(*languages: str) -> list[Block]:
    """All blocks of all pages in one of these languages."""
    return [block for page in PAGES for block in blocks(page) if block.language in languages]


def prose(page: Path) -> str:
    """A page without its fenced blocks and code spans."""
    return re.sub(r"`[^`\n]*`", "``", _FENCE.sub("", page.read_text(encoding="utf-8")))


def spans(page: Path) -> list[str]:
    """Code spans of a page, line breaks as blanks."""
    found = re.findall(r"(?<!`)`([^`]+)`(?!`)", _FENCE.sub("", page.read_text(encoding="utf-8")))
    return [" ".join(span.split()) for span in found]


def links(page: Path) -> list[str]:
    """Targets of all links and images of a page."""
    return _LINK.findall(_FENCE.sub("", page.read_text(encoding="utf-8")))


def anchors(page: Path) -> frozenset[str]:
    """Anchors that headings make, as GitHub and Python-Markdown do for plain words."""
    content = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return frozenset(_slug(heading) for heading in _HEADING.findall(content))


def _slug(heading: str) -> str:
    words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
    return re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", words).strip().lower())
