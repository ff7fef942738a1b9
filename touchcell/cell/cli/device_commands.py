"""``devices``, ``probe``, ``doctor`` and ``recover``: what is plugged in, whether it answers, and its faults."""

from __future__ import annotations

import argparse
import sys

from touchcell.cell.cli.arguments import Subparsers, add_cell, add_command, add_settings
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_DEVICE_LOST, EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.cli.output import warn
from touchcell.cell.config.find import find_cell


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    add_command(commands, "devices", _devices, "list cameras, serial ports and CAN interfaces, and what they need")
    probe = add_command(commands, "probe", _probe, "connect a cell's devices without energising any; print their state")
    add_cell(probe)
    add_settings(probe)
    doctor = add_command(commands, "doctor", _doctor, "name every known fault of a cell's devices, with its remedy")
    add_cell(doctor)
    add_settings(doctor)
    recover = add_command(commands, "recover", _recover, "clear the faults of a cell's devices, after asking")
    add_cell(recover)


def _devices(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.devices import print_devices

    print_devices()
    return EXIT_OK


def _recover(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.recover import recover_cell

    if not sys.stdin.isatty():
        warn("recover asks a person: run it in a terminal")
        return EXIT_BAD_INPUT
    return EXIT_OK if recover_cell(find_cell(options.cell)) else EXIT_DEVICE_LOST


def _doctor(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.doctor import diagnose_cell, print_diagnoses
    from touchcell.cell.config.settings import parse_settings

    diagnoses = diagnose_cell(find_cell(options.cell), parse_settings(options.settings), options.world)
    print_diagnoses(diagnoses)
    if not all(diagnosis.answers for diagnosis in diagnoses):
        return EXIT_DEVICE_LOST
    return EXIT_OK if all(diagnosis.is_healthy for diagnosis in diagnoses) else EXIT_TASK_FAILED


def _probe(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.devices import print_probes, probe_cell
    from touchcell.cell.config.settings import parse_settings

    probes = probe_cell(find_cell(options.cell), parse_settings(options.settings), options.world)
    print_probes(probes)
    return EXIT_DEVICE_LOST if any(probe.error for probe in probes) else EXIT_OK
