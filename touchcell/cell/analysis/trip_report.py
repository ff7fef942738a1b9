"""``touchcell why``: explains why a run did not end as done, with a plot around the moment."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.limits import WatchedQuantity, tripped_quantity
from touchcell.cell.analysis.run_data import Run, Series, load_run, run_of
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.yaml_file import load
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.runtime.black_box import ABOUT, CRASH, MESSAGES, RING, read_left_ring
from touchcell.cell.runtime.operator_input import is_running
from touchcell.cell.runtime.result_record import KILLED, RESULT, read_record
from touchcell.cell.runtime.watchdog import NOTES
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

BEFORE_S: Final = 1.0
"""How much of the time before the trip is shown."""
_EVENTS: Final = 5


@dataclass(frozen=True, slots=True)
class _Evidence:
    """What a run has left: a record of how it ended, as far as there is one, and its last messages."""

    about: dict[str, Any]
    run: Run
    source: str


def explain(folder: Path, *, draw: bool = True) -> str:
    """Why the run in ``folder`` did not end as done, what happened in the second before, and how the arms came to rest.

    With ``draw`` also draws ``why.png`` beside it. Evidence is taken, in this order, from the ring of a run whose
    process did not end by itself, from its black box, and from its result and recording.

    Raises:
        RecordingError: the folder holds nothing of a run.
    """
    goes_on = is_running(folder)
    evidence = None if goes_on and not (folder / ABOUT).exists() else _evidence(folder)
    if evidence is None:
        if goes_on:
            return f"{folder}: the run goes on, and nothing has stopped it"
        if (folder / NOTES).exists():
            return "\n".join([_DIED, *_watchdog_note(folder / NOTES)])
        raise RecordingError(folder, "holds nothing of a run", hint="name the folder of a run")
    about, run = evidence.about, evidence.run
    outcome = str(about.get("outcome", "ended without a result"))
    sha256 = str(about.get("cell_sha256", ""))[:12]
    lines = [f"{about.get('cell', folder.name)}: {outcome}" + (f", cell file sha256 {sha256}" if sha256 else "")]
    causes = about.get("causes") or []
    start_ns = int(about.get("start_ns", run.start_ns))
    t_ns = int(causes[0]["t_ns"]) if causes else _last_ns(run)
    if causes:
        lines.append(f"first cause, {(t_ns - start_ns) * 1e-9:.3f} s after the start:")
        lines.append(f"  {_cause(causes[0])}")
        if remedy := _remedy(folder, causes[0]):
            lines.append(f"  what to do: {remedy}")
        lines += [f"  then {1e-6 * (cause['t_ns'] - t_ns):.0f} ms later: {_cause(cause)}" for cause in causes[1:]]
    elif about.get("outcome") == "done":
        lines.append("  the task reached its end; there is nothing to explain")
    elif "outcome" in about:
        lines.append(f"  {about.get('reason') or 'no reason was given'}")
    else:
        lines.append(f"  {_DIED}")
        lines += [f"  {line}" for line in _crash(folder / CRASH)]
        lines += _watchdog_note(folder / NOTES) if (folder / NOTES).exists() else []
    end_s = (t_ns - run.start_ns) * 1e-9
    if events := _events(run, t_ns):
        lines.append("what happened:")
        lines += [f"  {line}" for line in events]
    if before := _before(run, end_s):
        lines.append(f"in the {BEFORE_S:g} s before:")
        lines += [f"  {line}" for line in before]
    if stops := about.get("stops"):
        lines.append("after:")
        lines += [f"  {role}: {_stop(stop)}" for role, stop in stops.items()]
    lines.append(f"evidence: {evidence.source}")
    lines += [f"  damaged {damage}" for damage in run.damage]
    if run.topics and draw:
        from touchcell.cell.analysis.trip_plot import plot_trip

        moment = "trip" if causes else "end"
        try:
            tripped = _tripped(folder, run, causes[0]) if causes else None
            cause = causes[0] if causes else None
            lines.append(f"plot: {plot_trip(run, end_s, cause, folder / 'why.png', moment, tripped)}")
        except OSError as error:
            lines.append(f"no plot: {error.strerror}")
    return "\n".join(lines)


def _tripped(folder: Path, run: Run, cause: dict[str, Any]) -> WatchedQuantity | None:
    """Return the quantity that tripped; None where its limit is unknown."""
    try:
        return tripped_quantity(run, RunFolder(folder).plan, cause)
    except (ConfigError, OSError):
        return None


_DIED: Final = f"the run's process ended without a result: {KILLED}"


def _evidence(folder: Path) -> _Evidence | None:
    if (folder / RING).exists():
        about, messages = read_left_ring(folder)
        return _Evidence(about, run_of(messages), RING)
    if (about := read_record(folder / ABOUT)) and (folder / MESSAGES).exists():
        return _Evidence(about, load_run(folder / MESSAGES), MESSAGES)
    # A black box that cannot be read leaves the answer to the recording.
    about = RunFolder(folder).result
    if (folder / RECORDING).exists():
        return _Evidence(about, load_run(folder / RECORDING), RECORDING)
    return _Evidence(about, run_of([]), RESULT) if about else None


def _crash(file: Path) -> list[str]:
    """The signal and the innermost frames that the interpreter noted."""
    try:
        lines = [line.strip() for line in file.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        return []
    return [line for line in lines if not line.startswith("Extension modules")][:6]


def _watchdog_note(file: Path) -> list[str]:
    try:
        note = json.loads(file.read_text())
    except (OSError, ValueError):
        raise RecordingError(file, "is damaged") from None
    lines = ["the watchdog noted:", f"  {note['words']}"]
    if note["limit_s"]:
        lines[-1] += f"  [value {note['value_s']:.4g}, limit {note['limit_s']:.4g} s]"
    for name, arm in note["arms"].items():
        rest = "never seen at rest" if arm["time_s"] is None else f"at rest after {arm['time_s']:.3f} s"
        lines.append(
            f"  {name}: commanded to stop at {1e3 * arm['speed_m_s']:.1f} mm/s; {rest} and "
            f"{1e3 * arm['distance_m']:.2f} mm" + (", by the strongest category it offers" if arm["escalated"] else "")
        )
    return lines


def _cause(cause: dict[str, Any]) -> str:
    text = f"{cause['interlock']} ({cause['severity']}): {cause['subject']}: {cause['reason']}"
    if cause["value"] is not None and cause["limit"] is not None:
        text += f"  [value {cause['value']:.4g}, limit {cause['limit']:.4g} {cause['unit']}]"
    return text + (f", tactile frame {cause['frame_seq']}" if cause["frame_seq"] is not None else "")


REMEDIES: Final = {
    "limited": "lower the task's gains or speeds, raise that limit of the arm if it can do more, or, where the "
    "estimate itself jumps, train the estimator on more images",
    "workspace": "if the task was right to go there, make the box larger; if not, look at its start and its target",
    "depth": "lower the task's depth or gains, or approach more slowly",
    "out_of_range": "press less deep and less slanted, or train the estimator on the contacts that occur; where the "
    "markers do not move as those of one tip, adapt the model to this tip (`touchcell adapt`)",
    "frame_age": "find what delays the camera or the cycle (budget.png); raise the limit only if the arm is slow",
    "arm_state_age": "find what delays the arm's states or the cycle (budget.png)",
    "tcp_speed": "lower the task's speeds or gains; the limit is for the tool, with the turn about it",
    "tracking": "the arm does not follow: look at its load, its own speed limits and what it touches",
    "contact_lost": "lower the speed, raise the depth, or let the task search again more often",
    "frame_frozen": "see whether the camera still delivers new pictures: cable, power, `touchcell probe`",
    "exposure": "bring light and camera back to what they were when the run began",
    "uncertain": "press less deep and less slanted, or train the estimator on the contacts that occur",
    "inconsistent": "lower the speed, or give the filter more drift: it expects less motion than there is",
    "shear": "lower the speed or the depth: the skin is dragged further than it can follow",
    "slip": "lower the speed, or press a little deeper: the skin slides",
    "torsion": "turn more slowly, or lower the depth",
    "markers_lost": "look at the images: light, focus, dirt, or a tip that has shifted",
    "tilt": "see whether the surface is steeper than the cone, and whether the task's gains about it are too high",
    "depth_disagrees": "calibrate the sensor's zero and its mount, or train the estimator for this tip",
    "standstill": "something moves an arm that is to stand: look at its brakes, its load and what pushes it",
    "clearance": "move the start, the target or the obstacle, or choose a path that leaves more room",
    "out_of_step": "lower the speed of the push, or the load that one arm takes more of than the other",
    "object_lost": "raise the follower's depth, or push more slowly",
    "toppling": "push lower, more slowly, or with less force",
    "pressure": "lower speed, depth or stiffness: the limit is for people",
    "wrench": "lower speed, depth or gains, and see whether the sensor was zeroed with this tool",
    "external_torque": "see what touches the arm, and whether its load and tool are set as they are",
    "reading": "see why the device reports that number (its log, `touchcell probe`)",
    "reading_age": "find what delays the device or the cycle (budget.png)",
    "hold_to_run": "hold the enabling device, then reset",
    "overrun": "find what else the machine does, or lower rate_hz (budget.png shows where a cycle's time goes)",
    "finite": "see which device delivers what is no number; nothing can be decided without it",
    "missing": "see why a device delivers nothing (its log, `touchcell probe`)",
}
"""What to do about a trip, by kind of interlock."""


def _remedy(folder: Path, cause: dict[str, Any]) -> str:
    """What to do about a trip, by the kind of its interlock in the run's cell file."""
    try:
        entry = load(folder / "cell.yaml").data.get("interlocks", {}).get(cause["interlock"], {})
    except (ConfigError, AttributeError):
        return ""
    # Those that are always on need no entry, and are named by their kind.
    return REMEDIES.get(str(entry.get("kind", cause["interlock"])), "") if isinstance(entry, dict) else ""


