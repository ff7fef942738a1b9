"""Random contacts with what a tip can touch: nothing, surfaces, edges and corners, each with its class.

The class is that of the geometry under the tip: an edge where its apex is within 4 mm of one, a corner where it is
within 4 mm of a point at which an edge turns by more than 40 deg, a surface where no edge is within 9 mm. What lies
between is no class, and is not drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import CLASSES
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.edge_samples import EdgeRanges, dragged_to, frame_on_rim, shape_with_rim
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.pressed import pressed
from touchcell.simulation.random_parts import random_part, steep_part
from touchcell.simulation.samples import Variation, scattered
from touchcell.simulation.shape_samples import random_curved_surface
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import Tip, TipParameters

_CONTACTS_PER_TIP: Final = 32
_STEEP: Final = 0.3
_ON_EDGE_M: Final = 4e-3
_AT_CORNER_M: Final = 4e-3
_OFF_CORNER_M: Final = 8e-3
_ON_SURFACE_M: Final = 9e-3
_FARTHEST_M: Final = 18e-3
_SHARPEST_BEND_COS: Final = math.cos(math.radians(40.0))
_RANGES: Final = EdgeRanges(depth_mm=(0.8, 6.0), turn_deg=180.0)
_MOST_TRIES: Final = 30


def feature_contacts(n: int, seed: int, *, variation: Variation | None = None) -> Iterator[tuple[int, Array]]:
    """Yield ``n`` pairs of an index of ``CLASSES`` and (markers, 2) px in the frame, the same for the same seed."""
    rng = np.random.default_rng(seed)
    variation, law = variation or Variation(), ContactLaw()
    for start in range(0, n, _CONTACTS_PER_TIP):
        tip = Tip(scattered(TipParameters(), variation, rng))
        part = shape_with_rim(steep_part if rng.random() < _STEEP else random_part, rng)
        surface, corners = Surface(part), _corners(part)
        smooth = random_curved_surface(rng)
        for _ in range(min(_CONTACTS_PER_TIP, n - start)):
            wanted = int(rng.integers(len(CLASSES)))
            made: Array | None = None
            if CLASSES[wanted] == "corner" and not len(corners):
                wanted = CLASSES.index("edge")
            if CLASSES[wanted] == "surface" and rng.random() < 0.5:
                made = _on_smooth(smooth, tip, law, rng)
            elif CLASSES[wanted] != "none":
                for _ in range(_MOST_TRIES):
                    made = _on_part(CLASSES[wanted], part, surface, corners, tip, law, rng)
                    if made is not None:
                        break
            if made is None:
                wanted, made = CLASSES.index("none"), tip.project(tip.rest_positions)
            yield wanted, made + rng.normal(0.0, variation.marker_px, made.shape)


def _corners(shape: MeshShape) -> Array:
    """Return (k, 3) m, where pieces of edges meet at more than 40 deg, or more than two of them."""
    edges = shape.edges
    units = (edges.ends - edges.starts) / np.linalg.norm(edges.ends - edges.starts, axis=1, keepdims=True)
    leaving: dict[tuple[float, ...], list[Array]] = {}
    for point, unit in (*zip(edges.starts, units, strict=True), *zip(edges.ends, -units, strict=True)):
        leaving.setdefault(tuple(point.round(9).tolist()), []).append(unit)
    found = [
        point
        for point, ways in leaving.items()
        # Two pieces that go straight on leave their point in opposite directions.
        if len(ways) > 2 or (len(ways) == 2 and -float(ways[0] @ ways[1]) < _SHARPEST_BEND_COS)
    ]
    return np.array(found).reshape(-1, 3)


def _on_part(
    wanted: str, part: MeshShape, surface: Surface, corners: Array, tip: Tip, law: ContactLaw, rng: np.random.Generator
) -> Array | None:
    """Return (markers, 2) px of a contact with a part, or None where what was drawn is of no or another class."""
    radius_m = law.tip_radius_m
    at_corners = 1.0 if wanted == "corner" else 0.0
    T_world_e = frame_on_rim(part, surface, radius_m, rng, at_corners=at_corners, beside_corner_m=_AT_CORNER_M)
    contact = _RANGES.drawn(rng)
    if wanted == "surface":
        contact[0] = -1e3 * rng.uniform(_ON_SURFACE_M, _FARTHEST_M)
    elif wanted == "corner":
        contact[0] = rng.uniform(-4.0, 2.0)
    T_world_s = se3.compose(T_world_e, se3.from_euler_mm_deg(contact))
    felt = nearest_edge([surface], T_world_s, 0.0, radius_m)
    if felt is None:
        return None
    offset_m = float((se3.compose(se3.inverse(felt), T_world_s))[0, 3])
    apex = T_world_s[:3, 3] + radius_m * T_world_s[:3, 2]
    from_corner_m = float(np.linalg.norm(corners - apex, axis=1).min(initial=math.inf))
    is_it = {
        "surface": -offset_m >= _ON_SURFACE_M,
        "edge": abs(offset_m) <= _ON_EDGE_M and from_corner_m >= _OFF_CORNER_M,
        "corner": from_corner_m <= _AT_CORNER_M + 1e-3 * contact[2],
    }[wanted]
    if not is_it:
        return None
    T_start = dragged_to(T_world_e, T_world_s, _RANGES, rng)
    state, pixels = pressed(surface, tip, law, T_start, T_world_s)
    return pixels if state.in_contact and state.T_f_s[2, 3] >= 0.6e-3 else None


def _on_smooth(surface: Surface, tip: Tip, law: ContactLaw, rng: np.random.Generator) -> Array | None:
    x, y = rng.uniform(-8e-3, 8e-3, 2)
    found = surface.nearest(np.array([x, y, law.tip_radius_m]), 0.0)
    T_world_f = np.eye(4)
    z = -found.normal
    across = np.cross([0.0, 1.0, 0.0], z)
    across /= np.linalg.norm(across)
    T_world_f[:3, :3] = np.stack([across, np.cross(z, across), z], axis=1)
    T_world_f[:3, 3] = found.point + law.tip_radius_m * found.normal
    contact = _RANGES.drawn(rng)
    contact[0] = 0.0
    T_world_s = se3.compose(T_world_f, se3.from_euler_mm_deg(contact))
    state, pixels = pressed(surface, tip, law, dragged_to(T_world_f, T_world_s, _RANGES, rng), T_world_s)
    return pixels if state.in_contact and state.T_f_s[2, 3] >= 0.6e-3 else None
