"""Every fault of the simulated devices in every state of every task: what trips, and how the arm comes to rest.

The matrix is generated: faults are listed once, states come from the tasks' own tables.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import yaml

from tests.fault_injection.sent_commands import SentCommands
from tests.helpers.jog_script import ScriptedJog, every_state
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.devices.tactip import SimTactip
from touchcell.tasks.state_machine_task import MachineTask

_WATCHED_S = 3.0
_SETTLED_CYCLES = 3
# By then the camera has delivered enough frames for a brightness reference.
_NOT_BEFORE_S = 0.4
# Some tasks withdraw only on a stop request.
_AFTER_STOP = ("retract", "withdraw")
_ASKED_AFTER_S = 0.8

Inject = Callable[[Cell, StopRequest, str], None]
"""Injects a fault into the device with that name (a camera) or in that role (an arm)."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault and its expected reaction.

    Attributes:
        name: in tables.
        device: kind of the device; a task without an arm has no faults of one.
        inject: injects it.
        expected: kinds of interlock or error, one of which has to end the run; empty if the run has to end without.
        unseen: states in which it has no observable effect, or "state, task" where one task alone has none, and why.
        obeys: True if the arm still stops by its category; if not, it takes twice as long ...
        extra_m_s: ... and moves at this speed in addition.
    """

    name: str
    device: Literal["arm", "camera"]
    inject: Inject
    expected: frozenset[str]
    unseen: Mapping[str, str]
    obeys: bool = True
    extra_m_s: float = 0.0


def _arm(**changes: Any) -> Inject:
    def inject(cell: Cell, stop: StopRequest, device: str) -> None:
        arm = cell.arms[device]
        assert isinstance(arm, SimArm)
        arm.faults = replace(arm.faults, **changes)

    return inject


def _camera(**changes: Any) -> Inject:
    def inject(cell: Cell, stop: StopRequest, device: str) -> None:
        camera = cell.cameras[device]
        assert isinstance(camera, SimTactip)
        if "last_seq" in changes:
            camera.faults = replace(camera.faults, last_seq=camera.latest().seq)
        else:
            camera.faults = replace(camera.faults, **changes)

    return inject


def _and_stop(inject: Inject) -> Inject:
    """Combine the fault with an operator's stop, without which it would have no effect."""

    def both(cell: Cell, stop: StopRequest, device: str) -> None:
        inject(cell, stop, device)
        stop.ask_at_once()

    return both


_STANDS = {
    "prepare": "nothing moves yet",
    "grab": "it stands while a frame is taken",
    "keep": "the arm stands still",
    "note": "the arm stands still",
    "idle": "the arm stands still",
    "release": "the arm stands still",
    "settle, single_arm_pushing": "it only touches until it lets go again",
    "settle, dual_arm_pushing": "they only touch until they let go again, or are opposite each other",
}
_NO_BASELINE = {"prepare": "the first frames are the reference", "wait": "the first frames are the reference"}

FAULTS: Final = (
    Fault("operator's stop", "arm", _and_stop(lambda cell, stop, device: None), frozenset(), {}),
    Fault("arm: nan_state", "arm", _arm(nan_state=True), frozenset({"finite"}), {}),
    Fault("arm: stale", "arm", _arm(stale=True), frozenset({"arm_state_age"}), {}),
    Fault(
        "arm: drift_m_s",
        "arm",
        _arm(drift_m_s=0.03),
        frozenset({"tracking", "standstill", "depth", "workspace"}),
        {},
        obeys=False,
        extra_m_s=0.03,
    ),
    Fault("arm: ignores_stops", "arm", _and_stop(_arm(ignores_stops=True)), frozenset(), {}),
    Fault(
        "arm: ignores_expiry",
        "arm",
        _and_stop(_arm(ignores_expiry=True)),
        frozenset({"stop"}),
        _STANDS,
        obeys=False,
        extra_m_s=0.02,
    ),
    Fault("camera: frozen", "camera", _camera(frozen=True), frozenset({"frame_frozen"}), {}),
    Fault("camera: last_seq", "camera", _camera(last_seq=0), frozenset({"frame_age"}), {}),
    # Where the loop waits for the first frame, the arm's state is too old when it comes; a task without an arm gets the
    # same picture for too long.
    Fault(
        "camera: extra_latency_s",
        "camera",
        _camera(extra_latency_s=0.3),
        frozenset({"frame_age", "arm_state_age", "frame_frozen"}),
        {},
    ),
    Fault("camera: gain", "camera", _camera(gain=0.6), frozenset({"exposure"}), _NO_BASELINE),
)


