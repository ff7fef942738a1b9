"""Sections of surfaces that are meshes: files, height fields, extrusions, superquadrics and solids made of solids."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.input_file import InputFile
from touchcell.plugin_section import PluginSection
from touchcell.simulation.combine import Operation, Part, combined
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.hollows import guessed, hollows
from touchcell.simulation.meshes.load import INSTALL, SUFFIXES, Unit, load_mesh, mesh_library, what_is_open
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.motions import Still
from touchcell.simulation.shape_drawing import Drawable
from touchcell.simulation.shape_spec import SURFACES, SurfaceConfig, SurfaceSpec
from touchcell.simulation.surfaces import Surface

_LIBRARIES = {"trimesh": INSTALL}
_SOLIDS = {**_LIBRARIES, "manifold3d": INSTALL}
_LEAST_GUESSED = 0.05


class MeshSurfaceConfig(SurfaceConfig):
    """Base of surfaces that are meshes.

    Attributes:
        crease_deg: edges whose faces meet at more than this are creases, all others are smoothed; 0 leaves every facet
            flat.
    """

    crease_deg: float = Field(default=30.0, ge=0.0, le=180.0)

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        raise NotImplementedError(f"{type(self).__name__} has no mesh")

    def shape(self) -> MeshShape:
        """Return the shape in its own frame. Raises ConfigError."""
        return _shaped(self.mesh(), math.radians(self.crease_deg))

    def problems(self) -> Iterable[ConfigError]:
        """Yield what is wrong with its files and solids."""
        try:
            self.mesh()
        except ConfigError as error:
            yield error

    def remarks(self, tip_radius_m: float) -> Iterable[str]:
        """Yield where a tip of ``tip_radius_m`` rests on two sides at once, and where the mesh is too coarse."""
        crease_rad = math.radians(self.crease_deg)
        coarse = guessed(self.mesh(), crease_rad)
        if coarse.share > _LEAST_GUESSED:
            yield (
                f"{100.0 * coarse.share:.0f} % of it has edges of up to {1e3 * coarse.longest_m:.0f} mm over a bend: "
                f"what is between their ends is guessed, {1e3 * coarse.most_m:.1f} mm off a straight line at "
                f"({self._in_world(coarse.at)}) mm; export it finer, or keep it flat there with `crease_deg: 0`"
            )
        found = hollows(self.mesh(), crease_rad, tip_radius_m)
        if not found.any or found.at is None:
            return
        at = self._in_world(found.at)
        what = []
        if found.share > 0.0:
            what.append(
                f"{100.0 * found.share:.1f} % of it is hollow, down to a radius of {1e3 * found.tightest_m:.1f} mm"
            )
        if found.crease_m > 0.0:
            what.append(f"{1e3 * found.crease_m:.0f} mm of its creases are hollow")
        yield (
            f"the tip of {1e3 * tip_radius_m:g} mm does not fit everywhere: {' and '.join(what)}, as at ({at}) mm; "
            "there it rests on two sides, with no one depth and tilt to hold"
        )

    def _in_world(self, p: Array) -> str:
        T = se3.from_euler_mm_deg(self.pose_mm_deg)
        return ", ".join(f"{1e3 * each:.0f}" for each in T[:3, :3] @ p + T[:3, 3])


class MeshConfig(MeshSurfaceConfig):
    """A mesh file: STL, OBJ or PLY, in its own frame.

    Attributes:
        file: the mesh, beside the cell file.
        unit: of its coordinates, which no mesh file declares.
        scale: factor on the mesh, as for one that was normalised to a size of 1.
        repair: weld corners, close small holes, orient all faces, and make a thin wall of what stays open.
    """

    kind: Literal["mesh"]
    file: Annotated[str, InputFile("a mesh", hint="STL, OBJ and PLY files can be read")]
    unit: Literal["mm", "m", "inch"]
    scale: float = Field(default=1.0, gt=0.0)
    repair: bool = False

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        path = Path(self.file)
        try:
            status = path.stat()
        except OSError as error:
            raise ConfigError(f"cannot be read: {error.strerror}", key="file", value=self.file) from None
        return _loaded(path, self.unit, self.scale, self.repair, status.st_mtime_ns, status.st_size)

    def remarks(self, tip_radius_m: float) -> Iterable[str]:
        """Yield what a repair left open, and where a tip of ``tip_radius_m`` rests on two sides at once."""
        if self.repair and (left := what_is_open(self.mesh())):
            yield f"the repair left {left}; inside and outside are not known there, nor which edges can be touched"
        yield from super().remarks(tip_radius_m)

    def modules(self) -> Mapping[str, str]:
        """Return the mesh library."""
        return _LIBRARIES


@lru_cache(maxsize=2)
def _shaped(mesh: TriangleMesh, crease_rad: float) -> MeshShape:
    """Build the search once for what check asks of a mesh."""
    return MeshShape(mesh, crease_rad)


@lru_cache(maxsize=16)
def _loaded(path: Path, unit: Unit, scale: float, repair: bool, modified_ns: int, size: int) -> TriangleMesh:
    """Read a mesh once for check and run, unless the file has changed."""
    return load_mesh(path, unit, scale=scale, repair=repair)


class HeightFieldConfig(MeshSurfaceConfig):
    """Heights over a grid: a CSV or NPY table in mm, rows along y and columns along x, its centre at the origin.

    Attributes:
        file: the table, beside the cell file.
        spacing_mm: distance from one column or row to the next.
    """

    kind: Literal["height_field"]
    file: Annotated[str, InputFile("a table of heights", hint="comma-separated numbers in mm, or an .npy file")]
    spacing_mm: float = Field(gt=0.0)

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        heights = _table(self.file)
        if min(heights.shape) < 2:
            raise ConfigError("has fewer than two rows or columns", key="file", value=self.file)
        return primitives.height_field(1e-3 * heights, 1e-3 * self.spacing_mm)


class ExtrusionConfig(MeshSurfaceConfig):
    """A flat outline, raised from z = 0.

    Attributes:
        outline_mm: corners of the outline, in order.
        file: the same as a CSV or NPY table of two columns, beside the cell file.
        height_mm: of the solid.
    """

    kind: Literal["extrusion"]
    outline_mm: tuple[tuple[float, float], ...] | None = None
    file: Annotated[str | None, InputFile("a table of points", hint="two columns, x and y in mm")] = None
    height_mm: float = Field(gt=0.0)

    @model_validator(mode="after")
    def _one_outline(self) -> ExtrusionConfig:
        if (self.outline_mm is None) == (self.file is None):
            raise ValueError("an extrusion needs one of outline_mm and file")
        return self

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        key = "file" if self.file else "outline_mm"
        with mesh_library(key, str(self.file)):
            import shapely
            from trimesh.creation import extrude_polygon
        points = np.array(self.outline_mm) if self.file is None else _table(self.file)
        if points.shape[1] != 2 or len(points) < 3:
            raise ConfigError("is no outline of three or more points x, y", key=key, value=self.file)
        polygon = shapely.Polygon(1e-3 * points)
        if not polygon.is_valid or polygon.area <= 0.0:
            hint = "give each corner once, in order"
            raise ConfigError("crosses or touches itself", key=key, value=self.file, hint=hint)
        made = extrude_polygon(polygon, 1e-3 * self.height_mm)
        made.merge_vertices()
        return TriangleMesh(np.array(made.vertices, np.float64), np.array(made.faces, np.int32))

    def modules(self) -> Mapping[str, str]:
        """Return the libraries of meshes and outlines."""
        return {**_LIBRARIES, "shapely": INSTALL, "mapbox_earcut": INSTALL}


class SuperquadricConfig(MeshSurfaceConfig):
    """An ellipsoid (exponents 1), towards a box (below 1) or an octahedron (2); see ``primitives.superquadric``.

    Attributes:
        radii_mm: half its size along x, y and z.
        roundness: exponents of its sections through z and across z.
    """

    kind: Literal["superquadric"]
    radii_mm: tuple[float, float, float]
    roundness: tuple[float, float] = (1.0, 1.0)

    @model_validator(mode="after")
    def _in_range(self) -> SuperquadricConfig:
        if min(self.radii_mm) <= 0.0:
            raise ValueError("radii_mm must be positive")
        if not all(0.1 <= e <= 2.0 for e in self.roundness):
            raise ValueError("roundness must be between 0.1 and 2")
        return self

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame."""
        return primitives.superquadric(1e-3 * np.array(self.radii_mm), *self.roundness)


