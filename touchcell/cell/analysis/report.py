"""A run's summary and plots, made from its recording alone, so that they can be regenerated at any time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell import compiled
from touchcell.cell.analysis.limits import close_calls
from touchcell.cell.analysis.run_data import STAGES, Run, Series
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.runtime.operator_input import is_running
from touchcell.cell.runtime.result_record import KILLED, RESULT
from touchcell.cell.scene.description import SceneDescription, describe_scene
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry.types import Array


def write_report(folder: Path) -> str:
    """Write ``summary.json``, ``summary.txt`` and the plots into a run folder; return the text.

    Raises:
        RecordingError: the folder holds no recording.
    """
    source = RunFolder(folder)
    run = source.recording
    result = source.result
    plan = _plan(source)
    calls = {} if plan is None else {"close_calls": close_calls(run, plan)}
    truth = {"truth": dict(plan.truth)} if plan is not None and plan.truth else {}
    summary = {**_push_errors(source), **calls, **truth, **summarise(run)}
    (folder / "summary.json").write_text(json.dumps({**result, **summary}, indent=1) + "\n")
    text = "\n".join((*_headline(source, plan), *_text(folder, result, summary, _pictures(source), run)))
    (folder / "summary.txt").write_text(text + "\n")
    return text


def _push_errors(source: RunFolder) -> Mapping[str, float]:
    from touchcell.cell.analysis.push_errors import push_errors

    return push_errors(source) if _plan(source) is not None else {}


def _plan(source: RunFolder) -> CellPlan | None:
    """Return the cell of a run; None for a recording without a cell file that can be read."""
    try:
        return source.plan
    except (ConfigError, OSError):
        return None


def _pictures(source: RunFolder) -> list[Path]:
    from touchcell.cell.analysis.contact_images import write_strip
    from touchcell.cell.analysis.plots import plot_agreement, plot_budget, plot_contact, plot_trajectory

    run, folder = source.recording, source.path
    moved = bool(run.roles("arms", "command"))
    pictures = []
    for sensor in run.roles("sensors", "contact"):
        pictures.append(plot_contact(run, sensor, folder / f"contact_{sensor}.png", last_s=None if moved else 2.0))
        if not moved and run.series(f"/sensors/{sensor}/truth") is not None:
            pictures.append(plot_agreement(run, sensor, folder / f"agreement_{sensor}.png"))
    if moved:
        pictures.append(plot_trajectory(run, folder / "trajectory.png", _mounts(source), _scene(source)))
    for sensor in run.roles("sensors", "preprocessing"):
        strip = write_strip(folder / RECORDING, run, sensor, folder / f"markers_{sensor}.png")
        pictures += [strip] if strip is not None else []
    if stages_ms := _stages_ms(run):
        title = "duration of each stage of a control cycle, in the cycles in which it ran"
        plan = _plan(source)
        budget_ms = None if plan is None else 1e3 / plan.cell.rate_hz
        pictures.append(plot_budget(stages_ms, folder / "budget.png", title, budget_ms))
    return pictures


def _scene(source: RunFolder) -> SceneDescription | None:
    """Return what the cell of a run looks like; None where that cannot be read."""
    plan = _plan(source)
    try:
        return None if plan is None else describe_scene(plan)
    except TouchcellError:
        return None


def _mounts(source: RunFolder) -> dict[str, tuple[Array, Array]]:
    """Return the poses of each arm's base in the world and of its sensor in its tool, where the cell file has them."""
    plan = _plan(source)
    if plan is None:
        return {}
    sits = {section.mounted_on: section.T_tcp_sensor for section in plan.cell.sensors.values()}
    role_of = {name: role for role, name in plan.arm_roles.items()}
    # In the order of the cell file, by which arms have their colours in every picture.
    return {
        role_of[name]: (arm.T_world_base, sits.get(name, np.eye(4)))
        for name, arm in plan.cell.arms.items()
        if name in role_of
    }


