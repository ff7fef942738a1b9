"""``touchcell bench emulated-push``: a push through real drivers on emulators, compared with simulated devices.

``dual_push_emulated.yaml`` runs by `touchcell run` on two emulated arms and two emulated cameras around one scene. Then
the same cell runs with simulated arms and sensors, once without any latency and once with the measured latency: from
exposure to command, and from command to motion. The ground truth comes from the emulators and from the simulator.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from touchcell.cell.analysis.push_errors import off_normal_mm, target_m
from touchcell.cell.analysis.run_data import tip_points
from touchcell.cell.analysis.run_folder import RunFolder, object_poses, scene_time, sensor_poses, true_contacts
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.v4l2.shim import environment
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.testing.emulation.process import EmulatorProcess

CELL: Final = "dual_push_emulated.yaml"
LEADER, FOLLOWER = "leader", "follower"
_SENSORS: Final = {LEADER: "leader_sensor", FOLLOWER: "follower_sensor"}
_OBJECT: Final = "prism"
_ASKED_EVERY_S = 0.02
_START_S = 60.0
_RUN_S = 180.0
_DELAYS_S = np.arange(0.0, 0.2, 0.001)
_GRID_S = 0.02


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency of one arm and its sensor, averaged over a push.

    Attributes:
        sensing_s: from the exposure of a frame to a command that used it, including the wait for the next cycle.
        obeying_s: from a command to the motion.
    """

    sensing_s: float
    obeying_s: float

    def beyond(self, own: Latency) -> Latency:
        """Return the difference to the latency ``own``."""
        return Latency(max(0.0, self.sensing_s - own.sensing_s), max(0.0, self.obeying_s - own.obeying_s))


@dataclass(frozen=True, eq=False)
class Push:
    """One push, from when both contacts have settled until the leader has arrived.

    Attributes:
        outcome: outcome of the run.
        t_s: (n,) since the push began.
        object_mm_deg: (n, 3) x, y and heading of the object.
        error_mm: from the target to the true contact normal at the end, in top view.
        latency: by arm.
    """

    outcome: str
    t_s: Array
    object_mm_deg: Array
    error_mm: float
    latency: Mapping[str, Latency]

    @property
    def duration_s(self) -> float:
        """Duration of the push."""
        return float(self.t_s[-1])


@dataclass(frozen=True)
class _Truth:
    t_s: Array
    T_world_object: Array
    T_world_f: Array


def cell_file(number: int) -> dict[str, Any]:
    """Return the shipped cell, with its own emulator addresses, so that several can run in parallel."""
    data: dict[str, Any] = yaml.safe_load(find_cell(Path(CELL)).read_text())
    for last, arm in enumerate(data["arms"].values(), start=2):
        arm["host"] = f"127.98.{number}.{last}"
    return data


