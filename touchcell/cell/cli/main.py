"""``touchcell``: the command line. Each command imports what it needs when it runs, so that none pays for another."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.config.find import find_cell
from touchcell.errors import TouchcellError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 task or device failed, 2 bad input, 3 an interlock tripped."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    passed_on: list[str] = []
    if words[:1] == ["bench"] and "--" in words:
        # argparse hands the dashes on to the subcommand's parser, which then claims the words behind them.
        at = words.index("--")
        words, passed_on = words[:at], words[at + 1 :]
    try:
        if words[:1] == ["emulate"]:
            from touchcell.testing.emulation.launcher import main as emulate

            return emulate(words[1:])
        options = _parser().parse_args(words)
        options.passed_on = passed_on
        code: int = options.run(options)
        return code
    except TouchcellError as error:
        print(f"touchcell: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:
        # Whoever read us, `head` perhaps, has seen enough; Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK
    except KeyboardInterrupt:
        print("touchcell: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("touchcell", description="Robot cells that feel.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run a cell's task and report on it")
    run.add_argument("cell", type=Path)
    run.add_argument("--data", type=Path, help="data set folder for drivers that replay one")
    run.add_argument("--model", help="model file in place of the one that the cell names")
    run.add_argument("--out", type=Path, help="run folder (default: runs/NAME-TIME)")
    run.add_argument("--animate", action="store_true", help="also write animation.gif, of a simulated run")
    run.add_argument("--quiet", action="store_true", help="no live progress line")
    run.set_defaults(run=_run)

    check = commands.add_parser("check", help="validate a cell file without connecting anything")
    check.add_argument("cell", type=Path)
    check.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    check.set_defaults(run=_check)

    devices = commands.add_parser("devices", help="cameras, serial ports and CAN interfaces, and what they still need")
    devices.set_defaults(run=_devices)

    probe = commands.add_parser("probe", help="connect a cell's devices without energising any; print what they tell")
    probe.add_argument("cell", type=Path)
    probe.set_defaults(run=_probe)

    listing = commands.add_parser("list", help="known drivers, tasks, interlocks, experiments, cells")
    listing.set_defaults(run=_list)

    train = commands.add_parser("train", help="train an estimator on labelled images")
    train.add_argument("--data", type=Path, required=True, help="data set folder with train/ and val/")
    train.add_argument("--out", type=Path, required=True, help="model file to write (.safetensors)")
    train.add_argument(
        "--kind",
        choices=("gdn", "cnn", "markers"),
        default="gdn",
        help="Gaussian-density network, regression or marker estimator",
    )
    train.add_argument("--epochs", type=int)
    train.add_argument("--networks", type=int, help="of a marker estimator, whose mixture it gives (default: 2)")
    train.add_argument(
        "--short-side",
        type=int,
        metavar="PX",
        help="least pixels of what a gdn or cnn sees, made by averaging whole ones (default: 100; 70 is twice as fast)",
    )
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--fresh", action="store_true", help="start again instead of resuming")
    train.set_defaults(run=_train)

    train_sim = commands.add_parser("train-sim", help="train the estimator that ships, on simulated images")
    train_sim.add_argument("--out", type=Path, required=True, help="model file to write (.safetensors)")
    train_sim.add_argument("--samples", type=int, default=12_000)
    train_sim.add_argument("--kind", choices=("gdn", "cnn", "markers"), default="gdn")
    train_sim.add_argument("--tip", help="tip file of a real sensor (calibrate-sim), or the name of one that ships")
    train_sim.add_argument("--processed", action="store_true", help="for images as the public data have them")
    train_sim.add_argument("--epochs", type=int)
    train_sim.add_argument("--seed", type=int, default=0)
    train_sim.set_defaults(run=_train_sim)

    calibrate_sim = commands.add_parser("calibrate-sim", help="make the simulated tip like a real one")
    calibrate_sim.add_argument("--data", type=Path, required=True, help="data set folder with train/, better also val/")
    calibrate_sim.add_argument("--out", type=Path, required=True, help="tip file to write (.yaml)")
    calibrate_sim.add_argument("--frames", type=int, default=20, help="labelled images to fit to")
    calibrate_sim.add_argument("--images", type=int, default=600, help="images that teach the matching, unlabelled")
    calibrate_sim.add_argument("--rings", type=int, default=10, help="of the marker lattice")
    calibrate_sim.add_argument("--seed", type=int, default=0)
    calibrate_sim.set_defaults(run=_calibrate_sim)

    calibrate = commands.add_parser("calibrate", help="zoom, turn and shift of a camera from images out of contact")
    calibrate.add_argument("--model", type=Path, required=True)
    calibrate.add_argument("--out", type=Path, required=True, help="calibration file to write (.yaml)")
    source = calibrate.add_mutually_exclusive_group(required=True)
    source.add_argument("--frames", type=Path, help="folder with PNG images of the tip out of contact")
    source.add_argument("--cell", type=Path, help="cell file whose sensor takes them now")
    calibrate.add_argument("--sensor", help="which sensor of the cell")
    calibrate.add_argument("--count", type=int, default=20, help="images that the cell's sensor takes")
    calibrate.add_argument("--reference", type=Path, help="such images of the sensor that taught the model")
    calibrate.set_defaults(run=_calibrate)

    adapt = commands.add_parser("adapt", help="bring a marker estimator to another sensor with a few labelled images")
    adapt.add_argument("--model", type=Path, required=True)
    adapt.add_argument("--data", type=Path, required=True, help="data set folder with train/ of the new sensor")
    adapt.add_argument("--frames", type=int, help="so many of its images, evenly chosen (default: all)")
    adapt.add_argument("--out", type=Path, required=True, help="model file to write (.safetensors)")
    adapt.set_defaults(run=_adapt)

    evaluate = commands.add_parser("evaluate", help="error, likelihood, calibration and latency on labelled images")
    evaluate.add_argument("--data", type=Path, required=True)
    evaluate.add_argument("--split", default="val", help="train, val or test")
    evaluate.add_argument("--model", type=Path, required=True)
    evaluate.add_argument("--calibration", type=Path, help="file of `touchcell calibrate`")
    evaluate.add_argument("--deeper-than", type=float, metavar="MM", help="leave out shallower contacts")
    evaluate.add_argument("--json", type=Path, help="also write the figures there")
    evaluate.set_defaults(run=_evaluate)

    report = commands.add_parser("report", help="make a run's summary and plots again from its recording")
    report.add_argument("folder", type=Path)
    report.add_argument("--animate", action="store_true", help="also write animation.gif")
    report.set_defaults(run=_report)

    view = commands.add_parser("view", help="show in a browser what a run's sensors feel, live or from its recording")
    view.add_argument("folder", type=Path, help="run folder")
    view.add_argument("--port", type=int, default=8177, help="of the page on this machine")
    view.set_defaults(run=_view)

    why = commands.add_parser("why", help="explain why a run tripped, from its black box")
    why.add_argument("folder", type=Path)
    why.set_defaults(run=_why)

    stop = commands.add_parser("stop", help="stop a run from another shell")
    stop.add_argument("folder", type=Path, nargs="?", help="run folder (default: every run below runs/)")
    stop.add_argument("--now", action="store_true", help="at once, without withdrawing first")
    stop.set_defaults(run=_stop)

    for word, text in (
        ("reset", "reset a run that has tripped and waits, once the cause has gone; nothing moves by it"),
        ("resume", "let a run that has been reset start its task again"),
    ):
        asking = commands.add_parser(word, help=text)
        asking.add_argument("folder", type=Path, nargs="?", help="run folder (default: the one run below runs/)")
        asking.set_defaults(run=_ask, ask=word)

    bench = commands.add_parser("bench", help="run time against error")
    bench.add_argument("name", nargs="?", help="which; `touchcell list` names them")
    bench.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder for tables and plots")
    bench.add_argument("rest", nargs="*", help="arguments of the benchmark; its options follow after --")
    bench.set_defaults(run=_bench)

    experiment = commands.add_parser("experiment", help="the paper's experiments: trials, table and plots")
    experiment.add_argument("name", help="which, or `all`; `touchcell list` names them")
    experiment.add_argument("--out", type=Path, default=Path("runs/experiments"), help="folder with one for each")
    experiment.add_argument("--jobs", type=int, help="trials at a time (default: one for each core)")
    experiment.add_argument("--trials", type=int, help="repetitions of each row (default: the experiment's own number)")
    experiment.add_argument("--quick", action="store_true", help="the least that still shows every kind of row")
    experiment.set_defaults(run=_experiment)

    commands.add_parser("emulate", help="emulate a device on the wire", add_help=False)
    return parser


def _run(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.run import run_cell

    return run_cell(
        find_cell(options.cell),
        data=options.data,
        model=options.model,
        out=options.out,
        live=not options.quiet and sys.stdout.isatty(),
        moving=options.animate,
    )


def _check(options: argparse.Namespace) -> int:
    from touchcell.cell.config.schema import plan_cell

    plan = plan_cell(find_cell(options.cell), _overrides(options.data))
    print(f"{options.cell}: {plan.cell.name} is valid")
    print(f"  task     {plan.task.name}: {plan.task.summary}")
    for device in plan.built.values():
        print(f"  {device.spec.capabilities.kind:<8} {device.name}: {device.spec.name}, {device.spec.summary}")
    for name, interlock in plan.cell.interlocks.items():
        way = plan.stopping_distances.get(name)
        print(f"  interlock {name}: {interlock.kind}" + (f"; beyond its limit, {way}" if way else ""))
    if plan.cell.processes == "separate":
        from touchcell.cell.runtime.process_watchdog import process_lines

        for line in process_lines(plan):
            print(f"  process  {line}")
    if plan.skipped:
        print(f"  not needed by this task and not built: {', '.join(plan.skipped)}")
    return EXIT_OK


def _devices(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.devices import print_devices

    print_devices()
    return EXIT_OK


def _probe(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.devices import print_probes, probe_cell

    probes = probe_cell(find_cell(options.cell))
    print_probes(probes)
    return EXIT_TASK_FAILED if any(probe.error for probe in probes) else EXIT_OK


def _list(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.list import listing

    for title, rows in listing().items():
        print(title)
        for name, summary in rows:
            print(f"  {name:<22} {summary}")
    return EXIT_OK


def _train(options: argparse.Namespace) -> int:
    from touchcell.perception.networks.training import train

    train(
        options.data,
        options.out,
        kind=options.kind,
        epochs=options.epochs,
        networks=options.networks,
        short_side_px=options.short_side,
        seed=options.seed,
        resume=not options.fresh,
    )
    return EXIT_OK


def _train_sim(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.train_sim import train_on_simulation

    train_on_simulation(
        options.out,
        samples=options.samples,
        kind=options.kind,
        tip=options.tip,
        processed=options.processed,
        epochs=options.epochs,
        seed=options.seed,
    )
    return EXIT_OK


def _calibrate_sim(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.calibrate_sim import calibrate_sim

    calibrate_sim(
        options.data,
        options.out,
        frames=options.frames,
        images=options.images,
        rings=options.rings,
        seed=options.seed,
    )
    return EXIT_OK


def _calibrate(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.calibrate import calibrate

    change = calibrate(
        options.model,
        options.out,
        frames=options.frames,
        cell=None if options.cell is None else find_cell(options.cell),
        sensor=options.sensor,
        count=options.count,
        taught=options.reference,
    )
    u, v = change.shift_px
    print(
        f"zoom {change.zoom:.4f}, turn {change.turn_deg:.2f} deg, shift {u:.2f} {v:.2f} px, {change.rms_px:.2f} px left"
    )
    print(f"{change.frames} images; wrote {options.out}")
    return EXIT_OK


def _adapt(options: argparse.Namespace) -> int:
    from touchcell.perception.calibration.adaptation import adapt

    model = adapt(options.model, options.data, options.out, frames=options.frames)
    told, camera = model.header.training, model.header.camera
    assert camera is not None
    print(f"{told['adapted_images_matched']} of {told['adapted_images']} images matched and learned from")
    print(f"camera: zoom {camera.zoom:.4f}, turn {camera.turn_deg:.1f} deg; labels' axes:", end=" ")
    print(f"{model.header.label_turn_deg:.1f} deg; wrote {options.out}")
    return EXIT_OK


def _evaluate(options: argparse.Namespace) -> int:
    from rich.progress import Progress

    from touchcell.perception.networks.evaluate import evaluate, print_table

    with Progress(transient=True, disable=not sys.stdout.isatty()) as bar:
        images = bar.add_task("images", total=None)
        result = evaluate(
            options.data,
            options.split,
            options.model,
            calibration=options.calibration,
            deeper_than_mm=options.deeper_than,
            progress=lambda done, total: bar.update(images, completed=done, total=total),
        )
    print_table(result)
    if options.json is not None:
        result.write(options.json)
    return EXIT_OK


def _report(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.report import write_report

    print(write_report(options.folder))
    if options.animate:
        from touchcell.cell.experiments.animation import animate

        print(animate(options.folder))
    return EXIT_OK


def _view(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.web_viewer import view_run

    view_run(options.folder, options.port)
    return EXIT_OK


def _why(options: argparse.Namespace) -> int:
    from touchcell.cell.analysis.trip_report import explain

    print(explain(options.folder))
    return EXIT_OK


def _stop(options: argparse.Namespace) -> int:
    from touchcell.cell.runtime.operator_input import NoSuchRun, ask_to_stop, await_end, running

    folders = [options.folder] if options.folder else running(Path("runs"))
    if not folders:
        raise NoSuchRun(Path("runs"), "no run goes on here")
    for folder in folders:
        ask_to_stop(folder, at_once=options.now)
    ended = {folder: await_end(folder) for folder in folders}
    for folder, done in ended.items():
        print(f"{folder}: {'stopped' if done else 'asked, and still going on'}")
    return EXIT_OK if all(ended.values()) else EXIT_TASK_FAILED


def _ask(options: argparse.Namespace) -> int:
    import getpass

    from touchcell.cell.runtime.operator_channel import OperatorRequest, ask_run, is_waiting
    from touchcell.cell.runtime.operator_input import NoSuchRun, running

    folders = [options.folder] if options.folder else [run for run in running(Path("runs")) if is_waiting(run)]
    if len(folders) != 1 or not is_waiting(folders[0]):
        where = folders[0] if len(folders) == 1 else Path("runs")
        raise NoSuchRun(where, "several runs wait: name one" if len(folders) > 1 else "no run waits for a reset here")
    done, words = ask_run(folders[0], OperatorRequest(options.ask), getpass.getuser())
    print(f"{folders[0]}: {words}")
    return EXIT_OK if done else EXIT_TASK_FAILED


def _bench(options: argparse.Namespace) -> int:
    from touchcell.cell.bench.catalog import benchmark

    run = benchmark(options.name)
    options.out.mkdir(parents=True, exist_ok=True)
    run([*options.rest, *options.passed_on], options.out)
    return EXIT_OK


def _experiment(options: argparse.Namespace) -> int:
    # Each trial has a core; libraries that start a thread for every core would only be in each other's way.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from touchcell.cell.experiments.runner import EXPERIMENTS, Scale, run_experiment

    names = EXPERIMENTS.names() if options.name == "all" else (options.name,)
    experiments = [EXPERIMENTS.load(name) for name in names]
    scale = Scale(options.trials, options.quick)
    jobs = options.jobs or os.cpu_count() or 1
    tables = []
    for experiment in experiments:
        folder = options.out / experiment.name
        try:
            tables.append(run_experiment(experiment, folder, scale, jobs=jobs, live=sys.stdout.isatty()))
        except KeyboardInterrupt:
            print(f"touchcell: what has finished is kept in {folder}; the same command goes on", file=sys.stderr)
            raise
        print(tables[-1], flush=True)
    if len(tables) > 1:
        (options.out / "summary.txt").write_text("\n\n".join(tables) + "\n")
    return EXIT_OK


def _overrides(data: Path | None) -> dict[str, Path]:
    return {} if data is None else {"data": data}