def _stages_ms(run: Run) -> dict[str, Array]:
    """Return durations of each stage in the cycles in which it ran, in the order of execution."""
    timing = run.series("/timing")
    if timing is None:
        return {}
    columns = {stage: timing.column(f"{stage}_us") for stage in STAGES}
    ran = {stage: us[np.isfinite(us)] for stage, us in columns.items()}
    return {stage.replace("_", " "): 1e-3 * us for stage, us in ran.items() if len(us)}


def summarise(run: Run) -> dict[str, Any]:
    """Return the errors of a run in millimetres and degrees.

    ``control`` is the true contact against the reference (the arm's performance), ``estimation`` the estimate against
    the truth, ``single_frame`` each frame's own measurement against the truth; all during the task's ``run`` state, or
    the whole recording where the task has none.
    """
    return {
        "errors": {
            sensor: errors for sensor in run.roles("sensors", "contact") if (errors := _sensor_errors(run, sensor))
        },
        "health": {
            topic.removeprefix(_HEALTH): _health(series)
            for topic, series in sorted(run.topics.items())
            if topic.startswith(_HEALTH)
        },
    }


def _health(series: Series) -> dict[str, dict[str, float]]:
    """Return first, least, greatest and last value of each number that a device reported about itself."""
    names = dict.fromkeys(name for row in series.rows for name, value in row.items() if not isinstance(value, str))
    found = {}
    for name in names:
        values = series.column(name)
        values = values[np.isfinite(values)]
        if name != "seq" and len(values):
            ends = {"first": values[0], "least": values.min(), "greatest": values.max(), "last": values[-1]}
            found[name] = {key: float(value) for key, value in ends.items()}
    return found


def _sensor_errors(run: Run, sensor: str) -> dict[str, dict[str, dict[str, float]]]:
    contact = run.series(f"/sensors/{sensor}/contact")
    truth = run.series(f"/sensors/{sensor}/truth")
    measured = run.series(f"/sensors/{sensor}/measurement")
    assert contact is not None
    found: dict[str, dict[str, dict[str, float]]] = {}
    running = run.during(contact.t_s, "run")
    inside = running if running.any() else np.ones(len(contact.t_s), dtype=bool)
    if truth is not None:
        if (error := _difference(contact, inside, truth)) is not None:
            found["estimation"] = error
        if measured is not None:
            selected = run.during(measured.t_s, "run") if running.any() else np.ones(len(measured.t_s), dtype=bool)
            if (error := _difference(measured, selected, truth)) is not None:
                found["single_frame"] = error
    achieved = truth if truth is not None else contact
    if (error := _reference_error(run, sensor, achieved)) is not None:
        found["control"] = error
    return found


def _difference(series: Series, selected: NDArray[np.bool_], truth: Series) -> dict[str, dict[str, float]] | None:
    """Return the error of ``series`` against the truth of its time, RMS and mean absolute, per component."""
    poses, true = series.poses(), truth.poses()
    index = np.clip(np.searchsorted(truth.t_s, series.t_s + 1e-6, side="right") - 1, 0, len(truth.t_s) - 1)
    error = (poses - true[index])[selected]
    error = error[np.isfinite(error).all(axis=1)]
    return _statistics(error) if len(error) else None


def _reference_error(run: Run, sensor: str, achieved: Series) -> dict[str, dict[str, float]] | None:
    """Return the achieved contact against the reference that the task recorded, for the components that it controls."""
    task = run.series("/task")
    if task is None:
        return None
    index = np.clip(np.searchsorted(task.t_s, achieved.t_s, side="right") - 1, 0, len(task.t_s) - 1)
    running = run.during(achieved.t_s, "run")
    poses = achieved.poses()
    errors = {}
    for i, name in enumerate(COMPONENTS):
        # A task with several sensors prefixes the sensor's role.
        own = task.column(f"{sensor}_reference_{name}")
        reference = (own if np.isfinite(own).any() else task.column(f"reference_{name}"))[index]
        error = (poses[:, i] - reference)[running]
        error = error[np.isfinite(error)]
        if len(error):
            errors[name] = error
    if not errors:
        return None
    return {
        "rms": {name: float(np.sqrt(np.mean(error**2))) for name, error in errors.items()},
        "mae": {name: float(np.mean(np.abs(error))) for name, error in errors.items()},
    }


