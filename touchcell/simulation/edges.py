"""The edge under a tip: its frame {e}, from the creases and borders of a scene's surfaces."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol, runtime_checkable

import numpy as np

from touchcell.geometry.types import Array
from touchcell.geometry.vectors import cross
from touchcell.simulation.meshes.creases import EdgePoint, Polylines
from touchcell.simulation.surfaces import Surface

_AT_A_CORNER_M: Final = 0.2e-3


@runtime_checkable
class HasEdges(Protocol):
    """A shape with creases or borders."""

    @property
    def edges(self) -> Polylines:
        """Its creases and borders, in its own frame."""
        ...


def nearest_edge(surfaces: Iterable[Surface], T_world_s: Array, t_s: float, tip_radius_m: float) -> Array | None:
    """Return T_world_e (4, 4) of the edge nearest to the apex of a tip; None where there is none.

    {e} has z along the inward normal of that face of the edge which the sensor's axis is nearer to, x away from that
    face across the edge, and its origin one tip radius outside the edge. Beyond a corner of an outline x leads along
    the line through corner and tip, so that {e} turns steadily while the tip goes round.
    """
    nearest, best = np.inf, None
    for surface in surfaces:
        if not isinstance(surface.shape, HasEdges) or not len(surface.shape.edges):
            continue
        T_world_b = surface.motion.pose(t_s)
        R_world_b = T_world_b[:3, :3]
        axis = R_world_b.T @ T_world_s[:3, 2]
        apex = R_world_b.T @ (T_world_s[:3, 3] - T_world_b[:3, 3]) + tip_radius_m * axis
        found = surface.shape.edges.nearest(apex, -axis)
        away = float(np.linalg.norm(apex - found.point))
        if away < nearest:
            nearest = away
            T_b_e = _frame(found, apex, axis, tip_radius_m)
            best = T_world_b @ T_b_e
    return best


def _frame(found: EdgePoint, apex: Array, axis: Array, tip_radius_m: float) -> Array:
    over = int(found.normals[1] @ axis < found.normals[0] @ axis)
    normal = found.normals[over]
    # Faces lie to the left of their own edges; the second face has the edge the other way round.
    out = cross(found.tangent, normal) * (1.0 if over == 0 else -1.0)
    if found.outwards is not None:
        off = apex - found.point
        off = off - float(off @ normal) * normal
        length = float(np.linalg.norm(off))
        if length > _AT_A_CORNER_M:
            out = off / length * (1.0 if off @ found.outwards >= 0.0 else -1.0)
    out = out / np.linalg.norm(out)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = out, cross(-normal, out), -normal
    T[:3, 3] = found.point + tip_radius_m * normal
    return T
