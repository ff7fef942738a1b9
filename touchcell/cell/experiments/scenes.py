"""The scene of a simulated run, from its cell file."""

from __future__ import annotations

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.simulation.scene import SceneConfig
from touchcell.simulation.surfaces import Surface


def surface(run: RunFolder) -> Surface:
    """Return the first surface of the run's scene, with its motion."""
    return next(iter(scene(run).surfaces.values())).build()


def scene(run: RunFolder) -> SceneConfig:
    """Return the scene of a simulated run."""
    return SceneConfig.model_validate(run.plan.cell.scene)
