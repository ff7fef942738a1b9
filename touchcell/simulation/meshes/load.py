"""Mesh files: read, checked, and repaired where that is asked for. Needs the extra ``mesh``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from touchcell.errors import ConfigError
from touchcell.simulation.meshes.indexing import connected, has_three_corners
from touchcell.simulation.meshes.pieces import apart, as_one, has_piece_inside_out, pieces_of, solids_in_order
from touchcell.simulation.meshes.smoothing import Edges, TriangleMesh

Unit = Literal["mm", "m", "inch"]
UNITS: Final[dict[str, float]] = {"mm": 1e-3, "m": 1.0, "inch": 25.4e-3}
"""Metres of one unit of a mesh file, which cannot tell which one it has."""

SUFFIXES: Final = (".stl", ".obj", ".ply")
SMALLEST_M: Final = 10e-3
LARGEST_M: Final = 2.0
MOST_FACES: Final = 1_000_000
LARGEST_HOLE: Final = 12
"""Edges around a hole that a repair closes."""
MOST_OPEN: Final = 0.1
"""Share of its own area that a piece of a mesh may lack to be closed; with larger openings it is a sheet."""
SHEET_M: Final = 0.2e-3
"""Thickness that a repair gives to a sheet."""
WELD_M: Final = 10e-6
"""Distance of corners that a repair makes one: no finger feels it, and exporters round by less."""
INSTALL: Final = "pip install 'touchcell[mesh]'"


@contextmanager
def mesh_library(key: str, value: str) -> Iterator[None]:
    """Guard imports of the mesh library. Raises ConfigError, with what to install, where it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        reason = f"needs {error.name}, which is not installed"
        raise ConfigError(reason, key=key, value=value, hint=INSTALL) from None


def load_mesh(path: Path, unit: Unit, *, scale: float = 1.0, repair: bool) -> TriangleMesh:
    """Read a mesh file: STL, OBJ or PLY.

    Vertices that coincide are merged and faces without an area dropped, always. A mesh that does not enclose a volume
    is refused unless ``repair`` asks for corners within 0.01 mm to be welded, small holes to be closed and faces to be
    oriented; what lacks more than a tenth of its area then is a sheet and becomes a wall of 0.2 mm, which can be
    touched from both sides.

    Args:
        path: the file.
        unit: of its coordinates.
        scale: factor on them.
        repair: see above.

    Raises:
        ConfigError: no mesh, of an unlikely size, with too many faces, or open without ``repair``; its ``key`` is the
            key to change.
    """
    _require_likely_file(path)
    if path.suffix.lower() == ".stl":
        _require_whole_stl(path)
    with mesh_library("file", str(path)):
        import trimesh
    try:
        loaded: Any = trimesh.load_mesh(str(path), process=False)
    except Exception as error:  # Its readers raise whatever a damaged file makes them stumble over.
        # Of a damaged file it may try a text format whose optional decoder is not installed.
        detail = "" if isinstance(error, ImportError) else f": {error}"
        reason = f"is no {path.suffix[1:].upper()} file that can be read{detail}"
        raise ConfigError(reason, key="file", value=str(path), hint="it may be cut off; export it again") from None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise ConfigError("has no faces", key="file", value=str(path), hint="export triangles, not points or curves")
    if len(loaded.faces) > MOST_FACES:
        raise ConfigError(
            f"has {len(loaded.faces)} faces, more than {MOST_FACES}",
            key="file",
            value=str(path),
            hint="decimate it: 100 000 faces describe a hand-sized object to 0.01 mm",
        )
    if not np.isfinite(loaded.vertices).all():
        raise ConfigError("has a vertex that is not finite", key="file", value=str(path), hint="export it again")
    _require_likely_size(path, scale * np.asarray(loaded.vertices), unit)
    loaded.apply_scale(scale)
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    mesh = _triangles(loaded, unit)
    if repair:
        with mesh_library("file", str(path)):
            return _repaired(mesh)
    mesh = _without_empty_faces(mesh)
    if problem := what_is_open(mesh):
        raise ConfigError(
            f"does not enclose a volume: {problem}",
            key="file",
            value=str(path),
            hint="`repair: true` welds corners, closes small holes and orients the faces; what stays open becomes a "
            "wall of 0.2 mm, which can be touched from both sides",
        )
    if has_piece_inside_out(mesh):
        hint = "`repair: true` turns its faces round"
        raise ConfigError("is inside out: its normals point inwards", key="file", value=str(path), hint=hint)
    with mesh_library("file", str(path)):
        # Solids that only touch are one to whoever touches them.
        mesh, reach = as_one(mesh)
    if reach:
        hint = "`repair: true` makes them one"
        raise ConfigError("has solids that reach into each other", key="file", value=str(path), hint=hint)
    return mesh


