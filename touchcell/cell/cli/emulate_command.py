"""``emulate``: a device, or a whole cell, on the wire."""

from __future__ import annotations

import argparse

from touchcell.cell.cli.arguments import Subparsers, add_command


def add_parser(commands: Subparsers) -> None:
    """Declare the command; the emulator named declares its own options when it is known."""
    emulate = add_command(commands, "emulate", _emulate, "emulate a device, or the devices of a cell, on the wire")
    emulate.add_argument(
        "rest", nargs=argparse.REMAINDER, metavar="NAME ...", help="which emulator, and its options; --help lists them"
    )


def _emulate(options: argparse.Namespace) -> int:
    from touchcell.testing.emulation.launcher import main

    return main(options.rest or ["--help"])
