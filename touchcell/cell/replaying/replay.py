"""Run a recorded run again: its frames and arm states through today's perception, task, interlocks and gates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from touchcell.cell.config.cell_plan import CellPlan, DevicePlan, RecordingSection
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.replaying.playback import (
    Playback,
    RecordedArm,
    RecordedCamera,
    RecordedDevice,
    RecordedPoses,
    recorded_estimator,
)
from touchcell.cell.replaying.recorded_run import RecordedRun, read_run
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import RunResult
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import TwistSink
from touchcell.drivers.core.spec import DriverConfig, DriverContext


@dataclass(frozen=True)
class Replay:
    """A run that was replayed.

    Attributes:
        plan: the cell, with what was set in place of its own values.
        recorded: the run as it was.
        replayed: the same cycles as they are today.
        result: how the replay ended.
        notes: what the replay does not show.
    """

    plan: CellPlan
    recorded: RecordedRun
    replayed: RecordedRun
    result: RunResult
    notes: tuple[str, ...]


def replay(
    folder: Path,
    out: Path,
    *,
    settings: Mapping[str, Any] | None = None,
    on_cycle: Callable[[int, int], None] | None = None,
) -> Replay:
    """Send what a run has recorded through today's code, and record what comes of it.

    Nothing moves: arms are where they were recorded, whatever they are commanded.

    Args:
        folder: the run's folder.
        out: an empty folder for the recording of the replay and its cell file.
        settings: values in place of the cell's own, by dotted key.
        on_cycle: called with the number of cycles done and of all.

    Raises:
        ConfigError: the cell file is none that today's code accepts.
        RecordingError: the recording cannot be read, or ``out`` not be written.
        ModelError: the estimator's model is not there any more.
    """
    plan = plan_cell(folder / "cell.yaml", settings=settings, to_run=False)
    recorded = read_run(folder / RECORDING)
    playback = Playback(recorded)
    images = {role: role in recorded.with_images for role in plan.sensor_roles}
    cell = compose(_from_recording(plan, recorded, playback, images), clock=playback)
    # Whether each interlock can trip was proven before the run; here it is shown what it saw.
    cell = replace(cell, require_armed=lambda: None)
    (out / "cell.yaml").write_text(plan.text())
    with cell, Recorder(out / RECORDING) as recorder:
        result = _run(cell, recorder, playback, len(recorded.cycles), on_cycle)
    notes = [
        f"{role}: no images (`--set recording.frames=video` records them), so its estimates are those of the run"
        for role, present in images.items()
        if not present
    ]
    if recorded.resumed:
        notes.append("the run was reset and went on; only what came before is replayed")
    return Replay(plan, recorded, read_run(out / RECORDING), result, tuple(notes))


def _run(
    cell: Cell, recorder: Recorder, playback: Playback, cycles: int, on_cycle: Callable[[int, int], None] | None
) -> RunResult:
    done = 0
    loop = RunLoop(cell, recorder)
    while loop.step() and not playback.ended:
        done += 1
        if on_cycle is not None:
            on_cycle(done, cycles)
    return loop.end()


def _from_recording(plan: CellPlan, run: RecordedRun, playback: Playback, images: Mapping[str, bool]) -> CellPlan:
    """Return the cell with recorded devices in place of its own, and without what is only simulated around them."""
    role_of = {name: role for role, name in plan.arm_roles.items()}
    sensor_role = {name: role for role, name in plan.sensor_roles.items()}
    auxiliary_role = {name: role for role, name in plan.auxiliary_roles.items()}
    sensors = {
        name: section
        if images.get(sensor_role.get(name, ""), True)
        else section.model_copy(update={"estimator": recorded_estimator(sensor_role[name], playback)})
        for name, section in plan.cell.sensors.items()
    }
    cell = plan.cell.model_copy(
        update={
            "scene": None,
            "truth": None,
            "collect": None,
            "time": "simulated",
            "processes": "one",
            "on_trip": "end",
            "enabling_device": plan.cell.enabling_device and "simulated",
            "recording": RecordingSection(),
            "sensors": sensors,
        }
    )
    return replace(
        plan,
        cell=cell,
        arms={
            name: _replaced(device, _arm(device, role_of.get(name, name), playback))
            for name, device in plan.arms.items()
        },
        sensors={
            name: _replaced(device, _camera(sensor_role[name], run, playback)) for name, device in plan.sensors.items()
        },
        auxiliaries={
            name: _replaced(device, partial(RecordedDevice, role=auxiliary_role[name], playback=playback))
            for name, device in plan.auxiliaries.items()
        },
    )


def _replaced(device: DevicePlan, build: Callable[[str], Device]) -> DevicePlan:
    def built(name: str, config: DriverConfig, context: DriverContext) -> Device:
        return build(name)

    return replace(device, spec=replace(device.spec, build=built))


def _arm(device: DevicePlan, role: str, playback: Playback) -> Callable[[str], Device]:
    capabilities = device.spec.capabilities
    if TwistSink not in capabilities.provides:
        return partial(RecordedPoses, role=role, playback=playback)
    limits = getattr(device.config, "limits", None)
    allowed = limits.build() if isinstance(limits, LimitsConfig) else LimitsConfig().build()
    return partial(
        RecordedArm, role=role, playback=playback, limits=allowed, stop_categories=capabilities.stop_categories
    )


def _camera(role: str, run: RecordedRun, playback: Playback) -> Callable[[str], Device]:
    return partial(RecordedCamera, role=role, playback=playback, images=run.images(role))
