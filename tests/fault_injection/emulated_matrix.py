"""One case of the matrix of ``touchcell bench faults``: a fault of an emulated device in one state of a task.

The device is the real driver on its emulator, in real time. Whether an emulated arm is at rest is read from the
emulator's ground truth.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from tests.fault_injection.emulated_cells import (
    DEVICE_ROLE,
    FAULT_ROLES,
    arm_cell,
    camera_cell,
    device_cell,
    sensor_of,
    sensors_of,
)
from tests.fault_injection.fault_matrix import SETTINGS_OF_STATES
from tests.fault_injection.sent_commands import SentCommands
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.spec import DriverContext
from touchcell.errors import TouchcellError
from touchcell.geometry.types import Array
from touchcell.tasks.interface import TASKS, TaskContext
from touchcell.tasks.servoing import ServoTask
from touchcell.tasks.state_machine_task import MachineTask
from touchcell.testing.emulation.rig import RIGS, DeviceFixture, Emulated

ARMS: Final = ("ur", "franka", "damiao_can", "feetech_serial")
CAMERAS: Final = ("v4l2",)
DEVICES: Final = ("net_ft", "robotiq")
VANISH: Final = "kill -9"
HANG: Final = "SIGSTOP"

MORE_FAULTS: Final[Mapping[str, Mapping[str, tuple[Any, str]]]] = {
    "ur": {
        "fault_bits": (5, "fault"),
        "local_control": (True, "unseen"),
        "other_program": (True, "unseen"),
        "registers_in_use": (True, "unseen"),
        "speed_slider": (0.5, "unseen"),
        "wrench": ([0.0, 0.0, 5.0, 0.0, 0.0, 0.0], "unseen"),
        "program_pause": (True, "fault"),
        "cut_rtde": (True, "fault"),
        "no_dashboard": (True, "unseen"),
        "version": ([5, 11, 1, 108249], "unseen"),
        "missing_variable": ("tcp_offset", "unseen"),
        "temperature": (78.0, "unseen"),
        "voltage": (44.0, "unseen"),
        "pendant_tool": ([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], "unseen"),
    },
    "franka": {
        "drop": (25, "fault"),
        "delay": (0.5, "fault"),
        "corrupt": (3, "fault"),
        "locked": (True, "fault"),
        "external_wrench": ([35.0, 0.0, 0.0, 0.0, 0.0, 0.0], "fault"),
        "guiding": (True, "fault"),
        "fci_off": (True, "unseen"),
        "version": (8, "unseen"),
        "other_client": (True, "unseen"),
        "slow_recovery": (1.0, "unseen"),
        "object": (0.03, "unseen"),
        "no_hand": (True, "unseen"),
    },
    "damiao_can": {
        "push": ([0, 5.0], "unseen"),
        "refuse": (1, "unseen"),
        "nan": (True, "unseen"),
        "turn_off": ([0, 1], "unseen"),
        "enobufs": (12, "transient"),
        "net_down": (0.05, "transient"),
        "id_clash": ([1, 2], "fault"),
        "wrong_rate": (True, "fault"),
        "registers": ([0, 14, 1], "unseen"),
        "deaf": ([0, 1], "unseen"),
        "error_passive": ([136, 0], "transient"),
        "chatter": (1, "transient"),
        "echo": (True, "transient"),
        "stray_registers": (3, "transient"),
        "disable": (2, "fault"),
        "spike": (3, "transient"),
    },
    "feetech_serial": {
        "block": (0, "unseen"),
        "carry": ([0, 300], "fault"),
        "registers": ([0, 7, "fa"], "unseen"),
        "turn_off": (0, "unseen"),
        "noise": (3, "transient"),
        "id_clash": ([0, 1], "fault"),
        "baud": ([3, 1], "fault"),
        "voltage": ([1, 6.5], "unseen"),
        "temperature": ([1, 66], "unseen"),
        "busy": (True, "unseen"),
        "adapter_echo": (True, "transient"),
    },
    "v4l2": {
        "stamp_shift": (-0.02, "unseen"),
        "wild_stamps": (3, "transient"),
        "stuck_stamp": (True, "fault"),
        "stuck_number": (True, "fault"),
        "duplicates": (3, "transient"),
        "delay": (0.4, "stale"),
        "freeze_frame": (True, "fault"),
        "gain": (1.6, "unseen"),
        "exposure_drift": (0.5, "fault"),
        "stuck_controls": (True, "unseen"),
        "no_monotonic": (True, "transient"),
        "forgets": (True, "unseen"),
        "hole": (3, "transient"),
        "no_bandwidth": (True, "unseen"),
        "no_s_parm": (True, "unseen"),
        "other_camera": (True, "unseen"),
        "padding": (3, "unseen"),
        "reset_controls": (True, "fault"),
        "unreadable": (3, "transient"),
        "empty": (3, "transient"),
        "busy": (True, "unseen"),
        "metadata_node": (True, "unseen"),
        "only_format": (["YUYV", 640, 480], "unseen"),
        "granted_rate": (60.0, "unseen"),
        "control_errors": (5, "unseen"),
        "slow_start": (1.0, "unseen"),
        "dark": (True, "fault"),
        "true_rate": (2.0, "stale"),
    },
    "net_ft": {
        "wrench": ([0.0, 0.0, 5.0, 0.0, 0.0, 0.0], "unseen"),
        "delay": (0.004, "unseen"),
        "bad_calibration": (True, "unseen"),
    },
    "robotiq": {
        "delay": (0.01, "unseen"),
        "object": (30.0, "unseen"),
        "never_activates": (True, "unseen"),
    },
}
"""Faults that the conformance suite lacks or tests differently, with a value and the reaction in a running task."""

UNSEEN: Final[Mapping[tuple[str, str], Mapping[str, str]]] = {
    ("franka", "drop"): {"prepare": "the controller waits for the first command of a motion"},
    ("feetech_serial", "carry"): {"retract": "the tool is carried farther than it has to withdraw: the task has ended"},
}
"""States in which a fault does not end the run, and why."""

_WATCHED_S: Final = 3.0
_CALM_S: Final = 0.6
_SETTLED_CYCLES: Final = 5
_STILL_M: Final = 2e-4
_STILL_S: Final = 0.12
# A process that does not run for so long was starved.
_STALL_S: Final = 0.15
_TRIES: Final = 6
# On a stop request a task enters the first from one of the others, in which it presses.
_AFTER_STOP: Final = "retract"
_PRESSING: Final = ("run", "grab")
_RATE_HZ: Final = 50.0


@dataclass(frozen=True, slots=True)
class Place:
    """One case of the matrix.

    Attributes:
        driver: its emulator gets the fault.
        fault: name of the fault.
        task: task of the cell.
        role: of the arm or sensor with the fault.
        state: of the task in which it is injected.
    """

    driver: str
    fault: str
    task: str
    role: str
    state: str

    def __str__(self) -> str:
        return f"{self.driver}, {self.fault}, {self.task}, {self.role}, {self.state}"


@dataclass(frozen=True, slots=True)
class EmulatedCase:
    """Result of one case of the matrix.

    Attributes:
        place: the case.
        reaction: the driver's expected reaction: "fault" or "stale" ends the run, "transient" and "unseen" need not.
        ended_by: interlock or error that ended the run; empty if none did.
        detection_s: from the fault until the run ended; None if it continued.
        rest_s: from the end of the run until the arm was truly at rest; None where that is unknown.
        distance_m: path length of the tool in that time.
        reached: True if the fault was injected.
        stalled_s: longest time for which this process was starved from the fault on.
        problem: deviation from the expected behaviour; empty if none.
    """

    place: Place
    reaction: str
    ended_by: str = ""
    detection_s: float | None = None
    rest_s: float | None = None
    distance_m: float | None = None
    reached: bool = True
    stalled_s: float = 0.0
    problem: str = ""


def states_of(task: str) -> tuple[tuple[str, ...], bool]:
    """Return the states of a task by its own table, and whether it is one of those that share ``ServoTask``."""
    spec = TASKS.load(task)
    required = {"target_mm": (0.0, 0.0)} if "target_mm" in spec.config.model_fields else {}
    poses = {sensor: np.eye(4) for sensor in sensors_of(task)}
    made = spec.build(spec.config.model_validate(required), TaskContext(_RATE_HZ, poses, 0))
    assert isinstance(made, MachineTask)
    return made.states, isinstance(made, ServoTask)


def faults_of(driver: str, folder: Path) -> dict[str, tuple[Any, str]]:
    """Return every fault of the driver's emulator with its value and expected reaction, and those of its process."""
    ends = {HANG: (True, "fault"), VANISH: (True, "fault")}
    return {**RIGS.load(driver)(folder, 0).faults, **MORE_FAULTS[driver], **ends}


