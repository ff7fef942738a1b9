"""``bench``, ``experiment``, ``sweep``: figures of this machine, the paper's experiments, and one's own."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from touchcell.cell.cli.arguments import RUNS, Subparsers, add_cell, add_command, positive
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.cli.workers import add_workers, workers_of
from touchcell.errors import ConfigError

if TYPE_CHECKING:
    from touchcell.cell.sweeps.sweep import Sweep


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    bench = add_command(commands, "bench", _bench, "measure this machine: run time against error")
    bench.add_argument("name", metavar="NAME", help="which; `touchcell list` names them")
    bench.add_argument(
        "--out",
        type=Path,
        default=RUNS / "bench",
        metavar="DIR",
        help="for tables and plots (default: %(default)s)",
    )
    bench.add_argument("rest", nargs="*", metavar="ARGUMENT", help="of the benchmark; its options follow after --")

    experiment = add_command(commands, "experiment", _experiment, "the paper's experiments: trials, table and plots")
    experiment.add_argument("name", metavar="NAME", help="which, or `all`; `touchcell list` names them")
    experiment.add_argument(
        "--out",
        type=Path,
        default=RUNS / "experiments",
        metavar="DIR",
        help="folder with one for each (default: %(default)s)",
    )
    add_workers(experiment)
    _add_keep_stale(experiment)
    experiment.add_argument("--trials", type=positive, help="repetitions of each row (default: the experiment's own)")
    experiment.add_argument("--html", action="store_true", help="also write report.html: one file, plots interactive")
    experiment.add_argument("--quick", action="store_true", help="the least that still shows every kind of row")

    sweep = add_command(commands, "sweep", _sweep, "run a cell with many settings: tables, plots and worst cases")
    add_cell(sweep)
    values = "KEY=FIRST:LAST:COUNT, KEY=FIRST..LAST or KEY=A,B,C"
    sweep.add_argument("--grid", action="append", default=[], metavar="KEY=VALUES", help=f"{values}; repeatable")
    sweep.add_argument(
        "--sample",
        action="append",
        default=[],
        metavar="KEY=VALUES",
        help="FIRST..LAST, uniform(LOW, HIGH), loguniform(LOW, HIGH), normal(MEAN, SD) or choice(A, B); repeatable",
    )
    sweep.add_argument("--samples", type=positive, help="draws at each point of the grid (default: as many as a range)")
    sweep.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="in every trial; repeatable")
    sweep.add_argument(
        "--measure", action="append", default=[], metavar="NAME", help="number to show, with *; repeatable"
    )
    sweep.add_argument("--search", metavar="NAME", help="search the --sample ranges for the smallest NAME (Optuna)")
    sweep.add_argument("--trials", type=positive, default=50, help="trials of a search (default: %(default)s)")
    sweep.add_argument(
        "--out", type=Path, metavar="DIR", help="folder; the same command goes on in it (default: runs/sweeps/NAME)"
    )
    add_workers(sweep)
    _add_keep_stale(sweep)


def _add_keep_stale(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--keep-stale", action="store_true", help="keep finished trials of other code or packages, too")


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
    tables, complete = [], True
    for experiment in experiments:
        folder = options.out / experiment.name
        try:
            result = run_experiment(
                experiment,
                folder,
                scale,
                workers=workers_of(options),
                executor=options.executor,
                keep_stale=options.keep_stale,
                live=True,
                as_html=options.html,
            )
        except KeyboardInterrupt:
            print(f"touchcell: what has finished is kept in {folder}; the same command goes on", file=sys.stderr)
            raise
        tables.append(result.text)
        complete = complete and result.complete
        print(result.text, flush=True)
    if len(tables) > 1:
        (options.out / "summary.txt").write_text("\n\n".join(tables) + "\n")
    return EXIT_OK if complete else EXIT_TASK_FAILED


def _sweep(options: argparse.Namespace) -> int:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from dataclasses import replace

    from touchcell.cell.config.find import find_cell
    from touchcell.cell.config.settings import parse_settings
    from touchcell.cell.sweeps.factors import make_factors
    from touchcell.cell.sweeps.section import pairs, read_section
    from touchcell.cell.sweeps.sweep import Sweep, run_sweep

    cell = find_cell(options.cell)
    section = read_section(cell)
    workers = workers_of(options)
    if section.time_limit_s is not None:
        workers = replace(workers, time_limit_s=section.time_limit_s)
    grid = {**section.grid, **pairs(options.grid, "--grid")}
    sample = {**section.sample, **pairs(options.sample, "--sample")}
    folder = options.out or RUNS / "sweeps" / cell.stem
    searching = options.search is not None
    factors = make_factors({} if searching else grid, sample, options.samples or section.samples, section.seed)
    measures = tuple(options.measure) or section.measures
    sweep = Sweep(cell, factors, measures, settings=parse_settings(options.set))
    try:
        if searching:
            return _search(options, sweep, folder)
        result = run_sweep(
            sweep, folder, workers=workers, executor=options.executor, keep_stale=options.keep_stale, live=True
        )
    except KeyboardInterrupt:
        print(f"touchcell: what has finished is kept in {folder}; the same command goes on", file=sys.stderr)
        raise
    print(result.text)
    return EXIT_OK if result.complete else EXIT_TASK_FAILED


def _search(options: argparse.Namespace, sweep: Sweep, folder: Path) -> int:
    from touchcell.cell.sweeps.factors import Distribution
    from touchcell.cell.sweeps.search import search

    space = {key: draw for key, draw in sweep.factors.sampled.items() if isinstance(draw, Distribution)}
    if not space:
        raise ConfigError("there is nothing to search", key="--search", hint="--sample 'task.gain=uniform(0.5, 2)'")
    found = search(
        sweep,
        space,
        options.search,
        options.trials,
        folder,
        workers=workers_of(options),
        executor=options.executor,
        live=True,
    )
    if found.best is None:
        print(f"none of {len(found.finished)} trials ended as done: {found.finished[-1].reason}")
        return EXIT_TASK_FAILED
    changes = {key: found.best.trial.changes[key] for key in space}
    print(f"smallest {options.search} of {len(found.finished)} trials: {found.best.measures[options.search]:.4g}")
    for key, value in changes.items():
        print(f"  --set {key}={value}")
    print(f"  touchcell run {found.best.folder.path}/cell.yaml")
    return EXIT_OK