@dataclass(frozen=True, slots=True)
class Case:
    """One case of the matrix and its result.

    Attributes:
        task, device, fault, state: the case.
        ended_by: kind of the interlock that came first, "stop" for an arm that had to be stopped by stronger means, the
            kind of the error that was raised, or empty if none.
        detection_s: from the fault to the trip.
        stop_s, distance_m: until the arm was at rest, of two the later; None where there is no arm or no reading.
        declared_s, declared_m: their declared limits.
        problem: deviation from the expected behaviour; empty if none.
    """

    task: str
    device: str
    fault: str
    state: str
    ended_by: str = ""
    detection_s: float | None = None
    stop_s: float | None = None
    distance_m: float | None = None
    declared_s: float | None = None
    declared_m: float | None = None
    problem: str = ""


_STEPS: Final = (
    {"move": {"name": "touch", "by_mm_deg": [0, 0, 20], "speed_mm_s": 8, "until": {"contact": True}}},
    {"servo": {"name": "press", "depth_mm": 2, "until": {"time_s": 0.8}}},
    {"hold": {"name": "keep", "time_s": 0.6}},
    {"move": {"name": "aside", "frame": "base", "by_mm_deg": [3, 0, 0], "speed_mm_s": 6}},
    {"retract": {"name": "lift", "distance_mm": 8, "speed_mm_s": 10}},
)
"""A step of each kind that lasts: ``record`` takes one cycle, in which nothing moves."""


def cells() -> dict[str, dict[str, Any]]:
    """Return a short cell file for every task, by the task's name."""
    following, tracking = _shipped("surface_follow_sim.yaml"), _shipped("object_track_sim.yaml")
    following["task"] |= {"distance_mm": 10, "retract_mm": 10}
    tracking["task"] |= {"duration_s": 0.6, "retract_mm": 12}
    edges = _shipped("edge_follow_sim.yaml")
    edges["task"] |= {"distance_mm": 15, "close_loop": False, "retract_mm": 10}
    observing = _shipped("surface_follow_sim.yaml")
    observing["task"] = {"name": "observe"}
    of_sensors = ("frame_age", "frame_frozen", "exposure")
    observing["interlocks"] = {n: e for n, e in observing["interlocks"].items() if e["kind"] in of_sensors}
    single, dual = _shipped("single_push_sim.yaml"), _shipped("dual_push_sim.yaml")
    for pushing in (single, dual):
        pushing["task"] |= {"target_mm": [70, 0], "retract_mm": 10}
    # So far aside that the arm lets go and touches again.
    single["scene"]["objects"]["prism"]["pose_mm_deg"] = [0, 14, 0, 0, 0, 0]
    collecting = _shipped("collect_sim.yaml")
    collecting["task"]["samples"] = 2
    # Thresholded images are the same while nothing moves, which would seem frozen.
    collecting["sensors"]["sensor"] |= {"output": "raw", "rate_hz": 30}
    collecting["interlocks"]["stale_frame"]["limit_ms"] = 150
    watching = ("frame_frozen", "exposure", "standstill")
    collecting["interlocks"] |= {n: e for n, e in following["interlocks"].items() if e["kind"] in watching}
    stepping = _shipped("steps_sim.yaml")
    stepping["scene"]["surfaces"]["plate"]["pose_mm_deg"] = [0, 0, 13, 0, 0, 0]
    stepping["interlocks"] |= {n: e for n, e in following["interlocks"].items() if e["kind"] in watching}
    stepping["task"] = {"name": "steps", "withdraw_mm": 10, "steps": list(_STEPS)}
    jogging = _shipped("surface_follow_sim.yaml")
    jogging["task"] = {"name": "jog"}
    del jogging["interlocks"]["contact_lost"]
    tasks = (following, tracking, edges, observing, single, dual, collecting, stepping, jogging)
    return {data["task"]["name"]: data for data in tasks}


