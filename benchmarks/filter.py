"""``touchcell bench filter``: accuracy, consistency and cost of the SE(3) filter.

Five parts, each with a table:

* ``sequences`` (Lloyd & Lepora 2024, 5.3): contacts with known motion, four dynamics noise levels, MAE and predicted
  sigma per component against the single frames, consistency (NEES and NIS), and corrections robust to slip. With
  ``--data`` and ``--model`` on a labelled split in its own and in shuffled orders, else on simulated contacts.
* ``steps``: one correction by Gauss-Newton, one-step EKF and naively, and one prediction to second and to fourth order,
  run time against error.
* ``cells``: recordings of shipped cells through the filters and no filter, at equal times, in each component.
* ``slips``: contacts that move and slip, through the filters: collected ones of ``--data`` and ``--model``, where these
  are sequences (``data_collection`` with ``motions: sequence``), else simulated.
* ``tracking``: the shipped cell behind a moving plate, with the static and with the moving surface model in the loop.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import filter_cells, filter_slips, filter_steps, filter_tracking
from benchmarks.filter_rivals import SlipFilter, StudentFilter
from benchmarks.filter_sequences import ContactSequence, Track, filtered, labelled, single_frames, summary, synthetic
from touchcell.cell.bench.provenance import provenance
from touchcell.geometry import se3
from touchcell.perception.networks.figures import write_predictions
from touchcell.perception.runtime.filter import PoseFilter

LEVELS = (1.0, 0.3, 0.1, 0.03)
"""Standard deviations of the dynamics noise per contact, mm and degrees equally."""

SYNTHETIC_DRIFT = 0.1
TORN_EVERY = 10
PARTS = ("sequences", "steps", "tracking", "cells", "slips")
_ORDER = ("z_mm", "alpha_deg", "beta_deg", "x_mm", "y_mm", "gamma_deg")
_CORRECTIONS = {"plain": PoseFilter, "Student-t": StudentFilter, "slip inflation": SlipFilter}


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the tables; write ``filter.json`` and the plots into ``out``.

    Raises:
        DataError, ModelError, ImageError: the data set or the model cannot be used.
    """
    options = _options(arguments)
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"provenance": provenance(), "options": {k: str(v) for k, v in vars(options).items()}}
    if "sequences" in options.only:
        result["sequences"] = _sequences(options, out)
    if "steps" in options.only:
        result["corrections"] = filter_steps.corrections(options.draws)
        result["predictions"] = filter_steps.predictions(400 * options.draws)
        result["update_us"] = filter_steps.updates()
        _print_steps(result)
        _plot_steps(result, out / "filter_steps.png")
    if "cells" in options.only:
        result["cells"] = filter_cells.compare()
        filter_cells.show(result["cells"])
    if "slips" in options.only:
        result["slips"] = _slips(options)
    if "tracking" in options.only:
        result["tracking"] = _tracking(options.seconds, options.sim_model)
        _plot_tracking(result["tracking"], out / "filter_tracking.png")
    (out / "filter.json").write_text(json.dumps(result, indent=1) + "\n")
    print(f"\nwritten: {', '.join(sorted(str(path) for path in out.glob('filter*')))}")


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("touchcell bench filter --", description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, help="data set folder; without it, simulated contacts")
    parser.add_argument("--split", default="val", help="train, val or test")
    parser.add_argument("--model", type=Path, help="model file that sees the data set's images")
    parser.add_argument("--orders", type=int, default=5, help="shuffled orders of the split, or simulated sequences")
    parser.add_argument("--contacts", type=int, default=400, help="length of a simulated sequence")
    parser.add_argument("--draws", type=int, default=1000, help="random pairs for each row of the steps")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long the plate is tracked")
    parser.add_argument("--frame-hz", type=float, default=10.0, help="frames per second of collected sequences")
    parser.add_argument("--seeds", type=int, default=2, help="estimators and sets of sequences that are simulated")
    parser.add_argument("--sim-model", type=Path, help="network for the tracking, in place of Gaussian errors")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    options = parser.parse_args(arguments)
    if (options.data is None) != (options.model is None):
        parser.error("--data and --model go together")
    return options


def _slips(options: argparse.Namespace) -> list[list[dict[str, Any]]]:
    sets = []
    if options.data is not None:
        sets = [filter_slips.collected(options.data, options.split, options.model, options.frame_hz)]
    if not any(sets):
        sets = [filter_slips.simulated(2 * options.orders, seed) for seed in range(options.seeds)]
    tables = []
    for sequences in sets:
        tables.append(filter_slips.compare(sequences))
        filter_slips.show(tables[-1])
    return tables


