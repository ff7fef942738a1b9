"""Every command in a document is one that the real parsers accept, about things that exist."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pytest

from benchmarks.__main__ import BENCHMARKS
from tests.documents.pages import PAGES, Block, all_blocks, spans
from touchcell.cell.bench.catalog import benchmark_names
from touchcell.cell.cli.main import main
from touchcell.paths import CHECKOUT, CONFIGS

SHELL = ("sh", "bash", "console")


@dataclass(frozen=True)
class Command:
    block: Block
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.block}: {' '.join(self.words)}"


def _commands() -> Iterator[Command]:
    for block in all_blocks(*SHELL):
        for line in block.text.replace("\\\n", " ").splitlines():
            for part in re.split(r"\s*(?:;|&&|\|)\s+", line.removeprefix("$ ")):
                words = shlex.split(re.sub(r"\s>\s*\S+", "", part), comments=True)
                while words and re.fullmatch(r"env|[A-Z_0-9]+=.*", words[0]):
                    words.pop(0)
                if words:
                    yield Command(block, tuple(words))


COMMANDS = tuple(_commands())


def _of(*programs: str) -> list[Command]:
    return [command for command in COMMANDS if command.words[0].removeprefix(".venv/bin/") in programs]


class Parsed(Exception):
    """The arguments were accepted; nothing is to run."""


def _parses(words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    parse = argparse.ArgumentParser.parse_args
    accepted: list[argparse.Namespace] = []

    def stop_after(self: argparse.ArgumentParser, *arguments: object, **named: object) -> argparse.Namespace:
        accepted.append(parse(self, *arguments, **named))  # type: ignore[call-overload]
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop_after)
    with pytest.raises(Parsed):
        main(words)
    return accepted[0]


@pytest.mark.parametrize("command", _of("touchcell"), ids=str)
def test_touchcell_accepts_the_command(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    words = command.words[1:]
    _parses(words, monkeypatch)
    if words[0] == "bench" and len(words) > 1:
        assert words[1] == "NAME" or words[1] in benchmark_names()


@pytest.mark.parametrize(
    "span", sorted({span for page in PAGES for span in spans(page) if re.match(r"touchcell [a-z-]+ [^=]", span)})
)
def test_touchcell_knows_what_a_sentence_names(
    span: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not re.search(r"[\[|]|\.\.\.", span):
        try:
            _parses(shlex.split(span)[1:], monkeypatch)
        except SystemExit:  # A sentence may leave out what it does not talk about.
            assert re.search(r"required|expected (at least )?one argument", capsys.readouterr().err)


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_cells_that_are_named_ship(command: Command) -> None:
    named = [word for word in command.words if word.startswith("configs/")]
    assert [word for word in named if not (CONFIGS / word.removeprefix("configs/")).is_file()] == []


@pytest.mark.parametrize("command", _of("make"), ids=str)
def test_make_has_the_target(command: Command) -> None:
    targets = re.findall(r"^([a-z]+):", (CHECKOUT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    wanted = [word for word in command.words[1:] if "=" not in word]
    assert set(wanted) <= set(targets)


@pytest.mark.parametrize("command", _of("python"), ids=str)
def test_python_is_asked_for_modules_and_extras_that_exist(command: Command) -> None:
    match command.words[1:]:
        case ["-m", "pip", "install", *arguments]:
            extras = re.findall(r"\[([a-z,]+)\]", " ".join(arguments))
            project = (CHECKOUT / "pyproject.toml").read_text(encoding="utf-8")
            for extra in ",".join(extras).split(","):
                assert not extra or re.search(rf"^{extra} = \[", project, re.MULTILINE)
        case ["-m", "benchmarks", name, *_]:
            assert name in BENCHMARKS
        case ["-m", module, *_]:
            assert module in {"build", "pytest", "touchcell.tasks.diagrams", "venv"}
        case _:
            pytest.fail("say how to test it")


def test_documents_have_commands() -> None:
    assert len(_of("touchcell")) > 40