@dataclass(frozen=True, slots=True)
class Place:
    """One fault of one device in one state of a task; picklable.

    Attributes:
        cell: content of the cell file.
        fault: name.
        device: role of the device.
        state: of the task.
    """

    cell: Mapping[str, Any]
    fault: str
    device: str
    state: str


SETTINGS_OF_STATES: Mapping[str, Mapping[str, Any]] = {
    "roam": {"motions": "sequence", "samples": 200, "sequence_frames": 200},
}
"""Keys of the task without which a state is never entered."""
_NOT_VISITED: Mapping[str, frozenset[str]] = {
    "arm": frozenset({"check", "return"}),
    "camera": frozenset({"return"}),
}
"""States that these short runs do not come to: on the true contact nothing is checked, and no contact is lost.
``tests/tasks/test_surface_following.py`` makes every transition from them."""


def places(devices: Sequence[str] = ("arm", "camera"), tasks: Sequence[str] | None = None) -> Iterator[Place]:
    """Return every case of the matrix.

    Args:
        devices: kinds of device with faults; those of cameras need a model, those of arms run on the true contact.
        tasks: names; None for all.
    """
    for task, data in cells().items():
        if tasks is not None and task not in tasks:
            continue
        for kind in devices:
            cell = on_true_contact(data) if kind == "arm" else data
            with tempfile.TemporaryDirectory() as folder:
                probe = composed(_written(cell, Path(folder)))
            assert isinstance(probe.task, MachineTask)
            targets = probe.plan.arm_roles if kind == "arm" else probe.cameras
            for fault in (fault for fault in FAULTS if fault.device == kind):
                for device in targets:
                    for state in probe.task.states:
                        if state in _NOT_VISITED[kind]:
                            continue
                        own = {**cell, "task": {**cell["task"], **SETTINGS_OF_STATES.get(state, {})}}
                        yield Place(own, fault.name, device, state)


def run_place(place: Place) -> Case:
    """Run one case of the matrix."""
    [fault] = [fault for fault in FAULTS if fault.name == place.fault]
    with tempfile.TemporaryDirectory() as folder:
        return run_case(_written(place.cell, Path(folder)), fault, place.device, place.state)


def _written(cell: Mapping[str, Any], folder: Path) -> Path:
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(dict(cell)))
    return path


def on_true_contact(data: Mapping[str, Any]) -> dict[str, Any]:
    """The cell file ``data`` with the scene's own contact in place of a network's estimate."""
    changed = {**data, "sensors": {name: dict(sensor) for name, sensor in data["sensors"].items()}}
    put_on_true_contact(changed)
    return changed


def plan_anew(path: Path) -> CellPlan:
    """Return its plan; a task that collects starts again, in a folder beside the file."""
    collected = path.with_suffix(".collected")
    shutil.rmtree(collected, ignore_errors=True)
    collects = "collect" in yaml.safe_load(path.read_text())
    return plan_cell(path, {"data": collected} if collects else {})


def composed(path: Path) -> Cell:
    """Compose the cell; one that is moved by hand is moved through every state."""
    plan = plan_anew(path)
    return compose(plan, jog_input=ScriptedJog(every_state()) if plan.task.name == "jog" else None)


