"""Cell files mutated at random: each is valid or refused by a ConfigError, and soon.

``python -m benchmarks fuzz-cells [NUMBER [SEED]]`` tries 10 000.
"""

from __future__ import annotations

import random
import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from touchcell.cell.config.schema import plan_cell
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

_VALUES = (
    "", "~", "yes", "on", "true", "1:30", "012", "0x1F", "1e30", "-1e308", ".nan", ".inf", "9" * 5000, "2026-02-30",
    "2026-11-28T12:00:00Z", "[]", "{}", "[1, 2, 3, 4, 5]", "[[[[[[[[1]]]]]]]]", "{a: {b: c}}", "*a", "&a [*a]", "&a x",
    "!!python/object:os.system ls", "!!int abc", "!!binary aGk=", "!!set {a, b}", "|\n  text", "'", '"\\x"', "../../x",
    "x" * 400, "ä€😀", "\x00", "\x07", "-5", "0", "200.0", "'5'", "null", "<<: *a", "? [a, b]", "builtin:none",
)  # fmt: skip
_LINES = (
    "x: &x [*x]", "? [a, b]\n: c", "1: 2", "yes: no", "\tkey: value", "- item", "<<: {a: b}", "---", "...", "%YAML 1.1",
    "a: &a [x, x, x, x, x, x, x, x]\nb: &b [*a, *a, *a, *a, *a, *a, *a]\nc: &c [*b, *b, *b, *b, *b, *b, *b, *b]\n"
    "d: &d [*c, *c, *c, *c, *c, *c, *c, *c]\ne: &e [*d, *d, *d, *d, *d, *d, *d]\nf: [*e, *e, *e, *e, *e, *e, *e]",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tried:
    """What became of one mutant: "valid", "refused", or what was raised by mistake; and its CPU seconds."""

    content: bytes
    verdict: str
    time_s: float


def mutants(seed: int, configs: Path = CONFIGS) -> Iterator[bytes]:
    """Shipped cells with one to four mutations each, for ever."""
    chance = random.Random(seed)
    shipped = [path.read_text() for path in sorted(configs.glob("*.yaml"))]
    while True:
        text = chance.choice(shipped)
        for _ in range(chance.randint(1, 4)):
            text = _mutated(text, chance)
        content = text.encode(chance.choices(("utf-8", "utf-16", "latin-1"), (50, 1, 1))[0], "replace")
        if chance.random() < 0.1:
            damaged = bytearray(content)
            for _ in range(chance.randint(1, 5)):
                damaged[chance.randrange(len(damaged))] = chance.randrange(256)
            content = bytes(damaged)
        yield content


def _mutated(text: str, chance: random.Random) -> str:
    lines = text.splitlines()
    at = chance.randrange(len(lines)) if lines else 0
    kind = chance.randrange(8)
    if not lines or kind == 0:
        lines.insert(at, " " * chance.choice((0, 0, 2, 4)) + chance.choice(_LINES))
    elif kind == 1:
        del lines[at]
    elif kind == 2:
        lines.insert(at, lines[at])
    elif kind == 3:
        lines[at] = " " * chance.randrange(9) + lines[at].lstrip()
    elif kind == 4:
        lines[at] = re.sub(r"-?\d+(\.\d+)?", lambda _: chance.choice(_VALUES), lines[at], count=1)
    elif kind == 5:
        other = chance.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 6:
        characters = list(lines[at])
        if characters:
            where = chance.randrange(len(characters))
            characters[where : where + chance.randrange(2)] = chance.choice(" :{}[],&*#?|-<>=!%@`'\"aeiou\t\n01")
        lines[at] = "".join(characters)
    else:
        key, colon, _ = lines[at].partition(":")
        lines[at] = f"{key}{colon or ':'} {chance.choice(_VALUES)}"
    return "\n".join(lines) + "\n"


def write_mutants(folder: Path, number: int, seed: int, configs: Path) -> None:
    """Write mutants of the cells in ``configs``, for another version to try."""
    folder.mkdir()
    for k, content in zip(range(number), mutants(seed, configs), strict=False):
        (folder / f"{k:05d}.yaml").write_bytes(content)


def try_mutants(number: int, seed: int) -> Iterator[Tried]:
    """Plan ``number`` mutants, one after another."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        # A mutant may extend a shipped cell, where the section that it spoils stands.
        files = {str(path), *(str(shipped) for shipped in CONFIGS.glob("*.yaml"))}
        for _, content in zip(range(number), mutants(seed), strict=False):
            path.write_bytes(content)
            started_s = time.process_time()
            try:
                plan_cell(path)
                verdict = "valid"
            except ConfigError as error:
                verdict = "refused" if error.file in files else f"refused without its file: {error}"
            except Exception as error:
                verdict = f"{type(error).__name__}: {error}"
            yield Tried(content, verdict, time.process_time() - started_s)


def run(arguments: Sequence[str], out: Path) -> None:
    """Try many, print the counts and the slowest, and keep what was not answered rightly."""
    number, seed = (int(arguments[0]) if arguments else 10_000), (int(arguments[1]) if len(arguments) > 1 else 0)
    counts: Counter[str] = Counter()
    slowest_s = 0.0
    for k, tried in enumerate(try_mutants(number, seed)):
        counts[tried.verdict.partition(":")[0] if tried.verdict not in ("valid", "refused") else tried.verdict] += 1
        slowest_s = max(slowest_s, tried.time_s)
        if tried.verdict not in ("valid", "refused") or tried.time_s > 1.0:
            (out / f"cell_{seed}_{k}.yaml").write_bytes(tried.content)
            print(f"{k}: {tried.time_s:.2f} s: {tried.verdict[:200]}")
    print(f"{number} cells, seed {seed}: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common()))
    print(f"slowest {slowest_s:.3f} s of CPU")
