"""``touchcell bench faults``: every fault of every emulated arm in every state of a task, and what comes of it.

The arm is the real driver on its emulator, in real time; the sensor is simulated and sits where the driver says that
its tool is. Whether the arm stands is asked of the emulator, which knows the truth.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from benchmarks.fault_matrix import median_and_worst
from benchmarks.provenance import provenance
from benchmarks.sent_commands import SentCommands
from cell.compose import compose
from cell.config import plan_cell
from cell.loop import Outcome, RunLoop, RunResult, StopRequest
from drivers.arm import Arm
from drivers.clock import MonotonicClock
from drivers.emulators.rig import Emulated, Rig
from drivers.errors import DeviceError
from geometry import se3
from geometry.types import Array
from tasks.machine_task import MachineTask

ARMS: Final = ("ur", "franka", "damiao_can", "feetech_serial")
VANISH: Final = "kill -9"
HANG: Final = "SIGSTOP"

_GAP_M = 0.004
_TIP_RADIUS_M = 0.020
_WATCHED_S = 3.0
_CALM_S = 0.6
_SETTLED_CYCLES = 5
_STILL_M = 2e-4
_STILL_S = 0.12


@dataclass(frozen=True, slots=True)
class EmulatedCase:
    """One place in the matrix and what was found there.

    Attributes:
        driver, fault, state: which place.
        lawful: the driver's lawful answer by its rig: "fault" ends the run, "transient" and "unseen" need not.
        ended_by: interlock or error that ended the run; empty if none did.
        detection_s: from the fault until the run ended; None if it went on.
        rest_s: from the end of the run until the tool truly stood; None where it cannot be told.
        distance_m: way of the tool in that time.
        problem: what was not as it has to be; empty if all was.
    """

    driver: str
    fault: str
    state: str
    lawful: str
    ended_by: str = ""
    detection_s: float | None = None
    rest_s: float | None = None
    distance_m: float | None = None
    problem: str = ""


def places(driver: str, folder: Path) -> Iterator[tuple[Rig, Path, str, str]]:
    """Every (rig, cell file, fault, state) of ``driver``; rigs have addresses of their own, no emulator is started."""
    states: tuple[str, ...] | None = None
    number = 0
    faults = [*_rig(driver, folder, 0).faults, HANG, VANISH]
    for fault in faults:
        at = 0
        while states is None or at < len(states):
            number += 1
            rig = _rig(driver, folder, number)
            path = folder / f"{driver}_{number}.yaml"
            if states is None:
                path.write_text(yaml.safe_dump(cell_file(rig, np.eye(4))))
                task = compose(plan_cell(path)).task
                assert isinstance(task, MachineTask)
                states = task.states
            yield rig, path, fault, states[at]
            at += 1


def run_case(rig: Rig, path: Path, fault: str, state: str) -> EmulatedCase:
    """Start the rig's emulator, run the task, let ``fault`` happen in ``state``, and judge what comes of it."""
    value, lawful = rig.faults.get(fault, (True, "fault"))
    case = EmulatedCase(rig.spec.name, fault, state, lawful)
    assert rig.start is not None
    emulator = rig.start()
    try:
        path.write_text(yaml.safe_dump(cell_file(rig, _told_pose(rig))))
        return _run(case, rig, emulator, path, value)
    except DeviceError as error:
        return replace(case, problem=f"before the fault: {error}")
    finally:
        if fault == HANG:
            emulator.thaw()
        emulator.stop()


