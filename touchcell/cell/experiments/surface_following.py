"""Surface following (paper 5.5): a straight line over a curved ramp, and eight paths down a dome, 45 degrees apart.

Each path runs with the learned estimator, on the true contact, which shows the error of control alone, and with the
learned estimator where truth is sampled: the tip is one fitted to a real sensor; the network was trained over a spread
of tips, or on one other tip, or was adapted to this one by a few labelled frames. Errors are of the true
contact, so an estimation error counts by its effect on the arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, during, rms, tilt_deg, true_contacts
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.shape_truth import OTHER_TIP_MODEL, REAL_TIP, REAL_TIP_MODEL, SAMPLED, sampled_truth
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial

DIRECTIONS_DEG = (0, 45, 90, 135, 180, 225, 270, 315)
SENSOR = "sensor"
ARM = "arm"
ESTIMATORS = {"learned": None, "true contact": {"kind": "true_contact"}}


def trials(scale: Scale) -> list[Trial]:
    """Return trials of ramp and dome with both estimators, and with truth sampled.

    Repetitions have other camera noise, and another truth where it is sampled.
    """
    paths: list[tuple[str, str, str, dict[str, Any], int]] = [("ramp", "ramp", "surface_follow_sim.yaml", {}, 10)] + [
        ("dome, 8 paths", f"dome_{angle}", "surface_follow_dome_sim.yaml", {"task.direction_deg": angle}, 2)
        for angle in (DIRECTIONS_DEG[::4] if scale.quick else DIRECTIONS_DEG)
    ]
    kinds: dict[str, dict[str, Any]] = {
        estimator: {} if section is None else {f"sensors.{SENSOR}.estimator": section}
        for estimator, section in ESTIMATORS.items()
    }
    truth = {"truth": sampled_truth(SENSOR, ARM, REAL_TIP)}
    kinds |= {
        f"learned, {SAMPLED}": truth,
        f"of one other tip, {SAMPLED}": truth | {f"sensors.{SENSOR}.estimator.model": f"builtin:{OTHER_TIP_MODEL}"},
        f"adapted, {SAMPLED}": truth | {f"sensors.{SENSOR}.estimator.model": f"builtin:{REAL_TIP_MODEL}"},
    }
    return [
        Trial(
            f"{name}_{kind.replace(',', '').replace(' ', '_')}_{seed}",
            f"{row}, {kind}",
            cell,
            {**changes, **more, "seed": seed},
        )
        for kind, more in kinds.items()
        for row, name, cell, changes, repetitions in paths
        for seed in range(1, scale.repetitions(repetitions) + 1)
    ]


def measure(trial: RunFolder) -> Mapping[str, float]:
    """Return RMS errors while the task ran: true contact against the reference, and estimate against true contact."""
    series, contacts = true_contacts(trial, SENSOR)
    task = trial.recording.series("/task")
    assert task is not None
    contacts = contacts[during(trial, series)]
    reference_mm = np.nanmedian(task.column("reference_z_mm"))
    estimated = trial.recording.series(f"/sensors/{SENSOR}/contact")
    assert estimated is not None
    error = (estimated.poses() - series.poses()[: len(estimated.t_s)])[during(trial, estimated)]
    return {
        "depth_rms_mm": rms(contacts[:, 2] - reference_mm),
        "depth_max_mm": float(np.nanmax(np.abs(contacts[:, 2] - reference_mm), initial=0.0)),
        "tilt_rms_deg": rms(tilt_deg(contacts)),
        "estimated_depth_rms_mm": rms(error[:, 2]),
        "estimated_tilt_rms_deg": rms(np.hypot(error[:, 3], error[:, 4])),
    }


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot the paper's figures 16 and 17 with the learned estimator, and depth and tilt over time."""
    from touchcell.cell.experiments.following_plots import plot_dome, plot_ramp

    first = [each for each in finished if each.trial.name.endswith("learned_1")]
    ramp = [each.folder for each in first if each.trial.name.startswith("ramp")]
    dome = [each.folder for each in first if each.trial.name.startswith("dome")]
    return [plot_ramp(ramp[0], folder / "ramp.png"), plot_dome(dome, folder / "dome.png")]


SPEC = ExperimentSpec(
    name="surface_following",
    summary="a ramp, and a dome along eight paths, at 3 mm depth and 20 mm/s",
    trials=trials,
    measure=measure,
    columns=(
        Column("depth_rms_mm", "depth RMS mm", digits=3),
        Column("depth_rms_mm", "worst path", "worst", 3, below=0.15),
        Column("depth_max_mm", "deepest error", "worst", 2),
        Column("tilt_rms_deg", "tilt RMS deg", digits=2),
        Column("tilt_rms_deg", "worst path", "worst", 2, below=1.0),
        Column("estimated_depth_rms_mm", "estimate: mm", digits=3),
        Column("estimated_tilt_rms_deg", "deg", digits=2),
    ),
    draw=draw,
    paper=dict.fromkeys(
        (f"{row}, {estimator}" for row in ("ramp", "dome, 8 paths") for estimator in ESTIMATORS),
        "in contact and normal (no figure)",
    ),
)