def emulated(data: Mapping[str, Any], folder: Path) -> Push:
    """Run the cell ``data`` by `touchcell run` beside `touchcell emulate cell`; its run folder is ``folder``/run."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "emulated.yaml"
    path.write_text(yaml.safe_dump(dict(data)))
    cameras = folder / "cameras"
    cameras.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "touchcell", "run", str(path), "--out", str(folder / "run"), "--quiet"]
    with EmulatorProcess("cell", str(path), "--folder", str(cameras), timeout_s=_START_S) as emulator:
        witness = _Witness(emulator)
        try:
            run = subprocess.run(
                command,
                env=os.environ | environment(cameras),
                timeout=_RUN_S,
                capture_output=True,
                text=True,
                check=False,
            )
        finally:
            witness.close()
    result = json.loads((folder / "run" / "result.json").read_text()) if run.returncode in (0, 1, 3) else {}
    if not result:
        raise DeviceError("emulated cell", f"did not run:\n{run.stderr}")
    return _push(RunFolder(folder / "run"), f"{result['outcome']}: {result['reason']}", witness.truth())


def simulated(
    data: Mapping[str, Any], folder: Path, *, like: Path, late: Mapping[str, Latency] | None = None, seed: int = 1
) -> Push:
    """Run the same cell with simulated devices, its arms where those of the run ``like`` began.

    Args:
        data: the emulated cell.
        folder: for the recording.
        like: run folder of the emulated cell.
        late: latency to add, by arm; None for none.
        seed: of the camera's noise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = RunFolder(like)
    cell = {**data, "time": "simulated", "seed": seed, "scene": data["emulated_scene"]}
    del cell["emulated_scene"]
    cell["arms"], cell["sensors"] = {}, {}
    for role, sensor in _SENSORS.items():
        series = before.recording.series(f"/arms/{role}/tcp")
        assert series is not None
        added = Latency(0.0, 0.0) if late is None else late[role]
        cell["arms"][role] = {
            "driver": "sim_arm",
            "deactivate": "hold",
            "start_pose_mm_deg": series.poses()[0].tolist(),
            "latency_ms": 1e3 * added.obeying_s,
            **{key: data["arms"][role][key] for key in ("base_pose_mm_deg", "limits") if key in data["arms"][role]},
        }
        given = data["sensors"][sensor]
        cell["sensors"][sensor] = {
            "driver": "sim_tactip",
            "latency_ms": 1e3 * added.sensing_s,
            **{key: given[key] for key in ("mounted_on", "tcp_to_sensor_mm_deg", "rate_hz", "estimator")},
        }
    (folder / "cell.yaml").write_text(yaml.safe_dump(cell))
    with compose(plan_cell(folder / "cell.yaml")) as built, Recorder(folder / RECORDING) as recorder:
        result = RunLoop(built, recorder).run()
    run = RunFolder(folder)
    poses = object_poses(run)[_OBJECT]
    series, contacts = true_contacts(run, _SENSORS[LEADER])
    t_s = scene_time(run, series)
    T_f_s = np.asarray(se3.from_euler_mm_deg(np.nan_to_num(contacts)))
    T_world_f = se3.compose(sensor_poses(run, _SENSORS[LEADER]).at(t_s), se3.inverse(T_f_s))
    truth = _Truth(t_s, poses.at(t_s), T_world_f)
    return _push(run, f"{result.outcome.value}: {result.reason}", truth)


class _Witness:
    """Polls the emulated cell's ground truth in a thread until it is closed."""

    def __init__(self, emulator: EmulatorProcess) -> None:
        self._emulator = emulator
        self._done = threading.Event()
        self._seen: list[tuple[float, Any, Any]] = []
        self._thread = threading.Thread(target=self._look, name="witness")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._done.set()
        self._thread.join()

    def truth(self) -> _Truth:
        """The recorded ground truth."""
        return _Truth(*(np.array([each[i] for each in self._seen]) for i in range(3)))

    def _look(self) -> None:
        while not self._done.wait(_ASKED_EVERY_S):
            state = self._emulator.state()
            leader = _SENSORS[LEADER]
            if state["contacts"][leader] is not None:
                T_world_s, T_f_s = np.array(state["sensors"][leader]), np.array(state["contacts"][leader])
                T_world_f = se3.compose(T_world_s, se3.inverse(T_f_s))
                self._seen.append((1e-9 * state["t_ns"], state["objects"][_OBJECT], T_world_f))


def _push(run: RunFolder, outcome: str, truth: _Truth) -> Push:
    task = run.recording.series("/task")
    assert task is not None
    pushing = np.flatnonzero([row.get("state") == "run" for row in task.rows])
    if not len(pushing):
        raise DeviceError("push", f"never began: {outcome}")
    times = scene_time(run, task)[pushing]
    t_s = np.arange(0.0, times[-1] - times[0], _GRID_S)
    heading_deg = np.degrees(np.unwrap(np.arctan2(truth.T_world_object[:, 1, 0], truth.T_world_object[:, 0, 0])))
    columns = (*(1e3 * truth.T_world_object[:, :2, 3].T), heading_deg)
    at_end = min(int(np.searchsorted(truth.t_s, times[-1])), len(truth.t_s) - 1)
    return Push(
        outcome,
        t_s,
        np.stack([np.interp(t_s + times[0], truth.t_s, column) for column in columns], axis=1),
        off_normal_mm(truth.T_world_f[at_end], 1e3 * target_m(run)),
        {role: Latency(_sensing_s(run, role), _obeying_s(run, role)) for role in _SENSORS},
    )