def what_is_open(mesh: TriangleMesh) -> str:
    """Return why a mesh does not enclose a volume; empty if it does."""
    edges = Edges.of(mesh.faces)
    counts = (
        (edges.open_count, "edges of one face only"),
        (edges.crowded_count, "edges of more than two faces"),
        (edges.flipped_count, "edges whose faces disagree about the outside"),
    )
    return ", ".join(f"{count} {what}" for count, what in counts if count)


def _require_whole_stl(path: Path) -> None:
    """Refuse an STL file that ends before its last triangle: libraries read the rest, or nothing."""
    with path.open("rb") as file:
        head = file.read(1024)
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 256))
        tail = file.read()
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        whole = b"endsolid" in tail
    else:
        count = int.from_bytes(head[80:84], "little")
        whole = len(head) >= 84 and size >= 84 + 50 * count
    if not whole:
        reason = "is no STL file that can be read: it ends before its last triangle, or is none"
        raise ConfigError(reason, key="file", value=str(path), hint="it may be cut off; export it again")


def _require_likely_file(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise ConfigError(f"is none of {known}", key="file", value=str(path), hint="export it as STL, OBJ or PLY")
    try:
        empty = not path.stat().st_size
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", key="file", value=str(path)) from None
    if empty:
        raise ConfigError("is empty", key="file", value=str(path), hint="export it again")


def _require_likely_size(path: Path, vertices: Any, unit: Unit) -> None:
    extent = float(np.ptp(np.asarray(vertices), axis=0).max())
    size_m = extent * UNITS[unit]
    if SMALLEST_M <= size_m <= LARGEST_M:
        return
    likely = [each for each, metres in UNITS.items() if 10e-3 <= extent * metres <= 1.0]
    of_one = abs(extent - 1.0) < 0.02 or abs(extent - 2.0) < 0.04
    others = " or ".join(f"`unit: {each}` ({extent * UNITS[each] * 1e3:.4g} mm)" for each in likely)
    raise ConfigError(
        f"{path.name} would be {size_m * 1e3:.4g} mm large, which no tip follows",
        key="unit",
        value=unit,
        hint=(
            f"its size suggests {others}" + (", or that it was made of size 1: then give its `scale`" if of_one else "")
            if others
            else "export it in millimetres, or give its `scale`"
        ),
    )


def _triangles(loaded: Any, unit: Unit) -> TriangleMesh:
    return TriangleMesh(
        np.ascontiguousarray(loaded.vertices, dtype=np.float64) * UNITS[unit],
        np.ascontiguousarray(loaded.faces, dtype=np.int32),
    )


def _without_empty_faces(mesh: TriangleMesh) -> TriangleMesh:
    """Drop faces without area, and those that are there twice the same way round."""
    kept = mesh.faces[has_three_corners(mesh.faces)]
    turned = np.take_along_axis(kept, (kept.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    return TriangleMesh(mesh.vertices, np.ascontiguousarray(kept[np.sort(first)]))


def _is_drawn_twice(mesh: TriangleMesh) -> bool:
    """Return whether most faces lie back to back, as of sheets that are to be seen from both sides."""
    _, times = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_counts=True)
    return bool(2 * np.sum(times > 1) > len(times))


def _without_inner_walls(mesh: TriangleMesh) -> TriangleMesh:
    """Drop faces that lie back to back: both, as between solids that touch, or one of two, of a sheet drawn twice."""
    _, first, same, times = np.unique(
        np.sort(mesh.faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if times.max() == 1:
        return mesh
    solid = TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[times[same.ravel()] == 1]))
    if len(solid.faces) and not what_is_open(solid):
        return solid
    return TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[np.sort(first)]))


