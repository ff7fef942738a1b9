"""``why``, ``report``, ``open``, ``ui``, ``compare``: ended runs; ``stop``, ``reset``, ``resume``: others."""

from __future__ import annotations

import argparse
from pathlib import Path

from touchcell.cell.cli.arguments import RUNS, Subparsers, add_command, add_run_folder, port
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED
from touchcell.errors import ConfigError


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    why = add_command(commands, "why", _why, "explain why a run tripped or failed")
    add_run_folder(why)

    report = add_command(commands, "report", _report, "make a run's summary and plots again from its recording")
    add_run_folder(report)
    report.add_argument("--latest", action="store_true", help="the newest run below runs/, as without a folder")
    report.add_argument("--html", action="store_true", help="also write report.html: one file, its plots interactive")
    report.add_argument("--animate", action="store_true", help="also write animation.gif")

    felt = add_command(commands, "felt", _felt, "write the shape that a run has felt as a point cloud (PLY)")
    add_run_folder(felt)
    felt.add_argument("--out", type=Path, metavar="FILE", help="PLY file to write (default: felt.ply in the folder)")
    felt.add_argument("--sensor", default="sensor", metavar="ROLE", help="role of the sensor (default: %(default)s)")

    opened = add_command(commands, "open", _open, "open a run in Foxglove or Rerun, arranged for its cell")
    add_run_folder(opened)
    viewer = opened.add_mutually_exclusive_group()
    viewer.add_argument("--foxglove", action="store_true", help="in Foxglove or Lichtblick, with a layout (default)")
    viewer.add_argument("--rerun", action="store_true", help="in Rerun, with a blueprint")
    opened.add_argument("--to", type=Path, metavar="FILE", help="with --rerun: write this .rrd file instead")

    page = add_command(commands, "ui", _ui, "serve the operator's page: runs, live and recorded, stop, reset, resume")
    page.add_argument(
        "folder", type=Path, nargs="?", default=RUNS, metavar="FOLDER", help="of one run, or of all (default: runs/)"
    )
    page.add_argument(
        "--port", type=port, default=8177, help="of the page on this machine, 0 for any free one (default: %(default)s)"
    )

    compare = add_command(
        commands, "compare", _compare, "compare two recordings bit for bit, and name where they first differ"
    )
    for name in ("first", "second"):
        compare.add_argument(name, type=Path, metavar="RUN", help="run folder, or its recording")

    stop = add_command(commands, "stop", _stop, "stop a run from another shell")
    add_run_folder(stop, "every run in progress below runs/")
    stop.add_argument("--now", action="store_true", help="at once, without withdrawing first")

    for word, text in (
        ("reset", "reset a run that has tripped and waits, once the cause has gone; nothing moves by it"),
        ("resume", "let a run that has been reset start its task again"),
    ):
        asking = add_command(commands, word, _ask, text)
        add_run_folder(asking, "the one run below runs/ that waits")
        asking.set_defaults(ask=word)


def latest_run(runs: Path = RUNS) -> Path:
    """The run folder whose recording is newest.

    Raises:
        ConfigError: there is none.
    """
    from touchcell.cell.recording.mcap import RECORDING

    recordings = sorted(runs.glob(f"*/{RECORDING}"), key=lambda file: (file.stat().st_mtime_ns, file))
    if not recordings:
        raise ConfigError(f"there is no run below {runs}/", key="FOLDER", hint="name the folder of a run")
    return recordings[-1].parent


def _folder(options: argparse.Namespace) -> Path:
    if options.folder is not None:
        return Path(options.folder)
    folder = latest_run()
    print(f"{folder}:")
    return folder


