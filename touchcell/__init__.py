"""Robot cells that feel: typed device drivers, tactile perception, SE(3) control and safe task state machines.

    import touchcell as tc

    with tc.connect_arm("sim_arm", start_pose_mm_deg=[0, 0, 200, 180, 0, 0]) as arm, arm.control() as control:
        control.move_to([0, 50, 150, 180, 0, 0], speed_mm_s=50)
    result = tc.run("surface_follow_sim")
    print(result, tc.read_run(result.folder)["/arms/arm/tcp"])

Names are imported when they are first used: ``import touchcell`` itself loads nothing.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from touchcell.api.cells import CellRun, load_cell, run
    from touchcell.api.devices import (
        ArmControl,
        ConnectedArm,
        ConnectedCamera,
        ConnectedCell,
        NotArrived,
        connect_arm,
        connect_camera,
        connect_cell,
    )
    from touchcell.api.estimators import load_estimator
    from touchcell.api.recordings import RunRecording, Topic, read_run
    from touchcell.cell.config.cell_plan import CellPlan
    from touchcell.cell.runtime.cell import Cell
    from touchcell.cell.runtime.compose import compose
    from touchcell.drivers.core.errors import CommandRejected, DeviceError
    from touchcell.errors import ConfigError, TouchcellError

    __version__: str

__all__ = [
    "ArmControl",
    "Cell",
    "CellPlan",
    "CellRun",
    "CommandRejected",
    "ConfigError",
    "ConnectedArm",
    "ConnectedCamera",
    "ConnectedCell",
    "DeviceError",
    "NotArrived",
    "RunRecording",
    "Topic",
    "TouchcellError",
    "__version__",
    "compose",
    "connect_arm",
    "connect_camera",
    "connect_cell",
    "load_cell",
    "load_estimator",
    "read_run",
    "run",
]

_MODULES = {
    "touchcell.api.cells": ("CellRun", "load_cell", "run"),
    "touchcell.api.devices": (
        *("ArmControl", "ConnectedArm", "ConnectedCamera", "ConnectedCell", "NotArrived"),
        *("connect_arm", "connect_camera", "connect_cell"),
    ),
    "touchcell.api.estimators": ("load_estimator",),
    "touchcell.api.recordings": ("RunRecording", "Topic", "read_run"),
    "touchcell.cell.config.cell_plan": ("CellPlan",),
    "touchcell.cell.runtime.cell": ("Cell",),
    "touchcell.cell.runtime.compose": ("compose",),
    "touchcell.drivers.core.errors": ("CommandRejected", "DeviceError"),
    "touchcell.errors": ("ConfigError", "TouchcellError"),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("touchcell")
    for module, names in _MODULES.items():
        if name in names:
            found = getattr(import_module(module), name)
            globals()[name] = found
            return found
    raise AttributeError(f"module 'touchcell' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