def cell_file(rig: Rig, T_base_tcp: Array) -> dict[str, Any]:
    """A cell in which the arm of ``rig``, its tool at ``T_base_tcp`` (4, 4), presses on a plate and glides over it."""
    assert rig.config is not None
    T_tcp_plate = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_plate[2, 3] = _TIP_RADIUS_M + _GAP_M
    plate = se3.to_euler_mm_deg(T_base_tcp @ T_tcp_plate)
    position_mm = 1e3 * T_base_tcp[:3, 3]
    return {
        "schema": 1,
        "name": f"matrix_{rig.spec.name}",
        "time": "real",
        "rate_hz": 50,
        "scene": {"surfaces": {"plate": {"kind": "plane", "pose_mm_deg": plate.tolist()}}},
        "arms": {
            "arm": {
                "driver": rig.spec.name,
                "deactivate": "hold",
                **rig.config.model_dump(mode="json", exclude_unset=True),
            }
        },
        "sensors": {
            "sensor": {
                "driver": "sim_tactip",
                "mounted_on": "arm",
                "rate_hz": 30,
                "latency_ms": 0,
                "estimator": {"kind": "true_contact"},
            }
        },
        "interlocks": {
            "workspace": {
                "kind": "workspace",
                "arm": "arm",
                "sensor": "sensor",
                "min_mm": (position_mm - 120.0).tolist(),
                "max_mm": (position_mm + 120.0).tolist(),
                "margin_mm": 60,
            },
            "tcp_speed": {"kind": "tcp_speed", "limit_m_s": 0.25, "limit_rad_s": 2.0},
            "indentation": {"kind": "depth", "limit_mm": 9},
            "stale_frame": {"kind": "frame_age", "limit_ms": 500},
            "stale_arm": {"kind": "arm_state_age", "limit_ms": 300},
        },
        "task": {
            "name": "surface_following",
            "distance_mm": 8,
            "speed_mm_s": 8,
            "retract_mm": 8,
            "approach_speed_mm_s": 8,
        },
    }


def _run(case: EmulatedCase, rig: Rig, emulator: Emulated, path: Path, value: Any) -> EmulatedCase:
    cell, stop, sent = compose(plan_cell(path)), StopRequest(), SentCommands()
    injected_s: float | None = None
    witness: _Witness | None = None
    with ExitStack() as watch, suppress(DeviceError), cell:
        task = cell.task
        assert isinstance(task, MachineTask)
        wait = 1 if case.state == task.states[0] else _SETTLED_CYCLES
        loop = RunLoop(cell, None, box=sent, stop=stop)
        loop.begin()
        going = True
        while going:
            if injected_s is None and task.state == case.state:
                wait -= 1
                if wait <= 0:
                    injected_s = time.monotonic()
                    if not _inject(emulator, case.fault, value) and not rig.spec.capabilities.falls_on_power_loss:
                        witness = watch.enter_context(closing(_Witness(rig, emulator)))
            if injected_s is not None:
                for_s = _WATCHED_S if case.lawful == "fault" else _CALM_S
                if time.monotonic() > injected_s + for_s:
                    stop.ask_at_once()
            going = loop.step()
        ended_s = time.monotonic()
        result = loop.end()
        if injected_s is None:
            return replace(case, problem=f"the state was not reached: {result.reason}")
        case = _judged(case, result, sent, injected_s, ended_s)
        if witness is not None:
            time.sleep(_STILL_S)
            witness.close()
            moved_s, way_m = witness.last_moved(ended_s)
            case = replace(case, rest_s=max(0.0, moved_s - ended_s), distance_m=way_m)
            if witness.seen[-1][0] - moved_s < _STILL_S / 2:
                case = replace(case, problem=f"{case.problem}; the tool still moves".strip("; "))
    return case


def _inject(emulator: Emulated, fault: str, value: Any) -> bool:
    """Make it happen; whether the emulator can no longer be asked."""
    if fault == VANISH:
        emulator.kill()
        return True
    if fault == HANG:
        emulator.freeze()
        return True
    emulator.fault(fault, value)
    return False


def _judged(
    case: EmulatedCase, result: RunResult, sent: SentCommands, injected_s: float, ended_s: float
) -> EmulatedCase:
    problems = []
    first = result.causes[0] if result.causes else None
    by = "" if result.error is None else type(result.error).__name__
    by = by if first is None else first.interlock
    by = by or ("retreat" if result.outcome is Outcome.FAILED else "")
    if case.lawful == "fault" and not by:
        problems.append(f"nothing ended the run, which went on for {_WATCHED_S:g} s ({result.outcome.value})")
    if first is not None and sent.since(first.t_ns):
        problems.append("a command was sent after the trip")
    return replace(case, ended_by=by, detection_s=ended_s - injected_s if by else None, problem="; ".join(problems))


