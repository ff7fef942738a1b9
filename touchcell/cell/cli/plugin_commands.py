"""``list``, ``describe``, ``schema``: what is installed; ``new``: a cell file or package of one's own."""

from __future__ import annotations

import argparse
from pathlib import Path

from touchcell.cell.cli.arguments import Subparsers, add_command
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.errors import ConfigError

_INDENT = " " * 6
_KINDS = ("cell", "driver", "camera", "task", "interlock", "estimator", "hil")


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    add_command(commands, "list", _list, "list installed drivers, tasks, interlocks, experiments and cells that ship")

    describe = add_command(
        commands, "describe", _describe, "explain every key of a cell file: unit, default, limits, meaning"
    )
    describe.add_argument("kind", nargs="?", metavar="KIND", help="such as section, driver, task or interlock")
    describe.add_argument("name", nargs="?", metavar="NAME", help="which of that kind; without it they are listed")

    add_command(commands, "schema", _schema, "print a JSON Schema of cell files, for editors")

    new = add_command(commands, "new", _new, "write a cell file, a package for a plug-in, or the tests of a cell")
    new.add_argument(
        "kind", choices=_KINDS, help="what to make; a driver is that of an arm, hil the tests of a cell file"
    )
    new.add_argument(
        "name",
        metavar="NAME",
        help="of the package and of the plug-in, such as my_arm; for hil the cell file, for cell the new one",
    )
    new.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder to put it in (default: this one)")
    new.add_argument(
        "--from",
        dest="source",
        metavar="CELL",
        help="for cell: the cell file to copy, or the name of one that ships, as `touchcell list` has them "
        "(default: surface_follow_sim.yaml)",
    )


def _list(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.list import listing

    for title, rows in listing().items():
        print(title)
        for name, summary in rows:
            print(f"  {name:<22} {summary}")
    return EXIT_OK


def _describe(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.catalog import KINDS, describe, names

    if options.kind is None:
        for kind in KINDS:
            print(f"{kind}: {', '.join(names(kind))}")
    elif options.name is None:
        for name in names(options.kind):
            print(f"{name:<22} {describe(options.kind, name).summary}")
    else:
        entry = describe(options.kind, options.name)
        print(f"{entry.kind} {entry.name}: {entry.summary}")
        if entry.text:
            print(f"\n{entry.text}")
        for key in entry.keys:
            facts = [key.type, key.unit, "required" if key.default is None else f"default {key.default}", key.limits]
            print(f"\n  {key.name}: {'; '.join(fact for fact in facts if fact)}")
            print(f"{_INDENT}{key.meaning}")
    return EXIT_OK


def _new(options: argparse.Namespace) -> int:
    if options.source is not None and options.kind != "cell":
        raise ConfigError("is for `new cell` only", key="--from", value=options.source)
    if options.kind == "cell":
        return _new_cell(options)
    if options.kind == "hil":
        return _new_hil(options)
    from touchcell.cell.cli.scaffold import new

    files = new(options.kind, options.name, options.out)
    for file in files:
        print(file)
    package = files[0].parent
    print(f"next: pip install -e {package}, then pytest {package}, and fill in {options.name}.py until it is green")
    return EXIT_OK


def _new_cell(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.new_cell import new_cell

    files = new_cell(options.name, options.source, options.out)
    for file in files:
        print(file)
    print(f"next: edit it, then touchcell check {files[0]}")
    return EXIT_OK


def _new_hil(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.new_hil import new_hil
    from touchcell.cell.config.find import find_cell

    module = new_hil(find_cell(Path(options.name)), options.out)
    print(module)
    print(f"next: pytest {module}; with --on emulated on emulators, with -m hil on the bench")
    return EXIT_OK


def _schema(options: argparse.Namespace) -> int:
    import json

    from touchcell.cell.config.json_schema import cell_schema

    print(json.dumps(cell_schema(), indent=1))
    return EXIT_OK