SERVO: Final = (
    "prepare, approach, settle and retract are one code, for every servoing task and any number of arms: "
    "tried in surface_following"
)
REACH: Final = "lift, tilt, press and shear of data_collection are one code, motion to a place: tried in press"
HIDDEN: Final = (
    "a fault that a driver tolerates silently reaches no task: faults that do not end a run are tried in one task"
)
RARE: Final = (
    "check, return and sidestep move the arm as approach and retract do, and runs on the true contact come to none of "
    "them: tried with simulated devices"
)
RULES: Final = (SERVO, RARE, REACH, HIDDEN)
"""Why a case is equivalent to another by construction."""

LEFT_OUT: Final = (
    "data_collection asks an arm to repeat to 20 um, which damiao_can and feetech_serial cannot by their encoders",
    "the effect of a camera's fault does not depend on the arm that carries it: v4l2 is mounted on simulated arms",
    "jog sends the twists that other tasks send: its states are tried with simulated devices, and its process is "
    "killed beside an emulated arm in tests/emulated/test_jog_process.py",
    "a device that is neither arm nor camera is read in each cycle whatever the task: tried in surface_following",
)
"""Cases that are not part of the matrix."""

_COARSE: Final = ("damiao_can", "feetech_serial")


def places(driver: str, folder: Path) -> Iterator[tuple[Place, str]]:
    """Yield every case of ``driver``, with the one of ``RULES`` that makes it equivalent to another; empty for none.

    Args:
        driver: of ``ARMS`` or ``CAMERAS``.
        folder: for the rig, of which only the faults are used.
    """
    tasks: list[str] = [*FAULT_ROLES] if driver not in DEVICES else ["surface_following"]
    if driver in CAMERAS:
        tasks.append("observe")
    elif driver in _COARSE:
        tasks.remove("data_collection")
    faults = faults_of(driver, folder)
    for task in tasks:
        states, servoes = states_of(task)
        for role in FAULT_ROLES.get(task, ("",)):
            target = role if driver in ARMS else sensor_of(role or "arm")
            target = DEVICE_ROLE if driver in DEVICES else target
            for state in states:
                rule = _rule(task, state, servoes=servoes)
                for fault, (_, reaction) in faults.items():
                    hidden = reaction in ("transient", "unseen") and task != "surface_following"
                    yield Place(driver, fault, task, target, state), HIDDEN if hidden else rule