def _statistics(error: Array) -> dict[str, dict[str, float]]:
    return {
        "rms": dict(zip(COMPONENTS, np.sqrt(np.mean(error**2, axis=0)).tolist(), strict=True)),
        "mae": dict(zip(COMPONENTS, np.mean(np.abs(error), axis=0).tolist(), strict=True)),
    }


def _headline(source: RunFolder, plan: CellPlan | None) -> list[str]:
    """Return how the run ended, and how much of it is recorded where that is not all."""
    result, run = source.result, source.recording
    recorded_s = max((float(series.t_s[-1]) for series in run.topics.values()), default=0.0)
    if {"cell", "task", "outcome", "duration_s"} <= result.keys():
        lines = [f"{result['cell']}: {result['task']} {result['outcome']} after {float(result['duration_s']):.2f} s"]
        if result.get("reason"):
            lines.append(f"  {result['reason']}")
    else:
        name = source.path.resolve().name if plan is None else f"{plan.cell.name}: {plan.task.name}"
        lines = [f"{name} has no result after {recorded_s:.2f} s: " + _without_result(source.path)]
    if run.damage:
        count = len(run.damage)
        lines.append(
            f"  recorded until {recorded_s:.2f} s, damaged in {count} place{'s' if count > 1 else ''}, "
            f"first {run.damage[0]}; what follows is of what can be read"
        )
    return lines


def _without_result(folder: Path) -> str:
    if is_running(folder):
        return "it is in progress"
    if (folder / RESULT).exists():
        return f"{RESULT} is damaged"
    return KILLED


def _text(
    folder: Path, result: dict[str, Any], summary: dict[str, Any], pictures: Sequence[Path], run: Run
) -> list[str]:
    lines = [f"  {_ENDED[name].format(summary[name])}" for name in _ENDED if name in summary]
    lines += [f"  as far as {each}" for each in result.get("rests_on", ())]
    lines += [f"  {line}" for line in summary.get("close_calls", ())]
    for sensor, kinds in summary["errors"].items():
        lines.append(f"{sensor}, error RMS    " + "".join(f"{name:>11}" for name in COMPONENTS))
        for kind, statistics in kinds.items():
            cells = "".join(
                f"{statistics['rms'][name]:11.3f}" if name in statistics["rms"] else f"{'-':>11}" for name in COMPONENTS
            )
            lines.append(f"  {_KINDS[kind]:<19}{cells}")
    for device, readings in summary["health"].items():
        changed = {name: each for name, each in readings.items() if each["least"] != each["greatest"]}
        if changed:
            lines.append(f"health of {device:<20}" + "".join(f"{name:>12}" for name in _HEALTH_COLUMNS))
            lines += [
                f"  {name:<28}" + "".join(f"{each[key]:12.5g}" for key in _HEALTH_COLUMNS)
                for name, each in changed.items()
            ]
    if stages := result.get("stages_us"):
        lines.append("time per cycle      " + f"{'median us':>11}{'p99 us':>11}{'times':>9}")
        lines += [
            f"  {stage:<18}{row['median']:11.1f}{row['p99']:11.1f}{row['count']:9d}" for stage, row in stages.items()
        ]
    lines += compiled.missing()
    lines.append(f"run folder: {folder}")
    lines += [f"  {picture.name}" for picture in pictures]
    return lines


_HEALTH = "/health/"
_HEALTH_COLUMNS = ("first", "least", "greatest", "last")
_ENDED = {
    "object_error_mm": "object {:.1f} mm from the target",
    "object_heading_error_deg": "object heading {:+.1f} deg off",
    "target_error_mm": "contact normal {:.1f} mm from the target",
}
_KINDS = {
    "control": "true - reference",
    "estimation": "estimate - true",
    "single_frame": "one frame - true",
}
