"""Free rigid objects on a table: shape, mass and sliding friction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.plugin_section import Section
from touchcell.simulation.shape_spec import ObjectShapeConfig, ObjectShapeSection, ObjectSpec, PoseMmDeg
from touchcell.simulation.shapes import Ball, Prism, Solid, Turned

TABLES: dict[str, float] = {"mdf": 0.3, "foam": 0.6}
"""Coefficients of sliding friction of the paper's two tables, chosen within literature values."""


@dataclass(frozen=True, slots=True)
class FreeObject:
    """A rigid object that can be pushed.

    Attributes:
        solid: shape, of even density.
        mass_kg: mass.
        friction: coefficient of sliding friction against the table.
        T_world_object: (4, 4) initial pose; see the solid for the position of its frame.
    """

    solid: Solid
    mass_kg: float
    friction: float
    T_world_object: Array


class BoxShape(ObjectShapeConfig):
    """A box, its sides along the object's axes.

    Attributes:
        size_mm: lengths of its sides.
    """

    kind: Literal["box"]
    size_mm: tuple[PositiveFloat, PositiveFloat, PositiveFloat]

    def build(self) -> Solid:
        """Build the solid."""
        x, y, z = (0.5e-3 * size for size in self.size_mm)
        return Prism(np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), 2.0 * z)


class HexagonShape(ObjectShapeConfig):
    """A hexagonal prism, two of its faces across the object's x axis.

    Attributes:
        height_mm: height.
    """

    kind: Literal["hexagon"]
    width_mm: PositiveFloat = Field(description="across flats")
    height_mm: PositiveFloat

    def build(self) -> Solid:
        """Build the solid."""
        corner_m = 1e-3 * self.width_mm / math.sqrt(3.0)
        angles = np.radians(30.0 + 60.0 * np.arange(6))
        return Prism(corner_m * np.column_stack([np.cos(angles), np.sin(angles)]), 1e-3 * self.height_mm)


class CylinderShape(ObjectShapeConfig):
    """An upright cylinder.

    Attributes:
        diameter_mm: diameter.
        height_mm: height.
    """

    kind: Literal["cylinder"]
    diameter_mm: PositiveFloat
    height_mm: PositiveFloat

    def build(self) -> Solid:
        """Build the solid."""
        return Turned(((1e-3 * self.height_mm, 0.5e-3 * self.diameter_mm),))


class BottleShape(ObjectShapeConfig):
    """Stacked cylinders: [height, diameter] of each, from the bottom up.

    Attributes:
        sections_mm: height and diameter of each cylinder, from the bottom up.
    """

    kind: Literal["bottle"]
    sections_mm: tuple[tuple[PositiveFloat, PositiveFloat], ...] = Field(min_length=1)

    def build(self) -> Solid:
        """Build the solid."""
        return Turned(tuple((1e-3 * height, 0.5e-3 * diameter) for height, diameter in self.sections_mm))


class BallShape(ObjectShapeConfig):
    """A ball; its frame is at its centre.

    Attributes:
        diameter_mm: diameter.
    """

    kind: Literal["ball"]
    diameter_mm: PositiveFloat

    def build(self) -> Solid:
        """Build the solid."""
        return Ball(0.5e-3 * self.diameter_mm)


class ObjectConfig(Section):
    """One free object of the ``scene:`` section. ``pose_mm_deg`` is in the world frame, its z above the table's top.

    Attributes:
        shape: its shape.
        mass_g: its mass.
        pose_mm_deg: initial pose in the world frame, z above the table's top.
    """

    shape: ObjectShapeSection
    mass_g: PositiveFloat
    pose_mm_deg: PoseMmDeg = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def build(self, table: TableConfig) -> FreeObject:
        """Build the object, standing on ``table``."""
        T_world_object = se3.from_euler_mm_deg(np.array(self.pose_mm_deg))
        T_world_object[2, 3] += 1e-3 * table.height_mm
        return FreeObject(self.shape.build(), 1e-3 * self.mass_g, table.coefficient, T_world_object)


class TableConfig(Section):
    """The table under the objects: a level plane.

    Attributes:
        height_mm: height of its top in the world.
        friction: coefficient of sliding friction, or the name of one of the paper's tables.
    """

    height_mm: float = 0.0
    friction: Literal["mdf", "foam"] | Annotated[float, Field(gt=0.0, le=2.0)] = "mdf"

    @property
    def coefficient(self) -> float:
        """Coefficient of sliding friction."""
        return TABLES[self.friction] if isinstance(self.friction, str) else self.friction


BOX = ObjectSpec("box", "a box", BoxShape)
HEXAGON = ObjectSpec("hexagon", "a hexagonal prism", HexagonShape)
CYLINDER = ObjectSpec("cylinder", "an upright cylinder", CylinderShape)
BOTTLE = ObjectSpec("bottle", "stacked cylinders", BottleShape)
BALL = ObjectSpec("ball", "a ball", BallShape)
