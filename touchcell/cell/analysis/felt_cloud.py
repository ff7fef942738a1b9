"""The shape that a run has felt: a point cloud with normals and uncertainty, from poses and estimates alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, during, scene_time, sensor_poses
from touchcell.cell.errors import RecordingError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_FIELDS = ("x", "y", "z", "nx", "ny", "nz", "sigma")


@dataclass(frozen=True, slots=True)
class FeltCloud:
    """Points of a surface that a sensor has felt, in the world frame.

    Attributes:
        points: (n, 3) m.
        normals: (n, 3) outward unit normals.
        sigma_m: (n,) standard deviation of each point along its normal, as believed.
    """

    points: Array
    normals: Array
    sigma_m: Array


def felt_cloud(run: RunFolder, role: str = "sensor", tip_radius_m: float = 0.020) -> FeltCloud:
    """Return what the sensor of ``role`` felt while the task ran.

    The point of a contact is one tip radius along the normal from the tip's centre less the depth: the origin of {f}
    moved to the surface.

    Args:
        run: the run's folder.
        role: of the sensor.
        tip_radius_m: of its tip.

    Raises:
        RecordingError: it felt nothing.
    """
    series = run.recording.series(f"/sensors/{role}/contact")
    running = None if series is None else during(run, series)
    if series is None or running is None or not running.any():
        raise RecordingError(run.path, f"holds no contact of {role!r} while the task ran")
    contacts = series.poses()[running]
    times = scene_time(run, series)[running]
    sigma = series.column("sigma_z_mm")[running] * 1e-3
    known = np.isfinite(contacts).all(axis=1)
    T_world_s = sensor_poses(run, role).at(times[known])
    points, normals = [], []
    for T, contact in zip(T_world_s, contacts[known], strict=True):
        R_world_f = T[:3, :3] @ se3.from_euler_mm_deg(contact)[:3, :3].T
        inward = R_world_f[:, 2]
        points.append(T[:3, 3] + (tip_radius_m - 1e-3 * contact[2]) * inward)
        normals.append(-inward)
    if not points:
        raise RecordingError(run.path, f"holds no contact of {role!r} while the task ran")
    return FeltCloud(np.array(points), np.array(normals), sigma[known])


def write_ply(cloud: FeltCloud, path: Path) -> None:
    """Write a cloud as binary PLY: x, y, z and ``sigma`` in millimetres, and unit normals. Raises RecordingError."""
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            "comment touchcell: felt points in the world frame, millimetres; sigma along the normal",
            f"element vertex {len(cloud.points)}",
            *(f"property float {name}" for name in _FIELDS),
            "end_header\n",
        ]
    )
    rows = np.column_stack([1e3 * cloud.points, cloud.normals, 1e3 * cloud.sigma_m]).astype("<f4")
    try:
        path.write_bytes(header.encode() + rows.tobytes())
    except OSError as error:
        raise RecordingError(path, f"cannot be written: {error.strerror}") from None