def run_case(path: Path, fault: Fault, device: str, state: str) -> Case:
    """Run the cell, inject the fault into ``device`` in ``state``, and judge the reaction."""
    cell, stop, sent = composed(path), StopRequest(), SentCommands()
    case = Case(cell.plan.task.name, device, fault.name, state)
    injected_ns: int | None = None
    with cell:
        assert isinstance(cell.task, MachineTask)
        initial = state == cell.task.states[0]
        wait = 1 if initial else _SETTLED_CYCLES
        loop = RunLoop(cell, None, box=sent, stop=stop)
        loop.begin()
        going = True
        while going:
            if injected_ns is None and cell.task.state == state:
                wait -= 1
                now_ns = cell.clock.now_ns()
                if wait <= 0 and (initial or now_ns >= cell.start_ns + _NOT_BEFORE_S * 1e9):
                    injected_ns = now_ns
                    fault.inject(cell, stop, device)
            if injected_ns is not None and cell.clock.now_ns() > injected_ns + _WATCHED_S * 1e9:
                break
            if state in _AFTER_STOP and cell.clock.now_ns() > cell.start_ns + _ASKED_AFTER_S * 1e9 and not stop.count:
                stop.ask()
            going = loop.step()
        result = loop.end()
        at_rest = all(arm.at_rest() for arm in cell.arms.values())
    if injected_ns is None:
        return replace(case, problem="the state was not reached")
    return _judged(case, fault, cell, result, sent, injected_ns, at_rest=at_rest)


def _judged(
    case: Case, fault: Fault, cell: Cell, result: RunResult, sent: SentCommands, injected_ns: int, *, at_rest: bool
) -> Case:
    problems = []
    first = result.causes[0] if result.causes else None
    kinds = {name: entry.kind for name, entry in cell.plan.cell.interlocks.items()}
    by = "" if result.error is None else type(result.error).__name__
    if first is not None:
        by = kinds.get(first.interlock, first.interlock)
    unseen = case.state in fault.unseen or f"{case.state}, {case.task}" in fault.unseen
    expected: frozenset[str] = frozenset() if unseen else fault.expected
    if by not in (expected or {""}):
        problems.append(f"ended by {by or 'nothing'}, expected {' or '.join(sorted(expected)) or 'nothing'}")
    if first is not None and sent.since(first.t_ns):
        problems.append("a command was sent after the trip")
    if not at_rest:
        problems.append("the arm is not at rest")
    case = replace(case, ended_by=by, detection_s=None if first is None else (first.t_ns - injected_ns) * 1e-9)
    for role, report in result.stops.items():
        faulty = role == case.device
        times = 2 if faulty and not fault.obeys else 1
        longest_s = times * report.declared_s + 1.0 / cell.rate_hz
        farthest_m = times * report.declared_m + (fault.extra_m_s * longest_s if faulty else 0.0)
        if report.time_s is None or report.time_s > longest_s:
            problems.append(f"{role} at rest after {report.time_s} s, declared {report.declared_s:.3f} s")
        if report.distance_m is not None and report.distance_m > farthest_m:
            problems.append(
                f"{role} was at rest after {1e3 * report.distance_m:.2f} mm, declared {1e3 * report.declared_m:.2f} mm"
            )
        if case.stop_s is None or (report.time_s or 0.0) > case.stop_s:
            case = replace(
                case,
                stop_s=report.time_s,
                distance_m=report.distance_m,
                declared_s=report.declared_s,
                declared_m=report.declared_m,
            )
    return replace(case, problem="; ".join(problems))


def _shipped(name: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(find_cell(Path("configs") / name).read_text())
    return data


def median_and_worst(values: Sequence[float], first: int, second: int, digits: int) -> str:
    """Format two columns of the given widths; dashes where there is no value."""
    if not values:
        return f"{'-':>{first}}{'-':>{second}}"
    return f"{np.median(values):{first}.{digits}f}{max(values):{second}.{digits}f}"
