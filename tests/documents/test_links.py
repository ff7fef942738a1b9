"""Every relative link of every document leads somewhere, and none out of the site or the repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.documents.pages import DOCS, PAGES, anchors, links, prose
from touchcell.paths import CHECKOUT

OUTSIDE = re.compile(r"\b(?:PEERS|NUMERICS|(?:SPEC|SIMULATION|PROTOCOLS|PERCEPTION) part|findings/)\b")


def _names(page: Path) -> str:
    return str(page.relative_to(CHECKOUT))


@pytest.mark.parametrize("page", PAGES, ids=_names)
def test_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    broken = []
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.is_relative_to(DOCS)], ids=_names)
def test_pages_of_the_site_link_within_the_site_only(page: Path) -> None:
    relative = [target.partition("#")[0] for target in links(page) if not re.match(r"[a-z]+:", target)]
    assert [target for target in relative if target and not _normal(page.parent / target).is_relative_to(DOCS)] == []


def _normal(path: Path) -> Path:
    # Not `resolve`, which follows the links that pages of devices are.
    parts: list[str] = []
    for part in path.parts:
        if part == "..":
            parts.pop()
        else:
            parts.append(part)
    return Path(*parts)


@pytest.mark.parametrize("page", PAGES, ids=_names)
def test_no_page_refers_to_papers_outside_the_repository(page: Path) -> None:
    assert OUTSIDE.findall(prose(page)) == []


def test_no_source_refers_to_papers_outside_the_repository() -> None:
    found = [
        f"{file.relative_to(CHECKOUT)}: {match[0]}"
        for folder in ("touchcell", "benchmarks", "tests", "configs")
        for file in sorted((CHECKOUT / folder).rglob("*"))
        if file.suffix in {".py", ".c", ".h", ".yaml"} and file != Path(__file__)
        for match in OUTSIDE.finditer(file.read_text(encoding="utf-8"))
    ]
    assert found == []