def _rule(task: str, state: str, *, servoes: bool) -> str:
    if servoes and state in ("check", "return", "sidestep"):
        return RARE
    if servoes and state != "run" and task != "surface_following":
        return SERVO
    return REACH if task == "data_collection" and state in ("lift", "tilt", "shear") else ""


@dataclass
class Bench:
    """Run cases of the matrix, one after another.

    Args:
        folder: for sockets, cell files and collected data.
        address: first free address.
    """

    folder: Path
    address: int
    _poses: dict[str, Array] = field(default_factory=dict, init=False)

    def run(self, place: Place) -> EmulatedCase:
        """Inject the fault and judge the reaction; repeated where the machine starved it."""
        for _ in range(_TRIES):
            case = self._run_once(place)
            if case.reached and case.stalled_s < _STALL_S:
                break
        return case

    def _run_once(self, place: Place) -> EmulatedCase:
        value, reaction = faults_of(place.driver, self.folder)[place.fault]
        if place.state in UNSEEN.get((place.driver, place.fault), {}):
            reaction = "unseen"
        case = EmulatedCase(place, reaction)
        self.address += 10
        rig = RIGS.load(place.driver)(self.folder, self.address)
        with ExitStack() as exits:
            try:
                emulator = _started(rig, exits)
                if place.driver in DEVICES:
                    plan = self._planned(device_cell(rig))
                elif place.driver in ARMS:
                    plan = self._arm_plan(place, rig)
                else:
                    plan = self._camera_plan(place, rig, exits)
                return _run(case, rig, emulator, plan, value)
            except TouchcellError as error:
                return replace(case, reached=False, problem=f"before the fault: {error}")

    def _arm_plan(self, place: Place, rig: DeviceFixture) -> CellPlan:
        # Every fresh emulator has its tool at the same pose.
        if place.driver not in self._poses:
            self._poses[place.driver] = _reported_pose(rig)
        collected = self._collected()
        pose, settings = self._poses[place.driver], SETTINGS_OF_STATES.get(place.state)
        return self._planned(arm_cell(place.task, place.role, rig, pose, str(collected), settings))

    def _camera_plan(self, place: Place, rig: DeviceFixture, exits: ExitStack) -> CellPlan:
        rigs = {}
        for number, sensor in enumerate(sensors_of(place.task), start=1):
            if sensor == place.role:
                rigs[sensor] = rig
                continue
            rigs[sensor] = RIGS.load(place.driver)(self.folder, self.address + number)
            _started(rigs[sensor], exits)
        settings = SETTINGS_OF_STATES.get(place.state, {})
        plan = self._planned(camera_cell(place.task, rigs, str(self._collected()), settings))
        # No kernel module is needed: this process queries the emulator instead of the kernel.
        sensors = {
            name: replace(device, spec=replace(device.spec, build=_on_shim(rigs[name])))
            for name, device in plan.sensors.items()
        }
        return replace(plan, sensors=sensors)

    def _collected(self) -> Path:
        folder = self.folder / "collected"
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def _planned(self, data: Mapping[str, Any]) -> CellPlan:
        path = self.folder / "cell.yaml"
        path.write_text(yaml.safe_dump(data))
        return plan_cell(path)


