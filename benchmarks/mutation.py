"""Mutation score of the safety code: small changes to it, one at a time, that some test has to notice.

    python -m benchmarks mutation [--of gate,latch,...] [--most N] [--seed S]

Each mutant changes one operator, comparison, constant, condition or statement of a module and is imported in place of
it by a fresh process that runs the module's own tests until the first one fails. Mutants that no test notices are
listed with file, line and change. Equivalent ones cannot be told apart and count as survivors.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.abc
import importlib.machinery
import importlib.util
import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2  # noqa: F401  (imported here, so that the forks find it imported)
import hypothesis.extra.numpy  # noqa: F401
import pytest
import yaml  # noqa: F401

from touchcell.paths import CHECKOUT

Change = Callable[[ast.AST], None]

_INTERLOCKS = ("tests/control/interlocks", "tests/control/test_supervisor.py")
MODULES: dict[str, tuple[str, tuple[str, ...]]] = {
    "gate": (
        "touchcell/drivers/core/gate.py",
        ("tests/drivers/core/test_gate_refusals.py", "tests/drivers/core/test_gate.py"),
    ),
    "command_checks": ("touchcell/drivers/core/command_checks.py", ("tests/drivers/core/test_gate_refusals.py",)),
    "lease": (
        "touchcell/drivers/core/lease.py",
        ("tests/drivers/core/test_gate_refusals.py", "tests/drivers/core/test_gate.py"),
    ),
    "latch": ("touchcell/control/latch.py", ("tests/control/test_latch.py", "tests/control/test_supervisor.py")),
    "supervisor": (
        "touchcell/control/supervisor.py",
        ("tests/control/test_supervisor.py", "tests/control/interlocks/test_timers.py"),
    ),
    "basic": ("touchcell/control/interlocks/basic.py", _INTERLOCKS),
    "boundary": ("touchcell/control/interlocks/boundary.py", _INTERLOCKS),
    "timers": ("touchcell/control/interlocks/timers.py", _INTERLOCKS),
    "tactile": ("touchcell/control/interlocks/tactile.py", _INTERLOCKS),
    "motion": ("touchcell/control/interlocks/motion.py", _INTERLOCKS),
    "pair": ("touchcell/control/interlocks/pair.py", _INTERLOCKS),
    "depth_disagrees": ("touchcell/control/interlocks/depth_disagrees.py", _INTERLOCKS),
    "pressure": ("touchcell/control/interlocks/pressure.py", _INTERLOCKS),
    "hold_to_run": ("touchcell/control/interlocks/hold_to_run.py", _INTERLOCKS),
    "stopping": (
        "touchcell/cell/runtime/stopping.py",
        ("tests/cell/runtime/test_stopping_measures.py", "tests/cell/runtime/test_stopping.py"),
    ),
    "reset_procedure": (
        "touchcell/cell/runtime/reset_procedure.py",
        ("tests/cell/runtime/test_reset_procedure.py", "tests/cell/runtime/test_reset.py"),
    ),
}
"""Modules by name: the file, and the tests that are about it."""

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
# Words for people, and the description of faults, which the tests of armed coverage are about.
_SPARED = ("faults", "__repr__", "words", "measures")


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change to one module: where, what, and the whole text after it."""

    line: int
    what: str
    text: str


def mutants(source: str) -> Iterator[Mutant]:
    """Return every mutant of a module."""
    tree = ast.parse(source)
    spared = {id(inner) for node in ast.walk(tree) for root in _roots(node) for inner in ast.walk(root)}
    for number, node in enumerate(ast.walk(tree)):
        if id(node) in spared or not hasattr(node, "lineno"):
            continue
        for what, change in _changes(node):
            changed = copy.deepcopy(tree)
            target = next(each for k, each in enumerate(ast.walk(changed)) if k == number)
            change(target)
            ast.fix_missing_locations(changed)
            yield Mutant(node.lineno, what, ast.unparse(changed))


def _roots(node: ast.AST) -> Iterator[ast.AST]:
    """Return what below ``node`` is not to be changed: annotations, words, and spared functions."""
    if isinstance(node, ast.FunctionDef):
        if node.name in _SPARED:
            yield node
        if node.returns is not None:
            yield node.returns
    if isinstance(node, ast.JoinedStr):
        yield node
    annotation = node.annotation if isinstance(node, ast.arg | ast.AnnAssign) else None
    if annotation is not None:
        yield annotation