def _sequences(options: argparse.Namespace, out: Path) -> dict[str, Any]:
    if options.data is None:
        drift = f"surface drifts by {SYNTHETIC_DRIFT:g} per contact"
        kinds = {
            drift: [synthetic(options.contacts, seed, SYNTHETIC_DRIFT) for seed in range(options.orders)],
            f"{drift}, slips before 3 %": [
                synthetic(options.contacts, 100 + seed, SYNTHETIC_DRIFT, slip_fraction=0.03)
                for seed in range(options.orders)
            ],
            f"{drift}, 5 % of frames err sixfold": [
                synthetic(options.contacts, 200 + seed, SYNTHETIC_DRIFT, outlier_fraction=0.05)
                for seed in range(options.orders)
            ],
        }
    else:
        whole = labelled(options.data, options.split, options.model, _show_progress)
        torn = labelled(options.data, options.split, options.model, _show_progress, torn_every=TORN_EVERY)
        kinds = {
            "order of the data set": [whole],
            "shuffled": [whole.shuffled(seed) for seed in range(options.orders)],
            f"one frame in {TORN_EVERY} torn": [torn],
        }
    result: dict[str, Any] = {}
    for kind, sequences in kinds.items():
        print(f"\n{kind}: {len(sequences)} x {len(sequences[0].observed)} contacts; noise per contact in mm and deg")
        print(
            f"{'noise':>6} {'correction':<15}"
            + "".join(f"{name:>15}" for name in _ORDER)
            + f"{'NEES (95 %)':>26}{'NIS (95 %)':>24}"
        )
        rows = [_row(None, "single frame", sequences, [single_frames(sequence) for sequence in sequences])]
        for name, make in _CORRECTIONS.items():
            for level in LEVELS:
                tracks = [filtered(sequence, level, make) for sequence in sequences]
                rows.append(_row(level, name, sequences, tracks))
                if name == "plain" and kind == next(iter(kinds)):
                    _plot_predictions(sequences, tracks, out / f"filter_noise_{level:g}.png")
        if not all(sequence.in_range.all() for sequence in sequences):
            for level in LEVELS:
                tracks = [filtered(sequence, level, out_of_range_too=True) for sequence in sequences]
                rows.append(_row(level, "all frames", sequences, tracks))
        if kind == next(iter(kinds)):
            _plot_predictions(
                sequences, [single_frames(sequence) for sequence in sequences], out / "filter_single_frames.png"
            )
        result[kind] = rows
    print("(MAE / mean predicted sigma; NEES and NIS are 6 on average for a consistent filter)")
    _plot_noise(result, out / "filter_noise.png")
    _plot_consistency(result, out / "filter_consistency.png")
    return result


def _row(level: float | None, correction: str, sequences: list[ContactSequence], tracks: list[Track]) -> dict[str, Any]:
    row = {"noise": level, "correction": correction, **summary(sequences, tracks)}
    cells = "".join(f"{row['mae'][name]:8.3f} /{row['sigma'][name]:5.2f}" for name in _ORDER)
    consistency = "".join(
        f"{_bounded(row[name]):>{width}}" if row[name] else "" for name, width in (("nees", 26), ("nis", 24))
    )
    print(f"{'-' if level is None else format(level, 'g'):>6} {correction:<15}{cells}{consistency}", flush=True)
    return row


def _bounded(figures: Mapping[str, float]) -> str:
    return f"{figures['mean']:.2f} ({figures['low']:.2f}..{figures['high']:.2f})"


def _show_progress(done: int, total: int) -> None:
    if done % 100 == 0 or done == total:
        print(f"\r{done} of {total} images", end="\n" if done == total else "", file=sys.stderr, flush=True)


def _print_steps(result: Mapping[str, Any]) -> None:
    print(
        f"\n{'correction':<24}{'sigma rad':>10}{'us':>9}{'from optimum, sigmas':>22}{'NEES (6)':>10}"
        f"   NEES is +-{result['corrections'][0]['nees_bound']:.2f}"
    )
    for row in result["corrections"]:
        print(
            f"{row['method']:<24}{row['sigma_rad']:10.2f}{row['us']:9.1f}{row['from_optimum_sigmas']:22.5f}"
            f"{row['nees']:10.3f}"
        )
    print(f"\n{'prediction':<24}{'sigma rad':>10}{'us':>9}{'covariance error':>22}{'of sampling':>14}")
    for row in result["predictions"]:
        print(
            f"{'order ' + str(row['order']):<24}{row['sigma_rad']:10.2f}{row['us']:9.1f}{row['error']:22.4f}"
            f"{row['left']:14.4f}"
        )
    times = ", ".join(f"{name} surface {us:.1f}" for name, us in result["update_us"].items())
    print(f"\none whole update of a filter, us: {times}")


def _tracking(seconds: float, network: Path | None) -> list[dict[str, Any]]:
    print(f"\n{'plate':<8}{'filter':<18}{'RMS':<18}" + "".join(f"{name:>11}" for name in _ORDER))
    rows = []
    for moving in (True, False):
        for name in filter_tracking.FILTERS:
            row = filter_tracking.track(name, moving=moving, duration_s=seconds, seed=0, network=network)
            rows.append(row)
            for what, title in (("estimation", "estimate - true"), ("control", "true - reference")):
                cells = "".join(f"{row[what][component]:11.3f}" for component in _ORDER)
                ended = "" if row["outcome"] == "done" else f"  {row['outcome']}"
                print(f"{row['plate']:<8}{name:<18}{title:<18}{cells}{ended}", flush=True)
    return rows


