"""Trajectories and figures of this checkout beside those of an earlier one, in one alternating run.

    python -m benchmarks against CHECKOUT [--rounds N] [--bench NAME ...] [--cell NAME ...] [--experiment NAME ...]

Every simulated cell that both checkouts ship runs once in each; arms whose measured tool positions are equal bit for
bit are named so, others with their largest distance. Every benchmark then runs in turns in a process of either
checkout, with its own environment (``.venv``); of each figure the median of the rounds counts. The experiments of both
run in their least form (``--quick``), and the means of equally named rows and measures stand side by side.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np

from touchcell.api.recordings import read_run
from touchcell.cell.bench.provenance import provenance
from touchcell.geometry.types import Array
from touchcell.paths import CHECKOUT

CELLS = (
    "surface_follow_sim",
    "surface_follow_dome_sim",
    "object_track_sim",
    "object_track_panda_sim",
    "single_push_sim",
    "dual_push_sim",
    "dual_push_tall_sim",
)
BENCHES: Mapping[str, tuple[str, ...]] = {
    "cost": ("ready_cpu_s", "memory_mb"),
    "cycle": ("median_us", "p99_us"),
    "kinematics": ("times_us",),
    "se3": ("touchcell, compiled.scalar_us", "touchcell, plain.scalar_us"),
    "sensors": ("estimates_per_s", "new_age_ms.median"),
    "simulation": (".cpu_s",),
}
"""Of each benchmark, what the names of the figures to compare contain."""

EXPERIMENTS = (
    "surface_following",
    "object_tracking",
    "single_arm_pushing",
    "dual_arm_pushing",
    "tall_objects",
    "robustness",
)

_LIMIT_S = 3600


@dataclass(frozen=True)
class TrajectoryDifference:
    """One arm of one cell in both checkouts.

    Attributes:
        cell: its file without ending.
        arm: its role.
        outcomes: of the earlier run and of the present one.
        identical: whether all tool positions are equal bit for bit.
        largest_mm: largest distance between tool positions at the same step; None without common steps.
        steps: numbers of tool poses in the earlier run and in the present one.
    """

    cell: str
    arm: str
    outcomes: tuple[str, str]
    identical: bool
    largest_mm: float | None
    steps: tuple[int, int]


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the tables; write ``against.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="against", description=__doc__)
    parser.add_argument("checkout", type=Path, help="the earlier one, with a .venv of its own")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--bench", nargs="*", choices=BENCHES, default=list(BENCHES))
    parser.add_argument("--cell", nargs="*", choices=CELLS, default=list(CELLS))
    parser.add_argument("--experiment", nargs="*", choices=EXPERIMENTS, default=list(EXPERIMENTS))
    options = parser.parse_args(arguments)
    checkout = options.checkout.absolute()
    trajectories = [row for cell in options.cell for row in _compare_cell(cell, checkout)]
    figures = {name: _compare_bench(name, checkout, options.rounds) for name in options.bench}
    experiments = {name: _compare_experiment(name, checkout) for name in options.experiment}
    report = {
        **provenance(),
        "checkout": checkout.name,
        "rounds": options.rounds,
        "trajectories": [asdict(row) for row in trajectories],
        "figures": figures,
        "experiments": experiments,
    }
    (out / "against.json").write_text(json.dumps(report, indent=1) + "\n")


def _touchcell(checkout: Path, *arguments: str) -> None:
    command = [str(checkout / ".venv" / "bin" / "touchcell"), *arguments]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
    if done.returncode:
        print(f"{checkout.name}: {' '.join(arguments[:2])} ended with {done.returncode}: {done.stderr.strip()[-200:]}")


def _compare_cell(cell: str, checkout: Path) -> Iterator[TrajectoryDifference]:
    with tempfile.TemporaryDirectory() as folder:
        folders = (Path(folder) / "then", Path(folder) / "now")
        for place, at in zip(folders, (checkout, CHECKOUT), strict=True):
            _touchcell(at, "run", f"configs/{cell}.yaml", "--out", str(place))
        then, now = (read_run(place) for place in folders)
        outcomes = (str(then.result.get("outcome")), str(now.result.get("outcome")))
        for topic in sorted(name for name in now if name.startswith("/arms/") and name.endswith("/tcp")):
            before, after = _positions_mm(then[topic]), _positions_mm(now[topic])
            common = min(len(before), len(after))
            largest = float(np.linalg.norm(before[:common] - after[:common], axis=1).max()) if common else None
            same = before.shape == after.shape and before.tobytes() == after.tobytes()
            row = TrajectoryDifference(cell, topic.split("/")[2], outcomes, same, largest, (len(before), len(after)))
            _print_trajectory(row)
            yield row


def _positions_mm(topic: Mapping[str, Array]) -> Array:
    return np.column_stack([topic[axis] for axis in ("x_mm", "y_mm", "z_mm")])


def _print_trajectory(row: TrajectoryDifference) -> None:
    distance = "identical" if row.identical else f"up to {row.largest_mm:.3g} mm apart"
    print(f"{row.cell:<26}{row.arm:<10}{' -> '.join(row.outcomes):<22}{row.steps[0]:>7}{row.steps[1]:>7}  {distance}")


def _compare_bench(name: str, checkout: Path, rounds: int) -> dict[str, tuple[float, float]]:
    then: list[dict[str, float]] = []
    now: list[dict[str, float]] = []
    for _ in range(rounds):
        then.append(_figures(name, checkout))
        now.append(_figures(name, CHECKOUT))
    both = {
        key: (median(figures[key] for figures in then), median(figures[key] for figures in now))
        for key in then[0]
        if all(key in figures for figures in (*then, *now))
    }
    _print_figures(name, both)
    return both


def _print_figures(title: str, both: Mapping[str, tuple[float, float]]) -> None:
    print(f"\n{title:<60}{'then':>12}{'now':>12}{'ratio':>8}")
    for key, (before, after) in both.items():
        print(f"{key[-60:]:<60}{before:>12.4g}{after:>12.4g}{after / before if before else np.nan:>8.2f}")


def _compare_experiment(name: str, checkout: Path) -> dict[str, tuple[float, float]]:
    then, now = (_means(name, at) for at in (checkout, CHECKOUT))
    names = {key: next((name for name in _names_now(key) if name in now), None) for key in then}
    both = {name: (then[key], now[name]) for key, name in names.items() if name is not None}
    _print_figures(name, both)
    return both


def _names_now(key: str) -> Iterator[str]:
    """Yield what a row and measure of 0.1.0 may be called now: pushes with nothing sampled are `matched` since."""
    yield key
    yield key.replace(", learned: ", ", matched: ")
    yield key.replace(", true contact: ", ", matched, true contact: ")


def _means(experiment: str, checkout: Path) -> dict[str, float]:
    """Return what a checkout's experiment measured, by row and measure."""
    with tempfile.TemporaryDirectory() as folder:
        _touchcell(checkout, "experiment", experiment, "--quick", "--jobs", "1", "--out", folder)
        found = Path(folder) / experiment / "summary.json"
        if not found.exists():
            return {}
        rows = json.loads(found.read_text())["rows"]
    return {
        f"{row}: {measure}": float(statistics["mean"])
        for row, measures in rows.items()
        for measure, statistics in measures.items()
        if isinstance(statistics, dict) and "mean" in statistics
    } | {f"{row}: done": float(measures["done"]) for row, measures in rows.items()}


def _figures(name: str, checkout: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        _touchcell(checkout, "bench", name, "--out", folder)
        found = Path(folder) / f"{name}.json"
        if not found.exists():
            return {}
        leaves = dict(_leaves(json.loads(found.read_text())))
    return {key: value for key, value in leaves.items() if any(part in key for part in BENCHES[name])}


def _leaves(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{path}.{i}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)