def _changes(node: ast.AST) -> Iterator[tuple[str, Change]]:
    if isinstance(node, ast.Compare):
        for k, operator in enumerate(node.ops):
            other = _COMPARISONS.get(type(operator))
            if other is not None:
                yield f"{type(operator).__name__} -> {other.__name__}", _set_item("ops", k, other)
    elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        other_op = _OPERATORS[type(node.op)]
        yield f"{type(node.op).__name__} -> {other_op.__name__}", _set("op", other_op)
    elif isinstance(node, ast.BoolOp):
        flipped = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{type(node.op).__name__} -> {flipped.__name__}", _set("op", flipped)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "-x -> +x", _set("op", ast.UAdd)
    elif isinstance(node, ast.If):
        yield "if -> if True", _constant("test", True)
        yield "if -> if False", _constant("test", False)
    elif isinstance(node, ast.IfExp):
        yield "x if c else y -> c = True", _constant("test", True)
        yield "x if c else y -> c = False", _constant("test", False)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in (0, 1):
        doubled = 2 * cast(float, node.value)
        yield f"{0.5 * doubled:g} -> {doubled:g}", _set_value(doubled)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _CALLS:
        yield f"{node.func.id} -> {_CALLS[node.func.id]}", _rename(_CALLS[node.func.id])
    elif isinstance(node, ast.Raise):
        yield "raise -> pass", _blank
    elif isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield "statement -> pass", _blank


def _set(field: str, kind: type[ast.AST]) -> Change:
    return lambda node: setattr(node, field, kind())


def _set_item(field: str, k: int, kind: type[ast.AST]) -> Change:
    return lambda node: getattr(node, field).__setitem__(k, kind())


def _constant(field: str, value: bool) -> Change:
    return lambda node: setattr(node, field, ast.Constant(value))


def _set_value(value: float) -> Change:
    return lambda node: setattr(node, "value", value)


def _rename(name: str) -> Change:
    return lambda node: setattr(cast(ast.Call, node).func, "id", name)


def _blank(node: ast.AST) -> None:
    """Turn a statement into one that does nothing."""
    node.__class__ = ast.Pass


def survives(module: Path, mutant: Mutant, tests: Sequence[str], timeout_s: float) -> bool:
    """Return whether the tests pass with ``mutant`` in place of ``module``. One that hangs does not survive.

    The tests run in a fork of this process, which has imported what takes long and nothing of touchcell's that is
    mutated.
    """
    name = ".".join(module.with_suffix("").parts)
    with tempfile.TemporaryDirectory() as folder:
        replacement = Path(folder) / "mutant.py"
        replacement.write_text(mutant.text)
        process = multiprocessing.get_context("fork").Process(target=_test, args=(name, str(replacement), tests))
        process.start()
        process.join(timeout_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            return False
    return process.exitcode == 0


class _Finder(importlib.abc.MetaPathFinder):
    """Finds one module in another file."""

    def __init__(self, name: str, path: str) -> None:
        self._name = name
        self._path = path

    def find_spec(self, fullname: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(fullname, self._path) if fullname == self._name else None


def _test(name: str, path: str, tests: Sequence[str]) -> None:
    sys.meta_path.insert(0, _Finder(name, path))
    os.chdir(CHECKOUT)
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    options = [
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:randomly",
        "-p",
        "no:xdist",
        "--no-header",
        "--assert=plain",
    ]
    code = pytest.main([*options, "-m", "not slow and not stress and not emulated", *tests])
    os._exit(int(code))


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the score of each module and the survivors; writes ``mutation.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="mutation", description=__doc__)
    parser.add_argument("--of", default=",".join(MODULES), help="modules, by comma")
    parser.add_argument(
        "--most", type=int, default=0, help="at most so many mutants of each, drawn at random; 0 for all"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds for the tests of one mutant")
    options = parser.parse_args(arguments)
    started = time.monotonic()
    rows: list[dict[str, object]] = []
    survivors: list[str] = []
    killed = total = 0
    for name in options.of.split(","):
        file, tests = MODULES[name]
        source = (CHECKOUT / file).read_text()
        if not survives(Path(file), Mutant(0, "none", source), tests, options.timeout):
            raise SystemExit(f"{name}: its tests fail without any mutation")
        found = list(mutants(source))
        chosen = found
        if options.most and len(found) > options.most:
            chosen = random.Random(options.seed).sample(found, options.most)
        alive = [mutant for mutant in chosen if survives(Path(file), mutant, tests, options.timeout)]
        dead = len(chosen) - len(alive)
        killed, total = killed + dead, total + len(chosen)
        rows.append({"module": name, "mutants": len(found), "tried": len(chosen), "killed": dead})
        print(f"{name:<16} {len(found):4d} mutants, {len(chosen):4d} tried, {dead:4d} killed", flush=True)
        for mutant in alive:
            survivors.append(f"{file}:{mutant.line}: {mutant.what}")
            print(f"    {survivors[-1]}", flush=True)
    score = 100.0 * killed / max(total, 1)
    minutes = (time.monotonic() - started) / 60.0
    print(f"{killed} of {total} killed: {score:.1f} %, in {minutes:.1f} min")
    report = {"rows": rows, "survivors": survivors, "score_percent": score, "minutes": minutes}
    (out / "mutation.json").write_text(json.dumps(report, indent=1) + "\n")