def _started(rig: DeviceFixture, exits: ExitStack) -> Emulated:
    assert rig.start is not None
    emulator = rig.start()
    exits.callback(emulator.stop)
    return emulator


def _on_shim(rig: DeviceFixture) -> Callable[[str, Any, DriverContext], Device]:
    return lambda name, config, context: rig.build(context.clock)


def _run(case: EmulatedCase, rig: DeviceFixture, emulator: Emulated, plan: CellPlan, value: Any) -> EmulatedCase:
    place = case.place
    cell, stop, sent = compose(plan), StopRequest(), SentCommands()
    injected_s: float | None = None
    given_up_ns: int | None = None
    witness: _Witness | None = None
    stalls: _Stalls | None = None
    # A device that fails before the fault, as it does where the machine starves it, leaves the block without a result.
    unjudged = case = replace(case, reached=False, problem="the cell failed before the fault could be judged")
    with ExitStack() as watch, suppress(DeviceError), cell:
        task = cell.task
        assert isinstance(task, MachineTask)
        wait = 1 if place.state == task.states[0] else _SETTLED_CYCLES
        loop = RunLoop(cell, None, box=sent, stop=stop)
        loop.begin()
        going = True
        while going:
            if place.state == _AFTER_STOP and task.state in _PRESSING and not stop.count:
                stop.ask()
            if injected_s is None and task.state == place.state:
                wait -= 1
                if wait <= 0:
                    stalls = watch.enter_context(closing(_Stalls()))
                    injected_s = time.monotonic()
                    asked = _inject(emulator, place.fault, value)
                    if asked and rig.pose is not None and not rig.spec.capabilities.falls_on_power_loss:
                        witness = watch.enter_context(closing(_Witness(rig, emulator)))
            if injected_s is not None and given_up_ns is None:
                for_s = _CALM_S if case.reaction in ("transient", "unseen") else _WATCHED_S
                if time.monotonic() > injected_s + for_s:
                    given_up_ns = cell.clock.now_ns()
                    stop.ask_at_once()
            going = loop.step()
        ended_s = time.monotonic()
        result = loop.end()
        if injected_s is None or stalls is None:
            case = replace(case, reached=False, problem=f"the state was not reached: {result.reason}")
        else:
            # Effects of the stop at the end are not a reaction to the fault.
            causes = [cause for cause in result.causes if given_up_ns is None or cause.t_ns < given_up_ns]
            case = replace(case, reached=True, problem="")
            case = _judged(case, cell, replace(result, causes=tuple(causes)), sent, ended_s - injected_s)
            case = replace(case, stalled_s=stalls.longest_s)
        if witness is not None:
            time.sleep(_STILL_S)
            witness.close()
            case = _with_rest(case, witness, ended_s)
        _mend(emulator, place.fault)
    if case is unjudged and injected_s is not None and stalls is not None:
        case = replace(case, stalled_s=stalls.longest_s)
    return case


def _inject(emulator: Emulated, fault: str, value: Any) -> bool:
    """Inject the fault; return True if the emulator still answers."""
    if fault == VANISH:
        emulator.kill()
    elif fault == HANG:
        emulator.freeze()
    else:
        emulator.fault(fault, value)
    return fault not in (VANISH, HANG)