def _sensing_s(run: RunFolder, role: str) -> float:
    series = run.recording.series(f"/arms/{role}/command")
    assert series is not None
    return float(1e-3 * np.nanmedian(series.column("sensor_to_command_ms")))


def _obeying_s(run: RunFolder, role: str) -> float:
    """Return the delay by which the integrated commands best fit the tool's motion."""
    series, tcp = run.recording.series(f"/arms/{role}/command"), run.recording.series(f"/arms/{role}/tcp")
    assert series is not None
    assert tcp is not None
    inside = np.searchsorted(tcp.t_s, series.t_s, side="right") - 1
    T_base_tcp = tip_points(tcp)[np.clip(inside, 0, None)]
    velocity = np.array([row["twist"][:3] for row in series.rows])
    in_tool = np.array([row["frame"] != "base" for row in series.rows])
    velocity[in_tool] = np.einsum("nij,nj->ni", T_base_tcp[in_tool, :3, :3], velocity[in_tool])
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(velocity[:-1] * np.diff(series.t_s)[:, None], axis=0)])
    moved = tip_points(tcp)[:, :3, 3]
    within = (tcp.t_s > series.t_s[0] + _DELAYS_S[-1]) & (tcp.t_s < series.t_s[-1])

    def misfit(delay_s: float) -> float:
        expected = np.stack([np.interp(tcp.t_s[within] - delay_s, series.t_s, axis) for axis in way.T], axis=1)
        off = moved[within] - expected
        return float(np.sum((off - off.mean(axis=0)) ** 2))

    return float(min(_DELAYS_S, key=misfit))


def median_path_mm(pushes: Sequence[Push]) -> Array:
    """Return (n, 2) the median position of the object's centre, every _GRID_S, for the duration of the shortest push.

    The median, because a machine that is busy for a tenth of a second makes one push an outlier.
    """
    n = min(len(push.t_s) for push in pushes)
    median: Array = np.median([push.object_mm_deg[:n, :2] for push in pushes], axis=0)
    return median


def differences_mm(push: Push, path_mm: Array) -> tuple[Array, Array]:
    """Return (n,) each: distance of the object's centre from ``path_mm`` (n, 2) at that time, and from all of it."""
    points = push.object_mm_deg[: len(path_mm), :2]
    then = _then(points, path_mm)
    aside: Array = np.linalg.norm(points[:, None] - path_mm[None], axis=2).min(axis=1)
    return then, aside


