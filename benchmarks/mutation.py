"""Mutation score of the safety code: small changes to it, one at a time, that some test has to notice.

    python -m benchmarks mutation [--of gate,latch,...] [--most N] [--seed S] [--tests FILE,...]

Each mutant changes one operator, comparison, constant, condition or statement of a module. The tests that are about
the modules are collected once. A first pass notes which functions of the module each of them calls and how long it
takes. A mutant of a function gives the function its changed code, in a fork, and runs the tests that call it, the
quickest first, until one fails; a changed constant of a module is replaced wherever it was imported to. What else
changes when a class is made (a default, a bound of a setting) needs a process that imports the mutant in place of the
module and runs all of the tests that call anything of it.

Mutants that no test notices are listed with file, line and change. Those that ``equivalent_mutants`` names, each with a
reason, are tried like the others and do not count if they survive; the score is given with them too.
"""

from __future__ import annotations

import argparse
import ast
import copy
import functools
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, cast

import cv2  # noqa: F401  (imported here, so that the forks find it imported)
import hypothesis
import hypothesis.extra.numpy
import pytest
import yaml  # noqa: F401
from _pytest.runner import runtestprotocol

from benchmarks.equivalent_mutants import equivalent
from touchcell.cell.bench.provenance import provenance
from touchcell.paths import CHECKOUT

Change = Callable[[ast.AST], None]

_OF_INTERLOCKS = (
    "tests/control/interlocks",
    *(f"tests/control/test_{name}.py" for name in ("supervisor", "latch", "proof", "rest")),
)
_OF_THE_GATE = ("tests/drivers/core/test_gate.py", "tests/drivers/core/test_gate_refusals.py")
_OF_RUNS = tuple(
    f"tests/cell/runtime/test_{name}.py"
    for name in ("stopping_measures", "stopping", "stop_procedure", "reset_procedure", "reset")
)
MODULES: dict[str, tuple[str, tuple[str, ...]]] = {
    "gate": ("touchcell/drivers/core/gate.py", _OF_THE_GATE),
    "command_checks": ("touchcell/drivers/core/command_checks.py", _OF_THE_GATE),
    "lease": ("touchcell/drivers/core/lease.py", _OF_THE_GATE),
    "latch": ("touchcell/control/latch.py", _OF_INTERLOCKS),
    "supervisor": ("touchcell/control/supervisor.py", _OF_INTERLOCKS),
    "rest": ("touchcell/control/rest.py", _OF_INTERLOCKS),
    **{
        name: (f"touchcell/control/interlocks/{name}.py", _OF_INTERLOCKS)
        for name in (
            "always_on",
            "basic",
            "boundary",
            "clearance",
            "collision",
            "depth_disagrees",
            "external_torque",
            "force",
            "hold_to_run",
            "motion",
            "pair",
            "pressure",
            "readings",
            "tactile",
            "timers",
            "wrench",
        )
    },
    "stopping": ("touchcell/cell/runtime/stopping.py", _OF_RUNS),
    "stop_procedure": ("touchcell/cell/runtime/stop_procedure.py", _OF_RUNS),
    "reset_procedure": ("touchcell/cell/runtime/reset_procedure.py", _OF_RUNS),
}
"""Modules by name: the file, and where the tests stand that are about it."""
_WAITS_S = 600.0
"""For a test that waits for ever."""
_QUICK_S = 1.5
"""A test that takes longer is not tried on mutants."""
_OPTIONS = (
    *("-q", "-p", "no:cacheprovider", "-p", "no:randomly", "-p", "no:xdist", "-p", "no:rerunfailures", "--no-header"),
    "--tb=native",
    *("--assert=plain", "-m", "not slow and not stress and not emulated"),
)

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
    """A change to one module: where, what, and the whole tree after it."""

    line: int
    what: str
    tree: ast.Module


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
            yield Mutant(node.lineno, what, changed)


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


# Which code a mutant changes