def _mend(emulator: Emulated, fault: str) -> None:
    """Remove the fault after the observation: a device that answers again is closed sooner."""
    if fault == HANG:
        emulator.thaw()
    elif fault != VANISH:
        with suppress(DeviceError, OSError):
            emulator.clear(fault)


def _judged(case: EmulatedCase, cell: Cell, result: RunResult, sent: SentCommands, took_s: float) -> EmulatedCase:
    problems = []
    first = result.causes[0] if result.causes else None
    by = "" if result.error is None else type(result.error).__name__
    by = by if first is None else first.interlock
    by = by or ("retreat" if result.outcome is Outcome.FAILED else "")
    if case.reaction in ("fault", "stale") and not by:
        problems.append(f"nothing ended the run, which continued for {_WATCHED_S:g} s ({result.outcome.value})")
    if first is not None and sent.since(first.t_ns):
        problems.append("a command was sent after the trip")
    simulated = {role: stop for role, stop in result.stops.items() if cell.arms[role].name != _emulated_arm(case)}
    problems += [f"{role}: {stop.problem}" for role, stop in simulated.items() if stop.problem]
    if by and case.place.driver not in ARMS:
        times = [stop.time_s for stop in simulated.values() if stop.time_s is not None]
        ways = [stop.distance_m for stop in simulated.values() if stop.distance_m is not None]
        case = replace(case, rest_s=max(times, default=None), distance_m=max(ways, default=None))
    return replace(case, ended_by=by, detection_s=took_s if by else None, problem="; ".join(problems))


def _emulated_arm(case: EmulatedCase) -> str:
    return case.place.role if case.place.driver in ARMS else ""


def _with_rest(case: EmulatedCase, witness: _Witness, ended_s: float) -> EmulatedCase:
    if not witness.seen:
        return case
    moved_s, travelled_m = witness.last_moved(ended_s)
    case = replace(case, rest_s=max(0.0, moved_s - ended_s), distance_m=travelled_m)
    if witness.seen[-1][0] - moved_s < _STILL_S / 2:
        return replace(case, problem=f"{case.problem}; the tool still moves".strip("; "))
    return case


class _Stalls:
    """Measures how long a sleeping thread of this process was kept from running, until it is closed."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._tick, name="stalls")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._done.set()
        self._thread.join()

    def _tick(self) -> None:
        step_s = 0.02
        before_s = time.monotonic()
        while not self._done.wait(step_s):
            now_s = time.monotonic()
            self.longest_s = max(self.longest_s, now_s - before_s - step_s)
            before_s = now_s


class _Witness:
    """Polls the emulator's true tool pose in a thread until it is closed.

    No other thread may use the emulator in that time.
    """

    def __init__(self, rig: DeviceFixture, emulator: Emulated) -> None:
        self._rig = rig
        self._emulator = emulator
        self._done = threading.Event()
        self.seen: list[tuple[float, Array]] = []
        self._thread = threading.Thread(target=self._look, name="witness")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        # An emulator that a fault has ended is not polled any more.
        with suppress(DeviceError, OSError):
            self._look_on()

    def _look_on(self) -> None:
        while not self._done.wait(0.005):
            self.seen.append((time.monotonic(), _true_pose(self._rig, self._emulator)[:3, 3]))

    def last_moved(self, since_s: float) -> tuple[float, float]:
        """Return when the tool last moved, and how far it went after ``since_s``."""
        last = self.seen[-1][1]
        moved_s = max((t for t, p in self.seen if np.linalg.norm(p - last) > _STILL_M), default=since_s)
        start = next((p for t, p in self.seen if t >= since_s), last)
        travelled_m = max(float(np.linalg.norm(p - start)) for t, p in self.seen if t >= since_s or p is last)
        return moved_s, travelled_m


def _true_pose(rig: DeviceFixture, emulator: Emulated) -> Array:
    assert rig.pose is not None
    return np.array(emulator.state()[rig.pose], dtype=np.float64).reshape(4, 4)


def _reported_pose(rig: DeviceFixture) -> Array:
    device = rig.build(MonotonicClock())
    assert isinstance(device, Arm)
    with device:
        device.configure()
        # Some report their tool pose only then; others would fall when they are de-energised.
        if not rig.spec.capabilities.falls_on_power_loss:
            device.activate()
        return device.tcp().value.T_base_tcp