def _plot_predictions(sequences: list[ContactSequence], tracks: list[Track], path: Path) -> None:
    write_predictions(
        path,
        truth=np.concatenate([se3.to_euler_mm_deg(se3.inverse(sequence.T_s_f)) for sequence in sequences]),
        predicted=np.concatenate([track.contact for track in tracks]),
        sigma=np.concatenate([track.sigma for track in tracks]),
    )


def _plot_noise(result: Mapping[str, list[dict[str, Any]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, _ORDER, strict=True):
        for colour, (kind, rows) in zip(("C0", "C1", "C2"), result.items(), strict=False):
            plain = [row for row in rows if row["correction"] == "plain"]
            levels = [row["noise"] for row in plain]
            axes.plot(levels, [row["mae"][name] for row in plain], "o-", color=colour, label=f"MAE, {kind}")
            axes.plot(levels, [row["sigma"][name] for row in plain], "^:", color=colour, label="predicted sigma")
            axes.axhline(rows[0]["mae"][name], color=colour, ls="--", lw=1, label="MAE of single frames")
        axes.set(xscale="log", yscale="log", title=name, xlabel="dynamics noise per contact (mm, deg)")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize=6)
    figure.suptitle("Contacts in sequence with known motion: error and predicted uncertainty against dynamics noise")
    figure.savefig(path, dpi=110)


def _plot_consistency(result: Mapping[str, list[dict[str, Any]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5 * len(result), 4.2), layout="constrained")
    for axes, (kind, rows) in zip(np.atleast_1d(figure.subplots(1, len(result))), result.items(), strict=True):
        plain = [row for row in rows if row["correction"] == "plain"]
        levels = np.array([row["noise"] for row in plain])
        for name, colour in (("nees", "C0"), ("nis", "C3")):
            means = np.array([row[name]["mean"] for row in plain])
            half = np.array([row[name]["high"] - 6.0 for row in plain])
            axes.fill_between(levels, np.maximum(6.0 - half, 0.1), 6.0 + half, color=colour, alpha=0.15)
            axes.plot(levels, means, "o-", color=colour, label=f"{name.upper()}; 95 % bounds shaded")
        axes.axhline(6.0, color="0.4", lw=1)
        axes.set(xscale="log", yscale="log", xlabel="dynamics noise per contact (mm, deg)")
        axes.set_title(kind, fontsize=9)
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    figure.savefig(path, dpi=110)


def _plot_steps(result: Mapping[str, Any], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for method in filter_steps.CORRECTIONS:
        rows = [row for row in result["corrections"] if row["method"] == method]
        # The exact iterations differ by their tolerance alone.
        errors = [max(row["from_optimum_sigmas"], 1e-6) for row in rows]
        left.plot([row["us"] for row in rows], errors, "o-", label=method)
        for row, error in zip(rows, errors, strict=True):
            if error > 1e-6:
                left.annotate(f"{row['sigma_rad']:g}", (row["us"], error), fontsize=7)
    left.set(title="correction; labels: sigma (rad)", xlabel="us", ylabel="distance from the optimum (sigmas)")
    for order in (2, 4):
        rows = [row for row in result["predictions"] if row["order"] == order]
        right.plot([row["us"] for row in rows], [row["error"] for row in rows], "o-", label=f"order {order}")
        for row in rows:
            if row["error"] > 1.05 * row["left"]:
                right.annotate(f"{row['sigma_rad']:g}", (row["us"], row["error"]), fontsize=7)
    right.axhline(max(row["left"] for row in result["predictions"]), color="0.5", ls=":", label="error of sampling")
    right.set(title="prediction; labels: sigma (rad)", xlabel="us", ylabel="relative error of the covariance")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    figure.savefig(path, dpi=110)


def _plot_tracking(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7), layout="constrained")
    names = list(filter_tracking.FILTERS)
    position = np.arange(len(names))
    for axes, component in zip(figure.subplots(2, 3).flat, _ORDER, strict=True):
        for offset, plate, colour in ((-0.2, "moving", "C1"), (0.2, "still", "C0")):
            heights = [row["estimation"][component] for row in rows if row["plate"] == plate]
            axes.bar(position + offset, heights, 0.38, color=colour, label=f"plate {plate}")
        axes.set_xticks(position, names, rotation=20, ha="right", fontsize=8)
        axes.set_title(component)
        axes.grid(axis="y", alpha=0.3)
    figure.axes[0].legend()
    figure.suptitle("RMS error of the estimate while tracking, by surface model")
    figure.savefig(path, dpi=110)
