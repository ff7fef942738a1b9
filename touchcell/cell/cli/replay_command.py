"""``touchcell replay``: a run's frames and arm states through today's code, and where that answers otherwise."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from touchcell.cell.cli.arguments import Subparsers, add_command, add_run_folder, add_set
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED
from touchcell.progress import shown_progress

PLOT = "replay.png"
"""Name of the plot in the folder of a replay."""
_TWIST = 5.0
_TWIST_OF_LOSSY = 10.0


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "replay",
        _replay,
        "send a run's recorded frames and arm states through today's perception, task and interlocks, and compare",
    )
    add_run_folder(parser)
    add_set(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the replay (default: runs/NAME-replay-TIME)")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.5,
        metavar="MM",
        help="largest difference of contact poses, mm and degrees (default: %(default)s)",
    )
    parser.add_argument(
        "--tolerance-twist",
        type=float,
        metavar="MM_S",
        help=f"largest difference of twists, mm/s and deg/s (default: {_TWIST:g}; {_TWIST_OF_LOSSY:g} for images that "
        "were recorded as video or JPEG)",
    )


def _replay(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.run_commands import latest_run
    from touchcell.cell.config.settings import parse_settings
    from touchcell.cell.replaying.differences import Tolerance, differences
    from touchcell.cell.replaying.plot import plot_replay
    from touchcell.cell.replaying.replay import replay
    from touchcell.cell.runtime.run_directory import run_directory

    folder = latest_run() if options.folder is None else options.folder
    with run_directory(f"{folder.name}-replay", options.out) as out:
        with shown_progress() as show:
            done = replay(
                folder,
                out,
                settings=parse_settings(options.settings),
                on_cycle=partial(show, "cycles"),
            )
        twist = options.tolerance_twist
        if twist is None:
            twist = _TWIST_OF_LOSSY if done.recorded.lossy else _TWIST
        found = differences(done, Tolerance(options.tolerance, twist))
        plot = plot_replay(done, found, out / PLOT)
    for note in done.notes:
        print(f"note: {note}")
    for each in found:
        print(each)
    print(plot)
    return EXIT_OK if all(each.agrees for each in found) else EXIT_TASK_FAILED
