"""Start an emulator by name. Emulators register under the entry-point group ``touchcell.emulators``.

An entry is a module with ``add_arguments(parser)`` and ``build(arguments) -> Emulator``.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

from touchcell.errors import ConfigError, suggest
from touchcell.registry import Registry
from touchcell.testing.emulation.base import Emulator, read_fault_script, serve
from touchcell.testing.emulation.paced_loop import PacedLoop
from touchcell.testing.emulation.shared_joints import JointsWriter


@runtime_checkable
class EmulatorModule(Protocol):
    """Interface of an emulator's module."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the command-line arguments."""
        ...

    def build(self, arguments: argparse.Namespace) -> Emulator:
        """Build the emulator; it is not started yet."""
        ...


EMULATORS: Final = Registry("touchcell.emulators", "emulator", EmulatorModule)
"""All installed emulators."""


def main(arguments: Sequence[str]) -> int:
    """Run the emulator named first in ``arguments`` until it is stopped; return the exit code.

    Raises:
        ConfigError: there is no such emulator, its arguments are wrong, or its address cannot be used.
    """
    names = EMULATORS.names()
    parser = argparse.ArgumentParser("touchcell emulate", description="Emulate a device at its interface.")
    parsers = parser.add_subparsers(dest="name", required=True, metavar=" | ".join(names))
    wanted = arguments[0] if arguments else ""
    if wanted and not wanted.startswith("-") and wanted not in names:
        raise ConfigError(f"unknown emulator {wanted!r}", hint=suggest(wanted, names, otherwise="known emulators"))
    for name in names:
        child = parsers.add_parser(name)
        child.add_argument("--control", type=Path, help="UNIX socket of the control channel")
        child.add_argument("--fault-script", type=Path, help="YAML list of faults and when they happen")
        child.add_argument("--joints", type=int, metavar="FD", help="shared memory for the joint angles of an arm")
        child.add_argument("--lifeline", action="store_true", help="end when standard input closes")
        if name == wanted:
            EMULATORS.load(name).add_arguments(child)
    options = parser.parse_args(arguments)
    script = read_fault_script(options.fault_script) if options.fault_script else ()
    emulator = EMULATORS.load(options.name).build(options)
    if options.joints is not None:
        emulator.joints = JointsWriter(options.joints)
    try:
        with asyncio.Runner(loop_factory=PacedLoop) as runner:
            runner.run(serve(emulator, options.control, script, lifeline=options.lifeline))
    except OSError as error:
        raise ConfigError(
            f"the emulator {options.name!r} cannot open its wire: {error.strerror or error}",
            hint="an address must be one of this machine, such as 127.0.0.2, and free",
        ) from None
    return 0
