"""Catalogue of benchmarks: those that ship, and in a checkout also those for developers."""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import EntryPoint

from touchcell import registry
from touchcell.paths import CHECKOUT

GROUP = "touchcell.benchmarks"


def benchmarks() -> dict[str, EntryPoint]:
    """Return entry points ``run(arguments, out)`` by name; only the checkout's own list is imported."""
    return {**_of_checkout(), **registry.installed(GROUP)}


def _of_checkout() -> dict[str, EntryPoint]:
    if not (CHECKOUT / "benchmarks" / "__main__.py").is_file():
        return {}
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    modules: dict[str, str] = importlib.import_module("benchmarks.__main__").BENCHMARKS
    return {name: EntryPoint(name, f"{module}:run", GROUP) for name, module in modules.items()}
