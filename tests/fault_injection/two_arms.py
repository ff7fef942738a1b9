"""Cells with two simulated arms in separate processes, for faults of the watchdog chain: they sway, or push."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from touchcell.cell.config.cell_plan import ArmSection, CellFile, CellPlan, DevicePlan
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import answerable
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.drivers.core.spec import DRIVERS
from touchcell.tasks.interface import Action, Observation, TaskConfig, TaskContext, TaskSpec, TransitionRecord
from touchcell.testing.emulation.process import EmulatorProcess

SPEED_M_S: Final = 0.03
PERIOD_S: Final = 2.0
EMULATORS: Final = "emulators.json"


_BOX = {"kind": "workspace", "min_mm": [-500, -200, 0], "max_mm": [500, 200, 400], "margin_mm": 60}
# What each arm that moves must have; lax, so that the watchdog chain is what finds a fault.
_INTERLOCKS: Final[Mapping[str, Any]] = {
    "left_box": {**_BOX, "arm": "left"},
    "right_box": {**_BOX, "arm": "right"},
    "speed": {"kind": "tcp_speed", "limit_m_s": 0.25, "limit_rad_s": 1.2},
    "stale_arm": {"kind": "arm_state_age", "limit_ms": 900},
}


def left_speed_m_s(now_ns: int) -> float:
    """Return the speed along x that ``Sway`` commands to the left arm.

    A square wave is almost always at full speed, which is the worst moment for a fault.
    """
    return math.copysign(SPEED_M_S, math.sin(2.0 * math.pi * now_ns * 1e-9 / PERIOD_S))


class Sway:
    """Both arms to and fro along x; finished on an operator's stop, or when the supervisor trips."""

    def __init__(self, config: TaskConfig, context: TaskContext) -> None:
        self._ttl_s = 3.0 / context.rate_hz
        self.state = "sway"
        self.finished = False
        self.succeeded = False
        self.transitions: tuple[TransitionRecord, ...] = ()

    def tick(self, observation: Observation) -> Action:
        """Return a twist for each arm, in opposite directions."""
        now_ns = observation.now_ns
        if observation.operator_stop:
            self.finished = self.succeeded = True
            return Action()
        twist = np.array([left_speed_m_s(now_ns), 0.0, 0.0, 0.0, 0.0, 0.0])
        return Action(
            {
                role: TwistCommand(sign * twist, TwistFrame.BASE, now_ns, self._ttl_s)
                for role, sign in (("left", 1.0), ("right", -1.0))
            }
        )

    def trip(self, now_ns: int, reason: str) -> None:
        """Enter the tripped state: nothing moves."""
        self.state, self.finished = "tripped", True


SPEC: Final = TaskSpec(
    name="sway",
    summary="two arms to and fro",
    config=TaskConfig,
    arms={"left": SERVO_ARM, "right": SERVO_ARM},
    sensors=frozenset(),
    build=Sway,
)


def _settings(section: ArmSection) -> dict[str, Any]:
    return {**(section.model_extra or {}), "start_pose_mm_deg": section.start_pose_mm_deg}


def two_arm_plan(
    folder: Path,
    rate_hz: float,
    *,
    processes: str = "separate",
    categories: Mapping[str, int] | None = None,
    on_trip: str = "end",
) -> CellPlan:
    """Return the plan of the cell: no scene, so that each arm is its own group."""
    driver = DRIVERS.load("sim_arm")
    places = {"left": -300.0, "right": 300.0}
    arms = {
        name: {
            "driver": "sim_arm",
            "deactivate": "hold",
            "stop_category": (categories or {}).get(name, 2),
            "start_pose_mm_deg": (x_mm, 0.0, 200.0, 180.0, 0.0, 0.0),
        }
        for name, x_mm in places.items()
    }
    cell = CellFile.model_validate(
        {
            "schema": 1,
            "name": "two_arms",
            "time": "real",
            "rate_hz": rate_hz,
            "processes": processes,
            "on_trip": on_trip,
            "arms": arms,
            "interlocks": _INTERLOCKS,
            "task": {"name": SPEC.name},
        }
    )
    devices = {
        name: DevicePlan(name, driver, driver.config.model_validate(_settings(section)))
        for name, section in cell.arms.items()
    }
    roles = {name: name for name in devices}
    return CellPlan(folder / "cell.yaml", cell, devices, {}, roles, {}, SPEC, TaskConfig(), (), devices)


def pushing_plan(folder: Path, rate_hz: float) -> CellPlan:
    """Return the plan of a cell in which two emulated arms push, on the true contact, in several processes.

    Each arm has its own host; the scene, which moves nothing, is in the task's process. The file ``EMULATORS``
    in ``folder`` contains the address of each arm.

    Raises:
        ConfigError: the cell cannot run that slowly.
    """
    data = yaml.safe_load(find_cell(Path("configs/dual_push_emulated.yaml")).read_text())
    data |= {"processes": "separate", "rate_hz": rate_hz}
    for arm, host in json.loads((folder / EMULATORS).read_text()).items():
        data["arms"][arm]["host"] = host
    # Rendering images would load the machine and confound the effect of the fault.
    data["scene"] = data.pop("emulated_scene")
    data["sensors"] = {
        name: {
            "driver": "sim_tactip",
            "mounted_on": sensor["mounted_on"],
            "tcp_to_sensor_mm_deg": sensor["tcp_to_sensor_mm_deg"],
            "rate_hz": 30,
            "estimator": {"kind": "true_contact"},
        }
        for name, sensor in data["sensors"].items()
    }
    data["interlocks"] = answerable(data)
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return plan_cell(path)


@contextmanager
def pushing_emulators(folder: Path, number: int) -> Iterator[None]:
    """Run the emulated arms of ``pushing_plan``, at addresses that differ by ``number``."""
    hosts = {arm: f"127.99.{number % 250}.{k}" for k, arm in enumerate(("leader", "follower"), start=2)}
    (folder / EMULATORS).write_text(json.dumps(hosts))
    with (
        EmulatorProcess("franka", "--host", hosts["leader"]),
        EmulatorProcess("ur", "--host", hosts["follower"]),
    ):
        yield