def _then(points_mm: Array, path_mm: Array) -> Array:
    n = min(len(points_mm), len(path_mm))
    away: Array = np.linalg.norm(points_mm[:n] - path_mm[:n], axis=1)
    return away


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``emulated-push.json`` and ``emulated-push.png`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench emulated-push", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--runs", type=int, default=3, help="of each kind: emulated ones vary because they run in real time"
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="touchcell-push-") as name:
        folder = Path(name)
        data = cell_file(1)
        done, failed = [], []
        for i in range(options.runs):
            try:
                push = emulated(data, folder / f"emulated_{i}")
            except DeviceError as error:
                failed.append(str(error))
                continue
            if push.outcome.startswith(Outcome.DONE.value):
                done.append(push)
                like = folder / f"emulated_{i}" / "run"
            else:
                failed.append(push.outcome)
        if not done:
            raise DeviceError("emulated cell", "no push was completed:\n" + "\n".join(failed))
        seeds = range(1, options.runs + 1)
        prompt = [simulated(data, folder / f"prompt_{seed}", like=like, seed=seed) for seed in seeds]
        added = {role: _median(done, role).beyond(_median(prompt, role)) for role in _SENSORS}
        late = [simulated(data, folder / f"late_{seed}", like=like, late=added, seed=seed) for seed in seeds]
    kinds = {"emulated": done, "simulated": prompt, "simulated, latency added": late}
    pushes = {f"{kind}, {i}": push for kind, runs in kinds.items() for i, push in enumerate(runs, start=1)}
    path_mm = median_path_mm(done)
    medians = {kind: median_path_mm(runs) for kind, runs in kinds.items()}
    apart_mm = {
        f"'{left}' and '{right}'": _rms(_then(medians[left], medians[right]))
        for left, right in combinations(medians, 2)
    }
    words = "; ".join(
        f"{role} {1e3 * each.sensing_s:.0f} ms of sensing, {1e3 * each.obeying_s:.0f} ms of obeying"
        for role, each in added.items()
    )
    lines = [f"medians apart, RMS: {pair} {distance_mm:.2f} mm" for pair, distance_mm in apart_mm.items()]
    lines += [f"did not come to its end: {reason}" for reason in failed]
    print("\n".join([table(pushes, path_mm), f"added: {words}", *lines]))
    _plot(pushes, path_mm, out / "emulated-push.png")
    report = {
        **provenance(),
        "added": {role: asdict(each) for role, each in added.items()},
        "medians_apart_mm": apart_mm,
        "pushes": {title: _figures(push, path_mm) for title, push in pushes.items()},
    }
    (out / "emulated-push.json").write_text(json.dumps(report, indent=1) + "\n")


def table(pushes: Mapping[str, Push], path_mm: Array) -> str:
    """Format every push, its latencies (leader / follower), and the distance of its object from ``path_mm`` (n, 2)."""
    heads = (
        ("", "error", "push", "frame to", "command to", "from the emulated median", "aside from its way"),
        ("", "mm", "s", "command, ms", "motion, ms", "RMS mm    worst", "RMS mm    worst"),
    )
    lines = [_line(head) for head in heads]
    for title, push in pushes.items():
        found = _figures(push, path_mm)
        latencies = [push.latency[role] for role in _SENSORS]
        cells = [title, f"{push.error_mm:.2f}", f"{push.duration_s:.2f}"]
        cells.append(" / ".join(f"{1e3 * each.sensing_s:.0f}" for each in latencies))
        cells.append(" / ".join(f"{1e3 * each.obeying_s:.0f}" for each in latencies))
        cells += [f"{found[f'{kind}_rms_mm']:.2f}{found[f'{kind}_worst_mm']:>9.2f}" for kind in ("then", "aside")]
        lines.append(_line(cells))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    widths = (31, 7, 7, 14, 13, 30, 22)
    first, *others = cells
    return first.ljust(widths[0]) + "".join(f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True))


def _figures(push: Push, path_mm: Array) -> dict[str, Any]:
    then, aside = differences_mm(push, path_mm)
    return {
        "outcome": push.outcome,
        "error_mm": push.error_mm,
        "duration_s": push.duration_s,
        "latency": {role: asdict(each) for role, each in push.latency.items()},
        "then_rms_mm": _rms(then),
        "then_worst_mm": float(then.max()),
        "aside_rms_mm": _rms(aside),
        "aside_worst_mm": float(aside.max()),
    }


def _median(pushes: Sequence[Push], role: str) -> Latency:
    sensing_s, obeying_s = np.median([astuple(push.latency[role]) for push in pushes], axis=0)
    return Latency(float(sensing_s), float(obeying_s))


_COLOURS: Final = {"emulated": "#1f77b4", "simulated": "#ff7f0e", "simulated, latency added": "#2ca02c"}


def _plot(pushes: Mapping[str, Push], path_mm: Array, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, (above, away) = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    for title, push in pushes.items():
        kind, _, number = title.rpartition(", ")
        style = {"color": _COLOURS[kind], "lw": 1.0, "label": kind if number == "1" else None}
        above.plot(push.object_mm_deg[:, 0], push.object_mm_deg[:, 1], **style)
        then, _ = differences_mm(push, path_mm)
        away.plot(push.t_s[: len(then)], then, **style)
    above.set(xlabel="x (mm)", ylabel="y (mm)", title="object's centre, top view")
    away.set(xlabel="time since the push began (s)", ylabel="mm", title="from the emulated median at the same time")
    above.legend(fontsize=8)
    for axis in (above, away):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=90)
    plt.close(figure)
