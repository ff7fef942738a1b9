"""``completion``: a script that completes touchcell's commands and options in a shell."""

from __future__ import annotations

import argparse

from touchcell.cell.cli.arguments import Subparsers, add_command
from touchcell.cell.cli.exit_codes import EXIT_OK


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    completion = add_command(commands, "completion", _completion, "print a script that completes commands in a shell")
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"), help='eval "$(touchcell completion bash)"')


def _completion(options: argparse.Namespace) -> int:
    import shtab

    print(shtab.complete(options.parser, shell=options.shell))
    return EXIT_OK
