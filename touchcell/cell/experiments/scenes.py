"""The scene of a simulated run, from its cell file."""

from __future__ import annotations

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.geometry.types import Array
from touchcell.simulation.scene import SceneConfig
from touchcell.simulation.surfaces import Surface


def surface(run: RunFolder) -> Surface:
    """Return the first surface of the run's scene, with its motion."""
    return next(iter(scene(run).surfaces.values())).build()


def distance_to_scene_mm(run: RunFolder, points: Array) -> Array:
    """Return the (n,) signed distances in mm of ``points`` (n, 3) m to the nearest surface, where all stand still."""
    surfaces = [each.build() for each in scene(run).surfaces.values()]
    found = [min((each.nearest(p, 0.0).distance_m for each in surfaces), key=abs) for p in points]
    return 1e3 * np.array(found)


def scene(run: RunFolder) -> SceneConfig:
    """Return the scene of a simulated run."""
    return SceneConfig.model_validate(run.plan.cell.scene)
