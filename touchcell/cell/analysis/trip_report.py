"""``touchcell why``: explains why a run tripped, from its black box, with a plot around the moment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_data import Run, Series, load_run
from touchcell.cell.errors import RecordingError
from touchcell.cell.runtime.black_box import ABOUT, MESSAGES
from touchcell.cell.runtime.watchdog import NOTES
from touchcell.geometry.types import Array

BEFORE_S: Final = 1.0
"""Time before the trip that is reported, s."""


def explain(folder: Path) -> str:
    """Return what tripped the run in ``folder``, what happened in the second before, and how the arms came to rest.

    Also draws ``why.png`` beside it. A run whose process died has the watchdog's note only.

    Raises:
        RecordingError: the folder holds no black box.
    """
    if not (folder / ABOUT).exists() and (folder / NOTES).exists():
        return _from_watchdog(folder / NOTES)
    about = _about(folder)
    run = load_run(folder / MESSAGES)
    lines = [f"{about['cell']}: {about['outcome']}, cell file sha256 {about['cell_sha256'][:12]}"]
    causes = about["causes"]
    t_ns = causes[0]["t_ns"] if causes else _last_ns(run)
    if causes:
        lines.append(f"first cause, {(t_ns - about['start_ns']) * 1e-9:.3f} s after the start:")
        lines.append(f"  {_cause(causes[0])}")
        lines += [f"  then {1e-6 * (cause['t_ns'] - t_ns):.0f} ms later: {_cause(cause)}" for cause in causes[1:]]
    else:
        lines.append(f"  {about['reason']}")
    trip_s = (t_ns - run.start_ns) * 1e-9
    lines.append(f"in the {BEFORE_S:g} s before:")
    lines += [f"  {line}" for line in _before(run, trip_s)]
    lines.append("after:")
    lines += [f"  {role}: {_stop(stop)}" for role, stop in about["stops"].items()]
    from touchcell.cell.analysis.trip_plot import plot_trip

    lines.append(f"plot: {plot_trip(run, trip_s, causes[0] if causes else None, folder / 'why.png')}")
    return "\n".join(lines)


def _about(folder: Path) -> dict[str, Any]:
    try:
        about: dict[str, Any] = json.loads((folder / ABOUT).read_text())
    except OSError:
        raise RecordingError(folder, "holds no black box", hint="a run leaves one when it trips or fails") from None
    except ValueError:
        raise RecordingError(folder / ABOUT, "is damaged") from None
    return about


def _from_watchdog(file: Path) -> str:
    try:
        note = json.loads(file.read_text())
    except (OSError, ValueError):
        raise RecordingError(file, "is damaged") from None
    lines = ["the run's own process left no black box; the watchdog noted:", f"  {note['words']}"]
    if note["limit_s"]:
        lines[-1] += f"  [value {note['value_s']:.4g}, limit {note['limit_s']:.4g} s]"
    for name, arm in note["arms"].items():
        rest = "never seen at rest" if arm["time_s"] is None else f"at rest after {arm['time_s']:.3f} s"
        lines.append(
            f"  {name}: commanded to stop at {1e3 * arm['speed_m_s']:.1f} mm/s; {rest} and "
            f"{1e3 * arm['distance_m']:.2f} mm" + (", by the strongest category it offers" if arm["escalated"] else "")
        )
    return "\n".join(lines)


def _cause(cause: dict[str, Any]) -> str:
    text = f"{cause['interlock']} ({cause['severity']}): {cause['subject']}: {cause['reason']}"
    if cause["value"] is not None and cause["limit"] is not None:
        text += f"  [value {cause['value']:.4g}, limit {cause['limit']:.4g} {cause['unit']}]"
    return text + (f", tactile frame {cause['frame_seq']}" if cause["frame_seq"] is not None else "")


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
            path_mm = _path_length(tcp.poses()[:, :3])
            lines.append(f"{role}: moved {path_mm:.1f} mm, at most at {np.nanmax(_finite(tcp, 'speed_mm_s')):.1f} mm/s")
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
    return run.events[-1].t_ns if run.events else run.start_ns