def _repaired(mesh: TriangleMesh) -> TriangleMesh:
    mesh = _welded(mesh, WELD_M)
    mesh = TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[has_three_corners(mesh.faces)]))
    solids: TriangleMesh | None = None
    if Edges.of(mesh.faces).crowded_count:
        solids, mesh = solids_in_order(mesh)
    if not len(mesh.faces) and solids is not None:
        return as_one(solids)[0]
    mended = with_thickness(_mended(_without_empty_faces(mesh)), SHEET_M)
    if solids is None:
        return mended if what_is_open(mended) else as_one(mended)[0]
    # What belongs to an assembly lacks faces where other parts have the same ones.
    closed = _with_holes_closed(mended, len(mended.faces))
    if not what_is_open(closed):
        return as_one(_together(solids, closed))[0]
    return _together(as_one(solids)[0], mended)


def _together(one: TriangleMesh, other: TriangleMesh) -> TriangleMesh:
    faces = np.concatenate([one.faces, other.faces + np.int32(len(one.vertices))])
    return TriangleMesh(np.concatenate([one.vertices, other.vertices]), faces)


def _mended(mesh: TriangleMesh) -> TriangleMesh:
    import trimesh

    edges = Edges.of(mesh.faces)
    solids = edges.crowded_count and not edges.open_count and not _is_drawn_twice(mesh)
    if solids and not what_is_open(separate := apart(mesh)):
        return separate
    mesh = _without_inner_walls(mesh)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    trimesh.repair.fix_winding(made)
    oriented = _as_most_were(mesh, _triangles(made, "m"))
    return _with_outside_out(_with_holes_closed(_without_empty_faces(oriented), LARGEST_HOLE))


