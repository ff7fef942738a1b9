"""Measures from the recording of a push."""

from __future__ import annotations

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, object_poses
from touchcell.geometry.types import Array

OBJECT = "prism"
AIM_MM = 0.5
"""The project's own aim for the distance of a pushed object from its target."""


def lean_deg(run: RunFolder) -> Array:
    """Return the (n,) angle of the object's axis from the vertical over time."""
    upright = object_poses(run)[OBJECT].T_world[:, 2, 2]
    angle: Array = np.degrees(np.arccos(np.clip(upright, -1.0, 1.0)))
    return angle
