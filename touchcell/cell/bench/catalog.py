"""Catalogue of benchmarks: those that are installed, and in a checkout also those for developers."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

from touchcell.errors import ConfigError, suggest
from touchcell.paths import CHECKOUT
from touchcell.registry import Registry


@runtime_checkable
class Benchmark(Protocol):
    """A benchmark's entry point."""

    def __call__(self, arguments: Sequence[str], out: Path, /) -> None:
        """Measure, print a table, and write it with its figures into the folder ``out``."""
        ...


BENCHMARKS: Final = Registry("touchcell.benchmarks", "benchmark", Benchmark)
"""All installed benchmarks."""


def benchmark_names() -> list[str]:
    """Return the names of all benchmarks; nothing is imported but the list of the checkout's own."""
    return sorted({*BENCHMARKS.names(), *_of_checkout()})


def benchmark(name: str) -> Benchmark:
    """Return the benchmark ``name``. Raises ConfigError for an unknown one."""
    of_checkout = _of_checkout()
    if name in of_checkout:
        run: Benchmark = importlib.import_module(of_checkout[name]).run
        return run
    if name not in BENCHMARKS.names():
        hint = suggest(name, benchmark_names(), otherwise="known benchmarks")
        raise ConfigError(f"unknown benchmark {name!r}", key="benchmark", value=name, hint=hint)
    return BENCHMARKS.load(name)


def _of_checkout() -> Mapping[str, str]:
    if not (CHECKOUT / "benchmarks" / "__main__.py").is_file():
        return {}
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    modules: dict[str, str] = importlib.import_module("benchmarks.__main__").BENCHMARKS
    return modules