def _welded(mesh: TriangleMesh, distance_m: float) -> TriangleMesh:
    """Make vertices one that lie within ``distance_m`` of each other, at the place of one of them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(mesh.vertices).query_pairs(distance_m, output_type="ndarray")
    if not len(pairs):
        return mesh
    count = len(mesh.vertices)
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    return TriangleMesh(mesh.vertices[first], np.ascontiguousarray(label[mesh.faces], dtype=np.int32))


def _as_most_were(before: TriangleMesh, after: TriangleMesh) -> TriangleMesh:
    """Turn round each piece of ``after`` most of whose area was the other way round ``before``; their order is one."""
    piece, faces = pieces_of(Edges.of(after.faces)), after.faces.copy()
    kept = np.einsum("mc,mc->m", before.face_normals(), after.face_normals())
    area = np.sign(kept) * np.sqrt(np.abs(kept))
    turned = np.bincount(piece, weights=area)[piece] < 0.0
    faces[turned] = faces[turned][:, ::-1]
    return TriangleMesh(after.vertices, np.ascontiguousarray(faces))


def with_thickness(mesh: TriangleMesh, thickness_m: float) -> TriangleMesh:
    """Return a mesh whose sheets are walls: two sides, half of ``thickness_m`` away from the sheet, and a rim.

    Pieces that are closed but for MOST_OPEN of their area have an inside, and stay as they are.
    """
    edges = Edges.of(mesh.faces)
    if not edges.open_count:
        return mesh
    piece, open_edge = pieces_of(edges), edges.other < 0
    sheets = ~_nearly_closed(mesh, piece, open_edge)[piece]
    if not sheets.any():
        return mesh
    sheet, count = mesh.faces[sheets], len(mesh.vertices)
    doubled, normals = mesh.face_normals()[sheets], np.zeros_like(mesh.vertices)
    for i in range(3):
        np.add.at(normals, sheet[:, i], doubled)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    face, edge = np.nonzero(open_edge & sheets[:, None])
    a, b = mesh.faces[face, edge], mesh.faces[face, (edge + 1) % 3]
    rim = [np.stack([b, a, a + count], 1), np.stack([b, a + count, b + count], 1)]
    half = 0.5 * thickness_m * normals
    return TriangleMesh(
        np.concatenate([mesh.vertices + half, mesh.vertices - half]),
        np.ascontiguousarray(np.concatenate([mesh.faces, sheet[:, ::-1] + count, *rim]), dtype=np.int32),
    )


def _nearly_closed(mesh: TriangleMesh, piece: NDArray[np.int64], open_edge: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (m,) for each number of a piece whether lids on its openings would be at most MOST_OPEN of its own area.

    Args:
        mesh: all pieces.
        piece: (m,) the piece of each face.
        open_edge: (m, 3) edges of one face only.
    """
    face, edge = np.nonzero(open_edge)
    start, end = mesh.faces[face, edge], mesh.faces[face, (edge + 1) % 3]
    # The edges of each opening end in each other: their lowest corner numbers the opening.
    opening = connected(len(mesh.vertices), start, end)
    lids, owner = np.zeros_like(mesh.vertices), np.zeros(len(mesh.vertices), np.int64)
    middle = mesh.vertices.mean(axis=0)
    np.add.at(lids, opening[start], np.cross(mesh.vertices[start] - middle, mesh.vertices[end] - middle))
    owner[opening[start]] = piece[face]
    count = len(mesh.faces)
    lacking = np.bincount(owner, np.linalg.norm(lids, axis=1), minlength=count)
    area = np.bincount(piece, np.linalg.norm(mesh.face_normals(), axis=1), minlength=count)
    return np.asarray(lacking <= MOST_OPEN * area)


def _with_outside_out(mesh: TriangleMesh) -> TriangleMesh:
    """Turn round each piece that is inside out, but for sheets, which have no inside."""
    edges = Edges.of(mesh.faces)
    piece, faces = pieces_of(edges), mesh.faces.copy()
    for number in np.unique(piece[_nearly_closed(mesh, piece, edges.other < 0)[piece]]):
        own = piece == number
        corners = mesh.vertices[mesh.faces[own]]
        a, b, c = (corners[:, i] - corners.mean(axis=(0, 1)) for i in range(3))
        if float(np.einsum("mc,mc->", a, np.cross(b, c))) < 0.0:
            faces[own] = faces[own][:, ::-1]
    return TriangleMesh(mesh.vertices, np.ascontiguousarray(faces))


def _with_holes_closed(mesh: TriangleMesh, largest: int) -> TriangleMesh:
    """Close each ring of up to ``largest`` open edges by a fan; larger holes stay open."""
    face, edge = np.nonzero(Edges.of(mesh.faces).other < 0)
    start, end = mesh.faces[face, edge].tolist(), mesh.faces[face, (edge + 1) % 3].tolist()
    onwards = dict(zip(start, end, strict=True))
    lids: list[tuple[int, int, int]] = []
    while onwards:
        ring = [next(iter(onwards))]
        while (after := onwards.pop(ring[-1], None)) is not None and after != ring[0]:
            ring.append(after)
        if after is not None and 3 <= len(ring) <= largest:
            lids += [(ring[0], ring[i + 1], ring[i]) for i in range(1, len(ring) - 1)]
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, np.array(lids, np.int32).reshape(-1, 3)]))