class _Witness:
    """Asks the emulator where the tool truly is, again and again, in a thread of its own until it is closed.

    Nobody else may talk to the emulator in that time.
    """

    def __init__(self, rig: Rig, emulator: Emulated) -> None:
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
        # An emulator that a fault has ended is asked no more.
        with suppress(DeviceError, OSError):
            self._look_on()

    def _look_on(self) -> None:
        while not self._done.wait(0.005):
            self.seen.append((time.monotonic(), _true_pose(self._rig, self._emulator)[:3, 3]))

    def last_moved(self, since_s: float) -> tuple[float, float]:
        """When the tool was last seen in another place than at last, and how far it went after ``since_s``."""
        last = self.seen[-1][1]
        moved_s = max((t for t, p in self.seen if np.linalg.norm(p - last) > _STILL_M), default=since_s)
        start = next((p for t, p in self.seen if t >= since_s), last)
        way_m = max(float(np.linalg.norm(p - start)) for t, p in self.seen if t >= since_s or p is last)
        return moved_s, way_m


def _true_pose(rig: Rig, emulator: Emulated) -> Array:
    assert rig.pose is not None
    return np.array(emulator.state()[rig.pose], dtype=np.float64).reshape(4, 4)


def _told_pose(rig: Rig) -> Array:
    device = rig.build(MonotonicClock())
    assert isinstance(device, Arm)
    with device:
        device.configure()
        # Some tell their tool only then; others would fall when they are let go.
        if not rig.spec.capabilities.falls_on_power_loss:
            device.activate()
        return device.tcp().value.T_base_tcp


def _rig(driver: str, folder: Path, number: int) -> Rig:
    function: Callable[[Path, int], Rig] = importlib.import_module(f"drivers.emulators.rigs.{driver}").rig
    return function(folder, 500_000 + number)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; writes ``faults.json`` into ``out``. Takes about three seconds for each place."""
    parser = argparse.ArgumentParser(prog="touchcell bench faults", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", default=ARMS, metavar="driver", help=f"of {', '.join(ARMS)}")
    parser.add_argument("--state", action="append", help="only in this state of the task")
    options = parser.parse_args(arguments)
    cases: list[EmulatedCase] = []
    with tempfile.TemporaryDirectory(prefix="touchcell-faults-") as folder, suppress(KeyboardInterrupt):
        for driver in options.names:
            for rig, path, fault, state in places(driver, Path(folder)):
                if options.state is None or state in options.state:
                    cases.append(run_case(rig, path, fault, state))
                    print(f"\r{driver}: {fault} in {state}" + 20 * " ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(f"{'':<40}{'fault to end, ms':>20}{'then at rest, ms':>20}{'way, mm':>16}")
    print(
        f"{'driver, fault, lawful answer':<40}"
        + f"{'median':>12}{'worst':>8}" * 2
        + f"{'median':>9}{'worst':>7}  ended by"
    )
    for key in dict.fromkeys((case.driver, case.fault, case.lawful) for case in cases):
        print(_row(key, [case for case in cases if (case.driver, case.fault, case.lawful) == key]))
    bad = [case for case in cases if case.problem]
    print(f"\nas it has to be: {len(cases) - len(bad)} of {len(cases)} places of the matrix")
    for case in bad:
        print(f"  {case.driver}, {case.fault}, {case.state}: {case.problem}")
    report = {**provenance(), "cases": [asdict(case) for case in cases]}
    (out / "faults.json").write_text(json.dumps(report, indent=1) + "\n")


def _row(key: tuple[str, str, str], cases: Sequence[EmulatedCase]) -> str:
    detection = median_and_worst([1e3 * c.detection_s for c in cases if c.detection_s is not None], 12, 8, 0)
    rest = median_and_worst([1e3 * c.rest_s for c in cases if c.rest_s is not None], 12, 8, 0)
    way = median_and_worst([1e3 * c.distance_m for c in cases if c.distance_m is not None], 9, 7, 1)
    return f"{', '.join(key):<40}{detection}{rest}{way}  {', '.join(sorted({c.ended_by or '-' for c in cases}))}"
