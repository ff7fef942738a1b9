"""``touchcell``: the command line. Each command imports what it needs when it runs, so start-up stays fast."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from touchcell.cell.cli import (
    cell_commands,
    completion_command,
    device_commands,
    emulate_command,
    learning_commands,
    measuring_commands,
    plugin_commands,
    replay_command,
    run_commands,
)
from touchcell.cell.cli.arguments import Subparsers
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_DEVICE_LOST, EXIT_INTERRUPTED, EXIT_OK, MEANING
from touchcell.cell.cli.output import flush_output, warn
from touchcell.drivers.core.errors import DeviceError
from touchcell.errors import TouchcellError, suggest
from touchcell.logs import log_to_terminal

_GROUPS: Final = (
    cell_commands,
    run_commands,
    replay_command,
    device_commands,
    plugin_commands,
    learning_commands,
    measuring_commands,
    emulate_command,
    completion_command,
)

_EXTRAS: Final = {
    "torch": "touchcell[train]",
    "mujoco": "touchcell[physics]",
    "optuna": "touchcell[search]",
    "distributed": "touchcell[dask]",
    "dask": "touchcell[dask]",
    "ray": "touchcell[ray]",
    "submitit": "touchcell[slurm]",
    "shtab": "touchcell[completion]",
}
"""Module -> what to install for it, of commands that need more than a running cell does. Drivers name their own."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see ``exit_codes``."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    passed_on: list[str] = []
    if "bench" in words[:2] and "--" in words:
        # argparse hands the dashes on to the subcommand's parser, which then claims the words behind them.
        at = words.index("--")
        words, passed_on = words[:at], words[at + 1 :]
    parser, commands = _parsers()
    command = next((word for word in words if not word.startswith("-")), None)
    if command is not None and command not in commands.choices:
        return _fail(f"unknown command {command!r} ({suggest(command, commands.choices)})", EXIT_BAD_INPUT)
    options = parser.parse_args(words)
    options.passed_on = passed_on
    options.parser = parser
    try:
        with log_to_terminal(options.verbose):
            return _run(options)
    finally:
        flush_output()


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    return _parsers()[0]


def _parsers() -> tuple[argparse.ArgumentParser, Subparsers]:
    parser = argparse.ArgumentParser(
        "touchcell",
        description="Robot cells that feel.",
        epilog="exit codes:\n" + "\n".join(f"  {code}  {meaning}" for code, meaning in MEANING.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="show the log: -v progress, -vv details")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for group in _GROUPS:
        group.add_parser(commands)
    return parser, commands


class _Version(argparse.Action):
    """Reads the version only when it is asked for: the metadata of all packages take 15 ms."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"touchcell {version('touchcell')}")
        parser.exit(EXIT_OK)


def _run(options: argparse.Namespace) -> int:
    try:
        code: int = options.run(options)
        return code
    except DeviceError as error:
        return _fail(str(error), EXIT_DEVICE_LOST)
    except TouchcellError as error:
        return _fail(str(error), EXIT_BAD_INPUT)
    except ModuleNotFoundError as error:
        if error.name not in _EXTRAS:
            raise
        remedy = f"pip install '{_EXTRAS[error.name]}'"
        return _fail(f"`{options.command}` needs {error.name}, which is not installed ({remedy})", EXIT_BAD_INPUT)
    except BrokenPipeError:
        # The reader of the output, `head` perhaps, has seen enough.
        return EXIT_OK
    except KeyboardInterrupt:
        return _fail("interrupted", EXIT_INTERRUPTED)


def _fail(message: str, code: int) -> int:
    warn(message)
    return code
