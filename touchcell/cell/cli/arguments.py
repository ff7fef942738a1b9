"""Argument types and parsers that the commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
Run: TypeAlias = Callable[[argparse.Namespace], int]
"""What a command does; returns the exit code."""

RUNS = Path("runs")
"""Where runs leave their folders."""


def add_command(commands: Subparsers, name: str, run: Run, help_text: str) -> argparse.ArgumentParser:
    """A parser for the command ``name``, with the options that every command has."""
    description = help_text[:1].upper() + help_text[1:] + "."
    parser = commands.add_parser(name, help=help_text, description=description)
    parser.add_argument(
        "-v", "--verbose", action="count", default=argparse.SUPPRESS, help="show the log: -v progress, -vv details"
    )
    parser.set_defaults(run=run)
    return parser


def add_cell(parser: argparse.ArgumentParser) -> None:
    """The cell file as a positional argument."""
    parser.add_argument("cell", type=Path, metavar="CELL", help="cell file, or the name of one that ships")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """``--on`` and ``--set``: the world of a cell, and values in place of the file's own."""
    parser.add_argument(
        "--on",
        choices=("sim", "emulated", "bench"),
        dest="world",
        help="sim: simulated devices in place of real ones; emulated: real drivers on emulators that start by "
        "themselves; bench: nothing simulated (default: as the file is written)",
    )
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """``--set``: values in place of the cell file's own."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="KEY=VALUE",
        help="value in place of the file's own, by dotted key, such as task.depth_mm=2.5; repeatable",
    )


def add_run_folder(parser: argparse.ArgumentParser, default: str = "the newest below runs/") -> None:
    """The run folder as an optional positional argument."""
    parser.add_argument("folder", type=Path, nargs="?", metavar="FOLDER", help=f"run folder (default: {default})")


def positive(text: str) -> int:
    """A whole number of 1 or more."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of 1 or more, not {text!r}")
    return number


def whole(text: str) -> int:
    """A whole number of 0 or more."""
    return 0 if text == "0" else positive_or(text, "must be a whole number of 0 or more")


def speed(text: str) -> float:
    """A speed above 0, at most 250: what ISO 10218-1 allows beside a person."""
    return _above_zero(text, 250)


def depth(text: str) -> float:
    """A depth above 0, at most 10 mm: half of a tip's radius, beyond which its simulated skin is none."""
    return _above_zero(text, 10)


def _above_zero(text: str, most: int) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number <= most:
        raise argparse.ArgumentTypeError(f"must be above 0 and at most {most}, not {text!r}")
    return number


def positive_or(text: str, message: str) -> int:
    """A whole number of 1 or more; otherwise an error with ``message``."""
    try:
        return positive(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{message}, not {text!r}") from None


def port(text: str) -> int:
    """A TCP port that an ordinary user may open, or 0 for any that is free."""
    number = whole(text)
    if 0 < number < 1024 or number > 65535:
        raise argparse.ArgumentTypeError(f"must be 0 or from 1024 to 65535, not {text!r}")
    return number