Constants = dict[str, tuple[Any, Any]]
"""Old and new value by name."""
Place = tuple[str, int]
"""A function: its qualified name and first line."""


def _codes(code: CodeType) -> Iterator[CodeType]:
    """``code`` and all code within it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _module(file: str) -> str:
    return ".".join(Path(file).with_suffix("").parts)


def _place(code: CodeType) -> Place:
    return code.co_qualname, code.co_firstlineno


def _live(path: str) -> dict[Place, list[FunctionType]]:
    """The functions that exist now of the module at ``path``."""
    found: dict[Place, list[FunctionType]] = defaultdict(list)
    for each in gc.get_objects():
        if type(each) is FunctionType and each.__code__.co_filename == path:
            found[_place(each.__code__)].append(each)
    return found


@dataclass(slots=True)
class Patch:
    """What turns the imported module into the mutant: new code of functions, and new values of its constants."""

    functions: list[tuple[FunctionType, CodeType]] = field(default_factory=list)
    constants: Constants = field(default_factory=dict)

    def apply(self) -> None:
        """Change this process."""
        for function, code in self.functions:
            function.__code__ = code
        for name, (old, new) in self.constants.items():
            for module in list(sys.modules.values()):
                if name in getattr(module, "__dict__", {}) and vars(module)[name] is old:
                    setattr(module, name, new)


def patch_of(
    path: str, name: str, original: CodeType, mutant: Mutant, live: dict[Place, list[FunctionType]]
) -> Patch | None:
    """What to change in this process; None if the mutant differs in what only an import makes."""
    changed = compile(mutant.tree, path, "exec", dont_inherit=True)
    patch = Patch()
    pairs = list(zip(_codes(original), _codes(changed), strict=False))
    # Where code within it differs, so does what is around it, whose own instructions are the same.
    for old, new in pairs:
        if old.co_code == new.co_code and _scalars(old) == _scalars(new) and old.co_names == new.co_names:
            continue
        functions = live.get(_place(old), [])
        if old is original:
            constants = _changed_constants(path, name, changed)
            if constants is None:
                return None
            patch.constants = constants
        elif functions:
            patch.functions += [(function, new) for function in functions]
        else:
            # A function or lambda within another: the outer one gets the whole of its new code.
            outer = [
                (function, around)
                for around_old, around in pairs
                if around_old is not old and any(inner is old for inner in _codes(around_old))
                for function in live.get(_place(around_old), [])
            ]
            if not outer:
                return None
            patch.functions += outer
    return patch if patch.functions or patch.constants else None


def _scalars(code: CodeType) -> tuple[object, ...]:
    return tuple((type(each), repr(each)) for each in code.co_consts if not isinstance(each, CodeType))


def _changed_constants(path: str, name: str, changed: CodeType) -> Constants | None:
    """Constants of the module whose value differs; None if nothing but a class or a table does."""
    scratch: dict[str, Any] = {"__name__": name, "__file__": path}
    module = vars(sys.modules[name])
    plain = (int, float, str, bool, tuple)
    try:
        exec(changed, scratch)
    except Exception:
        return None
    differing = {
        key: (module[key], value)
        for key, value in scratch.items()
        if not key.startswith("__") and isinstance(value, plain) and key in module and module[key] != value
    }
    return differing or None


# Trying a mutant


@dataclass(slots=True)
class Traced:
    """Of each test: how long it takes, and the functions that it calls, by module file."""

    seconds: dict[str, float] = field(default_factory=dict)
    calls: dict[str, set[tuple[str, Place]]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)


def _passes(item: pytest.Item) -> bool:
    return all(report.passed or report.skipped for report in runtestprotocol(item, nextitem=None, log=False))


def _trace(items: Sequence[pytest.Item], files: set[str], out: Connection) -> None:
    traced = Traced()
    for item in items:
        called: set[tuple[str, Place]] = set()

        def note(frame: FrameType, event: str, _: object, called: set[tuple[str, Place]] = called) -> None:
            if event == "call" and frame.f_code.co_filename in files:
                called.add((frame.f_code.co_filename, _place(frame.f_code)))

        threading.setprofile(note)
        sys.setprofile(note)
        started_s = time.process_time()
        passed = _passes(item)
        sys.setprofile(None)
        threading.setprofile(None)
        traced.seconds[item.nodeid] = time.process_time() - started_s
        traced.calls[item.nodeid] = called
        if not passed:
            traced.failed.append(item.nodeid)
    out.send(traced)


def _in_fork(work: Callable[[], int], timeout_s: float) -> int:
    """Exit code of ``work`` in a fork, not 0 if it took too long."""
    pid = os.fork()
    if pid == 0:
        silence = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(silence, stream)
        code = 1
        try:
            # Time of the processor: other load of the machine must not look like a loop without an end.
            resource.setrlimit(resource.RLIMIT_CPU, (round(timeout_s), round(timeout_s)))
            code = work()
        finally:
            os._exit(code)
    deadline_s = time.monotonic() + _WAITS_S
    while time.monotonic() < deadline_s:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    return 1


def _run_patched(patch: Patch, items: Sequence[pytest.Item]) -> int:
    patch.apply()
    return int(not all(_passes(item) for item in items))


class _Finder(importlib.abc.MetaPathFinder):
    """Finds one module in another file."""

    def __init__(self, name: str, path: str) -> None:
        self._name = name
        self._path = path

    def find_spec(self, fullname: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(fullname, self._path) if fullname == self._name else None


def _run_imported(name: str, path: str, tests: Sequence[str]) -> None:
    """Run ``tests`` with the module at ``path`` in place of ``name``, in a process that has imported nothing of it."""
    sys.meta_path.insert(0, _Finder(name, path))
    os.chdir(CHECKOUT)
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    os._exit(int(pytest.main(["-x", *_OPTIONS, *tests], plugins=[_WithoutShrinking()])))


class _WithoutShrinking:
    """A counter-example is enough; the smallest one is not needed."""

    def pytest_collection(self) -> None:
        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        hypothesis.settings.register_profile("mutation", deadline=None, derandomize=True, database=None, phases=phases)
        hypothesis.settings.load_profile("mutation")


class _Trials(_WithoutShrinking):
    """Runs the mutants in place of the tests that were collected."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.rows: list[dict[str, object]] = []
        self.survivors: list[str] = []
        self.imported: list[tuple[str, Mutant, list[str]]] = []
        self.failed: list[str] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        names = self._options.of.split(",")
        files = {str(CHECKOUT / MODULES[name][0]) for name in names}
        items = {item.nodeid: item for item in session.items}
        for name in names:
            importlib.import_module(_module(MODULES[name][0]))
        there, here = multiprocessing.get_context("fork").Pipe()
        process = multiprocessing.get_context("fork").Process(target=_trace, args=(list(items.values()), files, here))
        process.start()
        here.close()
        traced: Traced = there.recv()
        process.join()
        self.failed = traced.failed
        for name in names if not self.failed else ():
            self._try(name, items, traced)
        return True

    def _try(self, name: str, items: dict[str, pytest.Item], traced: Traced) -> None:
        file, tests = MODULES[name]
        path, module = str(CHECKOUT / file), _module(file)
        source = Path(path).read_text()
        original, live = compile(ast.parse(source), path, "exec", dont_inherit=True), _live(path)
        quickest = sorted(
            (each for each in items if each.startswith(tests) and traced.seconds[each] <= _QUICK_S),
            key=lambda nodeid: traced.seconds[nodeid],
        )
        found = list(mutants(source))
        chosen = found
        if self._options.most and len(found) > self._options.most:
            chosen = random.Random(self._options.seed).sample(found, self._options.most)
        dead, harmless, whole = 0, 0, 0
        for mutant in chosen:
            patch = patch_of(path, module, original, mutant, live)
            if patch is None:
                whole += 1
                calling = [nodeid for nodeid in quickest if any(where == path for where, _ in traced.calls[nodeid])]
                survives = self._imported_survives(module, mutant, calling)
            else:
                places = {_place(function.__code__) for function, _ in patch.functions}
                # A constant may be used by any function of the module, or by one elsewhere.
                calling = [
                    nodeid
                    for nodeid in quickest
                    if any(
                        where == path and (place in places or bool(patch.constants))
                        for where, place in traced.calls[nodeid]
                    )
                ]
                code = _in_fork(
                    functools.partial(_run_patched, patch, [items[each] for each in calling]),
                    self._options.timeout,
                )
                survives = code == 0
            dead += not survives
            reason = equivalent(name, source, mutant.line, mutant.what) if survives else ""
            harmless += bool(reason)
            if reason:
                print(f"    {file}:{mutant.line}: {mutant.what}: equivalent: {reason}", flush=True)
            elif survives:
                self.survivors.append(f"{file}:{mutant.line}: {mutant.what}")
                print(f"    {self.survivors[-1]}", flush=True)
        self.rows.append(
            {"module": name, "mutants": len(found), "tried": len(chosen), "killed": dead, "equivalent": harmless}
        )
        print(
            f"{name:<16} {len(found):4d} mutants, {len(chosen):4d} tried, {dead:4d} killed, {harmless:3d} equivalent: "
            f"{_percent(dead, len(chosen) - harmless):5.1f} % ({whole} by import)",
            flush=True,
        )

    def _imported_survives(self, module: str, mutant: Mutant, tests: Sequence[str]) -> bool:
        files = sorted({nodeid.partition("::")[0] for nodeid in tests})
        with tempfile.TemporaryDirectory() as folder:
            replacement = Path(folder) / "mutant.py"
            replacement.write_text(ast.unparse(mutant.tree))
            process = multiprocessing.get_context("spawn").Process(
                target=_run_imported, args=(module, str(replacement), files)
            )
            process.start()
            process.join(4.0 * self._options.timeout)
            if process.exitcode is None:
                process.kill()
                process.join()
                return False
        return process.exitcode == 0


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the score of each module and the survivors; writes ``mutation.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="mutation", description=__doc__)
    parser.add_argument("--of", default=",".join(MODULES), help="modules, by comma")
    parser.add_argument(
        "--most", type=int, default=0, help="at most so many mutants of each, drawn at random; 0 for all"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds of CPU for the tests of one mutant")
    parser.add_argument("--tests", default="", help="files to take in place of all tests about the modules, by comma")
    options = parser.parse_args(arguments)
    started = time.monotonic()
    out = out.absolute()
    os.chdir(CHECKOUT)
    trials = _Trials(options)
    about = dict.fromkeys(test for name in options.of.split(",") for test in MODULES[name][1])
    tests = options.tests.split(",") if options.tests else about
    pytest.main([*_OPTIONS, "-s", *tests], plugins=[trials])
    if trials.failed:
        raise SystemExit(f"fail without any mutation: {', '.join(trials.failed)}")
    killed, total, harmless = (
        sum(cast(int, row[key]) for row in trials.rows) for key in ("killed", "tried", "equivalent")
    )
    score = _percent(killed, total - harmless)
    minutes = (time.monotonic() - started) / 60.0
    print(
        f"{killed} of {total - harmless} killed: {score:.1f} %; {_percent(killed, total):.1f} % of all {total}; "
        f"in {minutes:.1f} min"
    )
    report = {
        **provenance(),
        "rows": trials.rows,
        "survivors": trials.survivors,
        "score_percent": score,
        "score_of_all_percent": _percent(killed, total),
        "minutes": minutes,
    }
    (out / "mutation.json").write_text(json.dumps(report, indent=1) + "\n")


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / max(whole, 1)
