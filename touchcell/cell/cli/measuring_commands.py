"""``bench`` and ``experiment``: figures of this machine, and the paper's experiments."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from touchcell.cell.cli.arguments import RUNS, Subparsers, add_command, positive
from touchcell.cell.cli.exit_codes import EXIT_OK


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
    experiment.add_argument("--jobs", type=positive, help="trials at a time (default: one for each core)")
    experiment.add_argument(
        "--executor", default="local", metavar="NAME", help="what runs the trials (default: %(default)s)"
    )
    experiment.add_argument("--trials", type=positive, help="repetitions of each row (default: the experiment's own)")
    experiment.add_argument("--quick", action="store_true", help="the least that still shows every kind of row")


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
            live = sys.stdout.isatty()
            tables.append(run_experiment(experiment, folder, scale, jobs=jobs, executor=options.executor, live=live))
        except KeyboardInterrupt:
            print(f"touchcell: what has finished is kept in {folder}; the same command goes on", file=sys.stderr)
            raise
        print(tables[-1], flush=True)
    if len(tables) > 1:
        (options.out / "summary.txt").write_text("\n\n".join(tables) + "\n")
    return EXIT_OK