class CombinedConfig(MeshSurfaceConfig):
    """Base of solids made of solids. The poses of the parts are in the frame of the whole.

    Attributes:
        parts: boxes, cylinders, spheres, superquadrics, extrusions, meshes and combinations, by names of one's own.
    """

    parts: dict[str, Annotated[SurfaceConfig, PluginSection(SURFACES, nested=True)]] = Field(min_length=2)

    def modules(self) -> Mapping[str, str]:
        """Return the libraries of meshes and solids, and those of the parts."""
        found = dict(_SOLIDS)
        for part in self.parts.values():
            found.update(part.modules())
        return found

    def _combined(self, operation: Operation) -> TriangleMesh:
        with mesh_library("parts", ""):
            import manifold3d  # noqa: F401
        made = combined([_solid(name, part) for name, part in self.parts.items()], operation)
        # Parts that do no more than touch leave faces back to back.
        if not len(made.faces) or what_is_open(made):
            raise ConfigError(f"the {operation} of its parts is empty", key="parts", hint="move the parts")
        return made


class UnionConfig(CombinedConfig):
    """All parts together."""

    kind: Literal["union"]

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        return self._combined("union")


class IntersectionConfig(CombinedConfig):
    """What all parts have in common."""

    kind: Literal["intersection"]

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        return self._combined("intersection")