def _report(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.report import write_report

    if options.latest and options.folder is not None:
        raise ConfigError("names another run", key="--latest", hint="name a folder or give --latest, not both")
    folder = _folder(options)
    print(write_report(folder))
    if options.html:
        from touchcell.cell.analysis.html_report import write_html

        print(write_html(folder))
    if options.animate:
        from touchcell.cell.experiments.animation import animate

        print(animate(folder))
    return EXIT_OK


def _open(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.open_command import open_in_foxglove, open_in_rerun

    folder = _folder(options)
    if options.to is not None and not options.rerun:
        raise ConfigError("is for Rerun only", key="--to", value=str(options.to), hint="add --rerun")
    if options.rerun:
        open_in_rerun(folder, options.to)
    else:
        open_in_foxglove(folder)
    return EXIT_OK


def _compare(options: argparse.Namespace) -> int:
    from touchcell.cell.recording.compare import compare_recordings
    from touchcell.cell.recording.mcap import RECORDING

    first, second = (path / RECORDING if path.is_dir() else path for path in (options.first, options.second))
    topics = compare_recordings(first, second)
    different = [topic for topic in topics if not topic.identical]
    for topic in different:
        print(f"{topic.topic}: {topic.difference}")
    messages = sum(topic.counts[0] for topic in topics)
    if different:
        print(f"{len(different)} of {len(topics)} topics differ")
        return EXIT_TASK_FAILED
    print(f"identical bit for bit: {messages} messages of {len(topics)} topics, durations on this machine aside")
    return EXIT_OK


def _felt(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.felt_cloud import felt_cloud, write_ply
    from touchcell.cell.analysis.run_folder import RunFolder

    folder = _folder(options)
    run = RunFolder(folder)
    cloud = felt_cloud(run, options.sensor)
    path = options.out or folder / "felt.ply"
    write_ply(cloud, path)
    print(f"{path}: {len(cloud.points)} points with normals and standard deviations")
    if run.plan.cell.scene is not None:
        from touchcell.cell.experiments.scenes import distance_to_scene_mm

        off = distance_to_scene_mm(run, cloud.points)
        rms_mm, worst_mm = float((off**2).mean() ** 0.5), float(abs(off).max())
        print(f"off the scene's surface: RMS {rms_mm:.3f} mm, at most {worst_mm:.3f} mm")
    return EXIT_OK


def _ui(options: argparse.Namespace) -> int:
    from touchcell.cell.ui.server import serve_page

    folder: Path = options.folder
    is_run = (folder / "cell.yaml").is_file()
    if not is_run and folder != RUNS and not folder.is_dir():
        raise ConfigError("there is no such folder", file=str(folder), hint="name a run, or leave it out")

    def ready(address: str) -> None:
        print(f"{address}\nis the operator's page, for browsers on this machine; Ctrl-C ends it", flush=True)

    root, name = (folder.absolute().parent, folder.absolute().name) if is_run else (folder, None)
    serve_page(root, options.port, ready, run=name)
    return EXIT_OK


def _why(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.trip_report import explain

    print(explain(_folder(options)))
    return EXIT_OK


def _stop(options: argparse.Namespace) -> int:
    from touchcell.cell.runtime.operator_input import NoSuchRun, ask_to_stop, await_end, running

    folders = [options.folder] if options.folder else running(RUNS)
    if not folders:
        raise NoSuchRun(RUNS, "no run is in progress here")
    for folder in folders:
        ask_to_stop(folder, at_once=options.now)
    ended = {folder: await_end(folder) for folder in folders}
    for folder, done in ended.items():
        print(f"{folder}: {'stopped' if done else 'asked, and still in progress'}")
    return EXIT_OK if all(ended.values()) else EXIT_TASK_FAILED


def _ask(options: argparse.Namespace) -> int:
    from touchcell.cell.runtime.operator_channel import OperatorRequest, ask_run, is_waiting, operator_name
    from touchcell.cell.runtime.operator_input import NoSuchRun, running

    folders = [options.folder] if options.folder else [run for run in running(RUNS) if is_waiting(run)]
    if len(folders) != 1 or not is_waiting(folders[0]):
        where = folders[0] if len(folders) == 1 else RUNS
        raise NoSuchRun(where, "several runs wait: name one" if len(folders) > 1 else "no run waits for a reset here")
    done, answer = ask_run(folders[0], OperatorRequest(options.ask), operator_name())
    print(f"{folders[0]}: {answer}")
    return EXIT_OK if done else EXIT_TASK_FAILED
