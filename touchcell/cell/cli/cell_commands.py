"""``run``, ``jog`` and ``check``: cell files."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchcell.cell.cli.arguments import Subparsers, add_cell, add_command, add_settings, port, speed
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.config.find import find_cell


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    run = add_command(commands, "run", _run, "run a cell's task and report on it")
    add_cell(run)
    add_settings(run)
    run.add_argument("--data", type=Path, metavar="DIR", help="data set folder for drivers that replay or collect one")
    run.add_argument("--model", metavar="FILE", help="model file in place of the one that the cell names")
    run.add_argument("--out", type=Path, metavar="FOLDER", help="run folder (default: runs/NAME-TIME)")
    run.add_argument("--animate", action="store_true", help="also write animation.gif, of a simulated run")
    _add_live(run)
    run.add_argument("--ui", action="store_true", help="serve the operator's page while it runs, as `ui` does")
    run.add_argument("--quiet", action="store_true", help="show no live progress line")

    jog = add_command(commands, "jog", _jog, "move a cell's arms by hand, and save poses into its file")
    add_cell(jog)
    add_settings(jog)
    jog.add_argument(
        "--speed", type=speed, default=50.0, metavar="MM_S", help="largest speed, in mm/s (default: %(default)g)"
    )
    jog.add_argument(
        "--turn",
        type=speed,
        default=17.0,
        metavar="DEG_S",
        help="largest rate, in deg/s (default: %(default)g)",
    )
    jog.add_argument("--out", type=Path, metavar="FOLDER", help="run folder (default: runs/NAME-TIME)")
    jog.add_argument(
        "--input",
        action="append",
        default=[],
        metavar="NAME",
        help="also by gamepad or spacemouse, or by a page that `touchcell ui` serves; may be repeated",
    )
    jog.add_argument("--ui", action="store_true", help="also from the operator's page, which is served meanwhile")
    _add_live(jog)

    check = add_command(commands, "check", _check, "validate a cell file without connecting anything")
    add_cell(check)
    add_settings(check)
    check.add_argument("--data", type=Path, metavar="DIR", help="data set folder that the run will be given")
    check.add_argument(
        "--explain", action="store_true", help="print the merged file, with the file and line each value comes from"
    )


def _add_live(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--live",
        action="store_true",
        help="serve what is recorded to Foxglove on this machine while it runs: ws://127.0.0.1:PORT",
    )
    parser.add_argument(
        "--live-port",
        type=port,
        default=8765,
        metavar="PORT",
        help="of --live, 0 for any free one (default: %(default)s)",
    )


def _jog(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.jog import jog_cell
    from touchcell.cell.config.settings import parse_settings

    return jog_cell(
        find_cell(options.cell),
        world=options.world,
        settings=parse_settings(options.settings),
        speed_mm_s=options.speed,
        turn_deg_s=options.turn,
        out=options.out,
        live_port=options.live_port if options.live else None,
        inputs=options.input,
        page_port=0 if options.ui else None,
    )


def _run(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.run import run_cell
    from touchcell.cell.config.settings import parse_settings

    return run_cell(
        find_cell(options.cell),
        world=options.world,
        settings=parse_settings(options.settings),
        data=options.data,
        model=options.model,
        out=options.out,
        live=not options.quiet and sys.stdout.isatty(),
        moving=options.animate,
        live_port=options.live_port if options.live else None,
        page_port=0 if options.ui else None,
    )


def _check(options: argparse.Namespace) -> int:
    with _uncollected():
        return _check_cell(options)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Pause garbage collection, which costs a twelfth of a check: what is imported and planned stays to its end."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _check_cell(options: argparse.Namespace) -> int:
    from touchcell.cell.config.armed import proof_table
    from touchcell.cell.config.layers import explain, load_layers
    from touchcell.cell.config.perception_threads import perception_line
    from touchcell.cell.config.settings import parse_settings
    from touchcell.cell.config.yaml_file import InvalidCell
    from touchcell.cell.runtime.worlds import plan_for

    file, settings = find_cell(options.cell), parse_settings(options.settings)
    if options.explain and options.world is None:
        print(explain(load_layers(file, settings)))
    overrides = {} if options.data is None else {"data": options.data}
    plan = plan_for(file, options.world, overrides, settings=settings)
    if options.explain:
        if options.world is not None:
            print(explain(load_layers(file, settings, plan.world_settings)))
        return EXIT_OK
    if plan.foreseen:
        raise InvalidCell(plan.foreseen)
    print(f"{options.cell}: {plan.cell.name} is valid{'' if options.world is None else f' on {options.world}'}")
    for note in plan.notes:
        print(f"  {note}")
    print(f"  task     {plan.task.name}: {plan.task.summary}")
    for device in plan.built.values():
        print(f"  {device.spec.capabilities.kind:<8} {device.name}: {device.spec.name}, {device.spec.summary}")
    if perceived := perception_line(plan):
        print(f"  perceives {perceived}")
    for name, way in plan.stopping_distances.items():
        print(f"  beyond {name}: {way}")
    for line in proof_table(plan):
        print(f"  {line}")
    if plan.cell.processes == "separate":
        from touchcell.cell.runtime.process_watchdog import process_lines

        for line in process_lines(plan):
            print(f"  process  {line}")
    if plan.skipped:
        print(f"  not needed by this task and not built: {', '.join(plan.skipped)}")
    return EXIT_OK
