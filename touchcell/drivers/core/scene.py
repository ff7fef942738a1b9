"""What a simulated scene offers to the rest of a cell, which knows it by its entry point alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from pydantic import BaseModel

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.samples import Stamped
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class ContactState:
    """What the tip feels: the only thing that the simulated image depends on, and the ground truth for it.

    Attributes:
        T_f_s: (4, 4) effective pose of the sensor in the surface frame, after slip; out of contact its z is minus the
            gap and it carries no shear.
        T_world_f: (4, 4) pose of the surface frame.
        in_contact: whether the tip touches.
        slipping: whether the contact slid in the last step.
        normal_force_n: force on the tip along the surface normal.
        shear_force_n: force on the tip along the x and y axes of {f}; zero where the physics does not tell it.
    """

    T_f_s: Array
    T_world_f: Array
    in_contact: bool
    slipping: bool
    normal_force_n: float
    shear_force_n: tuple[float, float] = (0.0, 0.0)

    @property
    def T_s_f(self) -> Array:  # noqa: N802  the field's own name
        """(4, 4) pose of the surface frame in the sensor frame: what the network predicts."""
        return se3.inverse(self.T_f_s)

    @property
    def depth_m(self) -> float:
        """Indentation, negative out of contact."""
        return float(self.T_f_s[2, 3])

    @property
    def force_world_n(self) -> Array:
        """(3,) force on the tip along the world's axes."""
        force: Array = self.T_world_f[:3, :3] @ np.array([*self.shear_force_n, -self.normal_force_n])
        return force


class SceneTruth(Protocol):
    """What can be asked of a scene, also of one in another process."""

    def contact(self, sensor: str, t_ns: int | None = None) -> Stamped[ContactState]:
        """What ``sensor`` feels."""
        ...

    def objects(self) -> Stamped[Mapping[str, Array]]:
        """T_world_object (4, 4) of every free object."""
        ...


class Scene(SceneTruth, Protocol):
    """A scene in this process, which devices are mounted in."""

    def has(self, sensor: str) -> bool:
        """Whether ``sensor`` is mounted."""
        ...


class SceneSection(BaseModel):
    """Base of a ``scene:`` section's model."""

    def build(self, clock: Clock) -> Scene:
        """The scene, with its motions starting now."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """A simulator's entry point.

    Attributes:
        name: of the simulator.
        summary: one line for ``touchcell list``.
        section: pydantic model of the ``scene:`` section.
    """

    name: str
    summary: str
    section: type[SceneSection]


SCENES: Final = Registry("touchcell.scenes", "scene", SceneSpec)
"""All installed simulators."""


def scene_section() -> type[SceneSection]:
    """The model of ``scene:`` sections. Raises ConfigError where no simulator is installed."""
    return SCENES.load("simulated").section
