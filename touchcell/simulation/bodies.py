"""The table, surfaces and objects of a simulated scene as solids to draw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from touchcell.drivers.core.scene import SceneBody
from touchcell.geometry.solids import Cuboid, Cylinder, Mesh, Solid, Sphere, extrude, height_field
from touchcell.geometry.types import Array
from touchcell.simulation.motions import Still
from touchcell.simulation.objects import ObjectConfig, TableConfig
from touchcell.simulation.shape_drawing import drawn_shape
from touchcell.simulation.shape_spec import SurfaceConfig
from touchcell.simulation.shapes import Ball, Prism
from touchcell.simulation.shapes import Solid as FreeSolid
from touchcell.simulation.surfaces import Dome, Plane, Ramp, Shape
from touchcell.simulation.surfaces import Sphere as SphereShape

_PLATE_M: Final = 0.3
_RAMP_M: Final = (-0.15, 0.25, 0.06)
_TABLE_M: Final = (0.9, 0.5)
_THICKNESS_M: Final = 0.004


def scene_bodies(
    surfaces: Mapping[str, SurfaceConfig], objects: Mapping[str, ObjectConfig], table: TableConfig
) -> tuple[SceneBody, ...]:
    """Return all bodies of a scene; the table only where objects stand on it."""
    found = []
    for name, config in surfaces.items():
        surface = config.build()
        found.append(SceneBody(name, _surface(surface.shape), surface.motion.pose, moves=config.motion is not None))
    for name, each in objects.items():
        built = each.build(table)
        found.append(SceneBody(name, _free(built.solid), Still(built.T_world_object).pose, free=True))
    if objects:
        middle = np.mean([each.pose_mm_deg[:2] for each in objects.values()], axis=0) * 1e-3
        # Objects are pushed forwards, so that most of the table is in front of them.
        place = _shift(middle[0] + 0.15, middle[1], 1e-3 * table.height_mm - 0.5 * _THICKNESS_M)
        top = Cuboid((*_TABLE_M, _THICKNESS_M))
        found.append(SceneBody("table", ((top, np.eye(4)),), Still(place).pose))
    return tuple(found)


def _surface(shape: Shape) -> tuple[tuple[Solid, Array], ...]:
    if isinstance(shape, Ramp):
        return ((_ramp(shape), np.eye(4)),)
    plate = Cuboid((_PLATE_M, _PLATE_M, _THICKNESS_M)), _shift(0.0, 0.0, -0.5 * _THICKNESS_M)
    if isinstance(shape, Plane):
        return (plate,)
    if isinstance(shape, Dome):
        return plate, (Sphere(shape.radius_m), np.eye(4))
    if isinstance(shape, SphereShape):
        return ((Sphere(shape.radius_m), np.eye(4)),)
    mesh = drawn_shape(shape)
    return ((Mesh(mesh.vertices, np.asarray(mesh.faces, dtype=np.int64)), np.eye(4)),)


def _ramp(ramp: Ramp) -> Mesh:
    low, high, half_width = _RAMP_M
    x = np.linspace(low, high, 41)
    R, angle = ramp.bend_radius_m, ramp.incline_rad
    sign = np.sign(angle)
    end_x, end_z = R * abs(np.sin(angle)), sign * R * (1.0 - np.cos(angle))
    arc = sign * (R - np.sqrt(np.maximum(R**2 - np.clip(x, 0.0, end_x) ** 2, 0.0)))
    z = np.where(x <= end_x, arc, end_z + (x - end_x) * np.tan(angle))
    return height_field(x, np.array([-half_width, half_width]), np.column_stack([z, z]))


def _free(solid: FreeSolid) -> tuple[tuple[Solid, Array], ...]:
    if isinstance(solid, Prism):
        return ((extrude(solid.outline_m, 0.0, solid.height_m), np.eye(4)),)
    if isinstance(solid, Ball):
        return ((Sphere(solid.radius_m), np.eye(4)),)
    parts: list[tuple[Solid, Array]] = []
    bottom_m = 0.0
    for height, radius in solid.sections_m:
        parts.append((Cylinder(radius, height), _shift(0.0, 0.0, bottom_m + 0.5 * height)))
        bottom_m += height
    return tuple(parts)


def _shift(x: float, y: float, z: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T
