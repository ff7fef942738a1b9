"""Entry points of the shapes in a simulated scene (groups ``touchcell.surfaces`` and ``touchcell.objects``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.plugin_section import PluginSection, Section
from touchcell.registry import Registry
from touchcell.simulation.motions import Glide, Motion, Periodic, Still
from touchcell.simulation.shapes import Solid
from touchcell.simulation.surfaces import Shape, Surface

PoseMmDeg = tuple[float, float, float, float, float, float]

_HERE: PoseMmDeg = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_SI = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)


class GlideConfig(Section):
    """One smooth move: translations along and at most one rotation about the start frame's axes.

    Attributes:
        displacement_mm_deg: translation along and rotation about the start frame's axes; about one axis at most.
        start_s: when it begins.
        duration_s: how long it takes.
    """

    kind: Literal["glide"]
    displacement_mm_deg: PoseMmDeg
    start_s: float = Field(ge=0.0)
    duration_s: float = Field(gt=0.0)

    @model_validator(mode="after")
    def _one_rotation(self) -> GlideConfig:
        if sum(angle != 0.0 for angle in self.displacement_mm_deg[3:]) > 1:
            raise ValueError("displacement_mm_deg may rotate about one axis only; use kind: periodic for more")
        return self

    def build(self, T_start: Array) -> Motion:
        """Build the motion, which starts at ``T_start`` (4, 4)."""
        return Glide(T_start, np.array(self.displacement_mm_deg) * _SI, self.start_s, self.duration_s)


class PeriodicConfig(Section):
    """Sines in all pose components of the start frame, with a gentle start; see ``motions.Periodic``.

    Attributes:
        amplitude_mm_deg: amplitude of each component.
        shift_deg: phase of each component.
        period_s: period of all components.
        ramp_s: time in which the amplitude grows at the start.
        start_s: when it begins.
    """

    kind: Literal["periodic"]
    amplitude_mm_deg: PoseMmDeg
    shift_deg: PoseMmDeg = (0.0, 90.0, 0.0, 0.0, 90.0, 45.0)
    period_s: float = Field(gt=0.0)
    ramp_s: float = Field(default=1.0, gt=0.0)
    start_s: float = Field(default=0.0, ge=0.0)

    def build(self, T_start: Array) -> Motion:
        """Build the motion, which starts at ``T_start`` (4, 4)."""
        return Periodic(
            T_start,
            np.array(self.amplitude_mm_deg) * _SI,
            np.radians(self.shift_deg),
            self.period_s,
            self.ramp_s,
            self.start_s,
        )


class SurfaceConfig(Section):
    """Base of the section of a surface.

    ``pose_mm_deg`` is the pose of the shape's frame in the world, where its ``motion`` starts.

    Attributes:
        kind: which surface.
        pose_mm_deg: pose of the shape's frame in the world, where its motion starts.
        motion: how it moves; none for a surface that stands still.
    """

    kind: str
    pose_mm_deg: PoseMmDeg = _HERE
    motion: Annotated[GlideConfig | PeriodicConfig, Field(discriminator="kind")] | None = None

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        raise NotImplementedError(f"{type(self).__name__} has no shape")

    def problems(self) -> Iterable[ConfigError]:
        """Return what is wrong with the files that it names; ``key`` of each is relative to this section."""
        return ()

    def remarks(self, tip_radius_m: float) -> Iterable[str]:
        """Return what a tip of ``tip_radius_m`` cannot follow of it, for a reader of ``touchcell check``."""
        return ()

    def modules(self) -> Mapping[str, str]:
        """Return the optional modules that it needs, each with how to install it."""
        return {}

    def build(self) -> Surface:
        """Build the surface; its motion starts now."""
        T_world_body = se3.from_euler_mm_deg(self.pose_mm_deg)
        return Surface(self.shape(), self.motion.build(T_world_body) if self.motion else Still(T_world_body))


class ObjectShapeConfig(Section):
    """Base of the ``shape:`` section of a free object.

    Attributes:
        kind: which shape.
    """

    kind: str

    def build(self) -> Solid:
        """Build the solid."""
        raise NotImplementedError(f"{type(self).__name__} builds no solid")


@dataclass(frozen=True, slots=True)
class SurfaceSpec:
    """Entry point of one kind of surface.

    Attributes:
        name: value of ``kind`` in the scene.
        summary: one line for ``touchcell list``.
        config: pydantic model of its section, which builds the surface.
    """

    name: str
    summary: str
    config: type[SurfaceConfig]


@dataclass(frozen=True, slots=True)
class ObjectSpec:
    """Entry point of one shape of free objects.

    Attributes:
        name: value of ``kind`` in the object's ``shape:``.
        summary: one line for ``touchcell list``.
        config: pydantic model of that section, which builds the solid.
    """

    name: str
    summary: str
    config: type[ObjectShapeConfig]


SURFACES: Final = Registry("touchcell.surfaces", "surface", SurfaceSpec)
"""All installed kinds of surface."""

OBJECTS: Final = Registry("touchcell.objects", "object", ObjectSpec)
"""All installed shapes of free objects."""

SurfaceSection: TypeAlias = Annotated[SurfaceConfig, PluginSection(SURFACES)]
"""A surface of the scene."""

ObjectShapeSection: TypeAlias = Annotated[ObjectShapeConfig, PluginSection(OBJECTS)]
"""The ``shape:`` of a free object."""
