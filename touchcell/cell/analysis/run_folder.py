"""A run's folder and its ground truth: poses of sensors, surfaces and objects, true contacts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.analysis.run_data import Run, Series, load_run, tip_points
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.result_record import RESULT, read_record
from touchcell.geometry import se3
from touchcell.geometry.types import Array


@dataclass(frozen=True)
class RunFolder:
    """A run's folder: ``cell.yaml`` and ``run.mcap``, read on demand."""

    path: Path

    @cached_property
    def plan(self) -> CellPlan:
        """Its cell. Raises ConfigError."""
        return plan_cell(self.path / "cell.yaml", to_run=False)

    @cached_property
    def result(self) -> dict[str, Any]:
        """How it ended, as ``result.json`` says; empty where there is none that can be read."""
        return read_record(self.path / RESULT)

    @cached_property
    def recording(self) -> Run:
        """The recording without images. Raises RecordingError."""
        return load_run(self.path / "run.mcap")


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses over time: ``t_s`` (n,) since the start of the scene, ``T_world`` (n, 4, 4)."""

    t_s: Array
    T_world: Array

    def at(self, t_s: Array) -> Array:
        """Return (m, 4, 4) the newest pose at each of ``t_s``, or the first."""
        index = np.searchsorted(self.t_s, t_s + 1e-6, side="right") - 1
        poses: Array = self.T_world[np.clip(index, 0, len(self.t_s) - 1)]
        return poses


def scene_time(run: RunFolder, series: Series) -> Array:
    """Return the (n,) times of a series since the start of the scene, the origin of simulated time."""
    return series.t_s + 1e-9 * run.recording.start_ns


def sensor_poses(run: RunFolder, role: str) -> Poses:
    """Return the poses of the sensor of a role."""
    plan = run.plan
    name = plan.sensor_roles[role]
    section = plan.cell.sensors[name]
    assert section.mounted_on is not None
    arm = section.mounted_on
    arm_role = next((each for each, name in plan.arm_roles.items() if name == arm), arm)
    series = run.recording.series(f"/arms/{arm_role}/tcp")
    assert series is not None
    # Where a truth differs from what the file tells, the simulated devices have it.
    T_world_base = _pose(plan.devices[arm].config, "base_pose_mm_deg", plan.cell.arms[arm].T_world_base)
    T_tcp_sensor = _pose(plan.devices[name].config, "tcp_to_sensor_mm_deg", section.T_tcp_sensor)
    return Poses(scene_time(run, series), T_world_base @ tip_points(series) @ T_tcp_sensor)


def _pose(config: object, key: str, told: Array) -> Array:
    given = getattr(config, key, None)
    return told if given is None else se3.from_euler_mm_deg(np.array(given))


def during(run: RunFolder, series: Series, state: str = "run") -> NDArray[np.bool_]:
    """Return a mask (n,) of the samples taken while the task was in ``state``."""
    return run.recording.during(series.t_s, state)


def true_contacts(run: RunFolder, role: str) -> tuple[Series, Array]:
    """Return the series of true contacts of a sensor, and the contacts as (n, 6) in mm and degrees.

    NaN out of contact.
    """
    series = run.recording.series(f"/sensors/{role}/truth")
    assert series is not None
    return series, series.poses()


def tilt_deg(contacts_mm_deg: Array) -> Array:
    """Return the (n,) angle between the sensor's axis and the surface normal, of contacts (n, 6)."""
    alpha, beta = np.radians(contacts_mm_deg[:, 3]), np.radians(contacts_mm_deg[:, 4])
    angle: Array = np.degrees(np.arccos(np.clip(np.cos(alpha) * np.cos(beta), -1.0, 1.0)))
    return angle


def rms(values: Array) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def object_poses(run: RunFolder) -> Mapping[str, Poses]:
    """Return the poses of every free object, by its name."""
    return {
        topic.rpartition("/")[2]: Poses(scene_time(run, series), tip_points(series))
        for topic, series in run.recording.topics.items()
        if topic.startswith("/objects/")
    }
