"""``list``: what is installed."""

from __future__ import annotations

import argparse

from touchcell.cell.cli.arguments import Subparsers, add_command
from touchcell.cell.cli.exit_codes import EXIT_OK


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    add_command(commands, "list", _list, "list installed drivers, tasks, interlocks, experiments and cells that ship")


def _list(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.list import listing

    for title, rows in listing().items():
        print(title)
        for name, summary in rows:
            print(f"  {name:<22} {summary}")
    return EXIT_OK
