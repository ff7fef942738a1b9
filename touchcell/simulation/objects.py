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
GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, slots=True)
class FreeObject:
    """A rigid object that can be pushed.

    Attributes:
        solid: shape, of even density.
        mass_kg: mass.
        friction: coefficient of sliding friction against the table.
        T_world_object: (4, 4) initial pose; see the solid for the position of its frame.
        center_of_mass_m: x and y of its centre of mass, from that of even density.
    """

    solid: Solid
    mass_kg: float
    friction: float
    T_world_object: Array
    center_of_mass_m: tuple[float, float] = (0.0, 0.0)


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
        friction: coefficient of sliding friction on the table, in place of the table's.
        center_of_mass_mm: x and y of its centre of mass, from that of even density.
    """

    shape: ObjectShapeSection
    mass_g: PositiveFloat
    friction: Annotated[float, Field(gt=0.0, le=2.0)] | None = None
    center_of_mass_mm: tuple[float, float] = (0.0, 0.0)
    pose_mm_deg: PoseMmDeg = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def build(self, table: TableConfig) -> FreeObject:
        """Build the object, standing on ``table``."""
        T_world_object = se3.from_euler_mm_deg(np.array(self.pose_mm_deg))
        T_world_object[2, 3] += 1e-3 * table.height_mm
        x_mm, y_mm = self.center_of_mass_mm
        return FreeObject(
            self.shape.build(),
            1e-3 * self.mass_g,
            table.coefficient if self.friction is None else self.friction,
            T_world_object,
            (1e-3 * x_mm, 1e-3 * y_mm),
        )


class FrictionPatchConfig(Section):
    """A disc on the table on which friction differs.

    Attributes:
        center_mm: x and y of its centre in the world.
        radius_mm: radius of the disc.
        factor: friction there over friction elsewhere.
    """

    center_mm: tuple[float, float]
    radius_mm: PositiveFloat
    factor: PositiveFloat


class TableConfig(Section):
    """The table under the objects: a plane, level unless it is tilted.

    Attributes:
        height_mm: height of its top in the world.
        friction: coefficient of sliding friction, or the name of one of the paper's tables.
        tilt_deg: tilt of table and arms together about the world's x and y axes: gravity then has a part along the
            table.
        patches: places where friction differs; the last one that covers a point counts.
    """

    height_mm: float = 0.0
    tilt_deg: tuple[Annotated[float, Field(ge=-30.0, le=30.0)], Annotated[float, Field(ge=-30.0, le=30.0)]] = (0.0, 0.0)
    patches: tuple[FrictionPatchConfig, ...] = ()
    friction: Literal["mdf", "foam"] | Annotated[float, Field(gt=0.0, le=2.0)] = "mdf"

    @property
    def coefficient(self) -> float:
        """Coefficient of sliding friction."""
        return TABLES[self.friction] if isinstance(self.friction, str) else self.friction

    @property
    def gravity_m_s2(self) -> tuple[float, float, float]:
        """Gravity in the world frame, whose z axis is the table's normal."""
        about_x, about_y = (math.radians(angle) for angle in self.tilt_deg)
        x, y, z = math.sin(about_y), -math.sin(about_x) * math.cos(about_y), -math.cos(about_x) * math.cos(about_y)
        return GRAVITY_M_S2 * x, GRAVITY_M_S2 * y, GRAVITY_M_S2 * z

    def factor(self, x_m: float, y_m: float) -> float:
        """Return the friction at a place over that elsewhere."""
        for patch in reversed(self.patches):
            if math.hypot(1e3 * x_m - patch.center_mm[0], 1e3 * y_m - patch.center_mm[1]) <= patch.radius_mm:
                return patch.factor
        return 1.0


BOX = ObjectSpec("box", "a box", BoxShape)
HEXAGON = ObjectSpec("hexagon", "a hexagonal prism", HexagonShape)
CYLINDER = ObjectSpec("cylinder", "an upright cylinder", CylinderShape)
BOTTLE = ObjectSpec("bottle", "stacked cylinders", BottleShape)
BALL = ObjectSpec("ball", "a ball", BallShape)
