"""Error of a tracking sensor relative to the plate that it tracks."""

from __future__ import annotations

import numpy as np

from touchcell.cell.analysis.run_folder import Poses, RunFolder, scene_time, sensor_poses, true_contacts
from touchcell.cell.experiments.scenes import surface
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.servoing import SENSOR


def tracking(trial: RunFolder) -> tuple[Poses, Array, Array]:
    """Return the sensor's poses, the plate's at the same times, and the errors (n, 6) in mm and degrees.

    The surface frame is that of the first touch, moved with the plate; the error is the sensor's pose in it
    against the reference. NaN while the task does not track.
    """
    plate = surface(trial)
    poses = sensor_poses(trial, SENSOR)
    T_world_plate = np.stack([plate.motion.pose(float(t)) for t in poses.t_s])
    T_plate_s = se3.inverse(T_world_plate) @ poses.T_world
    series, contacts = true_contacts(trial, SENSOR)
    touched = np.flatnonzero([bool(row.get("in_contact")) for row in series.rows])
    error = np.full((len(poses.t_s), 6), np.nan)
    task = trial.recording.series("/task")
    if len(touched) and task is not None:
        t_touch = scene_time(trial, series)[touched[0]]
        at_touch = Poses(poses.t_s, T_plate_s).at(np.array([t_touch]))[0]
        T_f_plate = se3.from_euler_mm_deg(contacts[touched[0]]) @ se3.inverse(at_touch)
        error = np.asarray(se3.to_euler_mm_deg(T_f_plate @ T_plate_s))
        error[:, 2] -= np.nanmedian(task.column("reference_z_mm"))
        error[~trial.recording.during(poses.t_s - 1e-9 * trial.recording.start_ns, "run")] = np.nan
    return poses, T_world_plate, error