class DifferenceConfig(CombinedConfig):
    """The first part without the others."""

    kind: Literal["difference"]

    def mesh(self) -> TriangleMesh:
        """Return the mesh in the shape's own frame. Raises ConfigError."""
        return self._combined("difference")


def _solid(name: str, part: SurfaceConfig) -> Part:
    key = f"parts.{name}"
    if part.motion is not None:
        raise ConfigError("a part does not move by itself", key=f"{key}.motion", hint="give the motion to the whole")
    try:
        shape = part.shape()
        mesh = shape.drawn() if isinstance(shape, Drawable) else None
    except ConfigError as error:
        raise ConfigError(error.reason, key=f"{key}.{error.key}", value=error.value, hint=error.hint) from None
    if mesh is None or what_is_open(mesh):
        hint = "use a box, cylinder, sphere, superquadric, extrusion or a closed mesh"
        raise ConfigError(f"a {part.kind} encloses no volume", key=key, value=part.kind, hint=hint)
    T = se3.from_euler_mm_deg(part.pose_mm_deg)
    placed = TriangleMesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces)
    return Part(placed, Surface(shape, Still(T)))


def _table(file: str) -> Array:
    """Read a table of finite numbers (n, m). Raises ConfigError."""
    try:
        if file.lower().endswith(".npy"):
            table = np.load(file, allow_pickle=False)
        else:
            table = np.loadtxt(file, delimiter=",", ndmin=2)
        table = np.asarray(table, dtype=np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"is no table of numbers: {error}", key="file", value=file) from None
    if table.ndim != 2 or not np.isfinite(table).all():
        raise ConfigError("is no table of finite numbers in rows and columns", key="file", value=file)
    return table


MESH = SurfaceSpec("mesh", f"a mesh file: {', '.join(SUFFIXES)}", MeshConfig)
HEIGHT_FIELD = SurfaceSpec("height_field", "heights over a grid, from a table", HeightFieldConfig)
EXTRUSION = SurfaceSpec("extrusion", "a flat outline, raised", ExtrusionConfig)
SUPERQUADRIC = SurfaceSpec("superquadric", "an ellipsoid, or a rounded box", SuperquadricConfig)
UNION = SurfaceSpec("union", "solids together", UnionConfig)
INTERSECTION = SurfaceSpec("intersection", "what solids have in common", IntersectionConfig)
DIFFERENCE = SurfaceSpec("difference", "a solid without others", DifferenceConfig)