def _stop(stop: dict[str, Any]) -> str:
    speed = "an unknown speed" if stop["speed_m_s"] is None else f"{1e3 * stop['speed_m_s']:.1f} mm/s"
    text = f"stopped by category {stop['category']} from {speed}"
    if stop["escalated"]:
        text += ", was still moving after its stopping time, and was stopped by the strongest category it offers"
    if stop["time_s"] is None:
        return f"{text}; never seen at rest: {stop['problem']}"
    text += f"; at rest after {stop['time_s']:.3f} s (declared {stop['declared_s']:.3f} s)"
    if stop["distance_m"] is not None:
        text += f" and {1e3 * stop['distance_m']:.2f} mm (declared {1e3 * stop['declared_m']:.2f} mm)"
    return text


def _before(run: Run, trip_s: float) -> list[str]:
    """Return the events of the second before the trip, one line per arm, sensor and task."""
    lines = []
    task = _window(run.series("/task"), trip_s)
    if task is not None:
        states = list(dict.fromkeys(str(row["state"]) for row in task.rows if row["state"] != "tripped"))
        lines.append(f"task: {' -> '.join(states) or 'not yet started'}")
    for role in run.roles("arms", "tcp"):
        tcp = _window(run.series(f"/arms/{role}/tcp"), trip_s)
        if tcp is not None:
            way_mm = _path_length(tcp.poses()[:, :3])
            lines.append(f"{role}: moved {way_mm:.1f} mm, at most at {_finite(tcp, 'speed_mm_s').max():.1f} mm/s")
        commands = _window(run.series(f"/arms/{role}/command"), trip_s)
        if commands is not None:
            held = [row for row in commands.rows if row["limited_by"]]
            why = ", ".join(dict.fromkeys(limit for row in held for limit in row["limited_by"]))
            lines.append(f"{role}: {len(held)} of {len(commands.rows)} commands limited{f' by {why}' if why else ''}")
    for role in run.roles("sensors", "contact"):
        contact = _window(run.series(f"/sensors/{role}/contact"), trip_s)
        if contact is not None:
            depth = _finite(contact, "z_mm")
            ages_ms = [1e3 * (t - (row["t_frame_ns"] - run.start_ns) * 1e-9) for t, row in _rows(contact)]
            finite = np.isfinite(depth[[0, -1]]).all()
            change = f"{depth[0]:.2f} -> {depth[-1]:.2f} mm deep" if finite else "no contact"
            lines.append(f"{role}: {change}, frames up to {max(ages_ms):.0f} ms old")
    return lines


