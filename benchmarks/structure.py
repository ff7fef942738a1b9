"""``python -m benchmarks structure``: rooms, arrows and cycles, wording, and lines to add one thing of each kind.

A room is a folder with Python files. An arrow leads from one room to another that it imports, also inside functions and
under TYPE_CHECKING. Two checkouts beside each other: ``python -m benchmarks structure . ../before``. The things added
are those of the package that the tests install beside touchcell, which no file of touchcell names. Where a
checkout has an environment (``.venv``), ``touchcell check`` is run in turns with the others, for CPU time and memory.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Final

from touchcell.cell.bench.provenance import provenance

_TURNS: Final = 5
_OLD_TOPS: Final = ("geometry", "drivers", "perception", "control", "tasks", "cell", "benchmarks")
_DIALECT: Final = re.compile(
    r"\b(told|tells?|telling|nobody|whoever|somebody|anybody|hurts?|go(?:es)? on|going on|words?|said|sa(?:ys|id) so"
    r"|is there|what there is|looks? at|who looks|gives? up|so far as|alike|lawful(?:ly)?)\b",
    re.IGNORECASE,
)
"""Words of the dialect of version 0.1.0, which a roboticist would not search for."""


@dataclass(frozen=True, slots=True)
class Tree:
    """The modules of a checkout.

    Attributes:
        files: path of each module by its dotted name.
        imports: modules that each module imports.
    """

    files: Mapping[str, Path]
    imports: Mapping[str, set[str]]


def read_tree(root: Path) -> Tree:
    """Read the package of ``root``, or the top-level packages of version 0.1.0."""
    tops = ["touchcell"] if (root / "touchcell").is_dir() else [top for top in _OLD_TOPS if (root / top).is_dir()]
    files = {}
    for top in tops:
        for path in sorted((root / top).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    imports = {name: _imports(name, path, files) for name, path in files.items()}
    return Tree(files, imports)


def _imports(name: str, path: Path, files: Mapping[str, Path]) -> set[str]:
    wanted: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            wanted += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            wanted += [f"{node.module}.{alias.name}" for alias in node.names]
    found = set()
    for each in wanted:
        while each and each not in files:
            each = each.rpartition(".")[0]
        # A package's own __init__ is passed through, not used.
        if each and each != name and (files[each].name != "__init__.py" or each in wanted):
            found.add(each)
    return found


def cycles(graph: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            component = stack[at:]
            del stack[at:]
            if len(component) > 1:
                found.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def rooms(tree: Tree) -> tuple[dict[str, int], dict[str, set[str]], int]:
    """Return the files per room, the rooms that each imports, and the number of imports between rooms."""
    # Modules at the package's root stand alone: a facade is no room.
    room = {
        name: name if path.name == "__init__.py" or (name.count(".") < 2 and name.startswith("touchcell.")) else
        name.rpartition(".")[0]
        for name, path in tree.files.items()
    }  # fmt: skip
    files: dict[str, int] = defaultdict(int)
    graph: dict[str, set[str]] = defaultdict(set)
    arrows = 0
    for name in tree.files:
        files[room[name]] += 1
        for other in tree.imports[name]:
            if room[other] != room[name]:
                graph[room[name]].add(room[other])
                arrows += 1
    return dict(files), dict(graph), arrows


def dialect(tree: Tree) -> tuple[int, int]:
    """Return the number of docstrings that match ``_DIALECT``, and of all docstrings."""
    hit = count = 0
    for path in tree.files.values():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    count += 1
                    hit += bool(_DIALECT.search(text))
    return hit, count


def additions(root: Path) -> dict[str, int]:
    """Return the lines of source of each thing in the foreign test package; empty where there is none."""
    package = root / "tests" / "packaging" / "acme"
    if not package.is_dir():
        return {}
    points = tomllib.loads((package / "pyproject.toml").read_text())["project"]["entry-points"]
    return {
        f"{group.removeprefix('touchcell.')} {name}": len(
            (package / (where.partition(":")[0].replace(".", "/") + ".py")).read_text().splitlines()
        )
        for group, names in points.items()
        for name, where in names.items()
    }


def measure(root: Path) -> dict[str, Any]:
    """Return all figures of one checkout."""
    tree = read_tree(root)
    files, graph, arrows = rooms(tree)
    hit, docstrings = dialect(tree)
    lines = sum(len(path.read_text().splitlines()) for path in tree.files.values())
    return {
        "modules": len(tree.files),
        "lines": lines,
        "rooms": len(files),
        "largest rooms": dict(sorted(files.items(), key=lambda item: -item[1])[:6]),
        "arrows between rooms": sum(len(others) for others in graph.values()),
        "imports between rooms": arrows,
        "cycles between rooms": cycles(graph),
        "cycles between modules": cycles(tree.imports),
        "lines to add one": additions(root),
        "docstrings in dialect": f"{hit} of {docstrings} ({100 * hit / max(docstrings, 1):.1f} %)",
    }


def _version(root: Path) -> str:
    return str(tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"])


def check_costs(roots: Sequence[Path]) -> dict[Path, tuple[float, float]]:
    """Return the CPU time (s) and peak memory (MB) of ``touchcell check`` in each checkout, medians of turns."""
    spent: dict[Path, list[tuple[float, float]]] = {root: [] for root in roots}
    for _ in range(_TURNS):
        for root, costs in spent.items():
            command = [str(root / ".venv" / "bin" / "touchcell"), "check", "configs/surface_follow_sim.yaml"]
            process = subprocess.Popen(command, cwd=root, stdout=subprocess.DEVNULL)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            if process.returncode:
                raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
            costs.append((usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0))
    return {
        root: (median(cpu_s for cpu_s, _ in costs), median(memory_mb for _, memory_mb in costs))
        for root, costs in spent.items()
    }


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the figures of each checkout; write ``structure.json`` into ``out``."""
    parser = argparse.ArgumentParser("structure", description=__doc__.partition("\n")[0])
    parser.add_argument("roots", nargs="*", type=Path, default=[Path(__file__).parent.parent], metavar="checkout")
    roots = [root.absolute() for root in parser.parse_args(arguments).roots]
    costs = check_costs([root for root in roots if (root / ".venv").is_dir()])
    found = {}
    for root in roots:
        figures = measure(root)
        if root in costs:
            cpu_s, memory_mb = costs[root]
            figures |= {"check, CPU time": f"{cpu_s:.2f} s", "check, memory": f"{memory_mb:.0f} MB"}
        found[f"touchcell {_version(root)}"] = figures
    for title, figures in found.items():
        print(title)
        for name, value in figures.items():
            if isinstance(value, dict):
                print(f"  {name}")
                for key, count in value.items():
                    print(f"    {key:38}{count:>6}")
                continue
            print(f"  {name:26} {len(value) if name.startswith('cycles') else value}")
            for cycle in value if name.startswith("cycles") else ():
                print(f"    {' '.join(cycle)}")
    (out / "structure.json").write_text(json.dumps({**provenance(), "figures": found}, indent=1) + "\n")