def _events(run: Run, t_ns: int) -> list[str]:
    """The latest events that have a reason, with their times before or after the moment."""
    lines = []
    for event in run.events:
        words = [str(event.data.get(key) or "") for key in ("event", "to", "reason")]
        if words[2]:
            change = f"{words[0]} -> {words[1]}" if words[1] else words[0]
            lines.append(f"{(event.t_ns - t_ns) * 1e-9:+.3f} s: {change}: {words[2]}")
    return lines[-_EVENTS:]


def _rows(series: Series) -> list[tuple[float, dict[str, Any]]]:
    return list(zip(series.t_s.tolist(), series.rows, strict=True))


def _finite(series: Series, name: str) -> Array:
    values = series.column(name)
    finite = values[np.isfinite(values)]
    return finite if len(finite) else np.array([np.nan])


def _path_length(points: Array) -> float:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return float(np.nansum(steps))


def _window(series: Series | None, trip_s: float) -> Series | None:
    """Return the part of ``series`` in the time before the trip; None where it is empty."""
    if series is None:
        return None
    inside = np.flatnonzero((series.t_s >= trip_s - BEFORE_S) & (series.t_s <= trip_s))
    return Series(series.t_s[inside], tuple(series.rows[i] for i in inside)) if len(inside) else None


def _last_ns(run: Run) -> int:
    """When the last message was recorded."""
    newest_s = max((float(series.t_s[-1]) for series in run.topics.values() if len(series.t_s)), default=0.0)
    return max(run.start_ns + round(1e9 * newest_s), run.events[-1].t_ns if run.events else 0)
