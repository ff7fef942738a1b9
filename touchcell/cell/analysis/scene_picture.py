"""A cell in three dimensions with matplotlib, from its scene description. Imported only when a picture is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from touchcell.cell.scene.description import WORKSPACE_COLOUR, Part, SceneDescription
from touchcell.geometry.solids import Polyline, triangulated
from touchcell.geometry.types import Array

_LIGHT = np.array([0.4, -0.5, 0.77])
_AMBIENT = 0.55
_ROUND = 16


class ScenePicture:
    """Draws a scene into 3-D axes, again for each moment.

    Args:
        axis: of matplotlib, with ``projection="3d"``.
        scene: what is drawn; workspaces are left out.
        poses: poses of the frames in the world, (n, 4, 4) over time or (1, 4, 4), by frame.
        low_m, high_m: (3,) corners of what is shown.
    """

    def __init__(
        self, axis: Any, scene: SceneDescription, poses: Mapping[str, Array], low_m: Array, high_m: Array
    ) -> None:
        self._axis = axis
        self._poses = poses
        parts = [part for part in scene.parts if part.frame in poses and part.colour != WORKSPACE_COLOUR]
        self._solids = [
            (part, triangulated(part.solid, _ROUND)) for part in parts if not isinstance(part.solid, Polyline)
        ]
        self._lines = [part for part in parts if isinstance(part.solid, Polyline)]
        self._drawn: list[Any] = []
        axis.set_xlim(low_m[0], high_m[0])
        axis.set_ylim(low_m[1], high_m[1])
        axis.set_zlim(low_m[2], high_m[2])
        axis.set_box_aspect(high_m - low_m, zoom=1.35)
        axis.set_axis_off()
        axis.computed_zorder = False

    def show(self, moment: int) -> None:
        """Draw the scene at one moment, in place of what was drawn before."""
        while self._drawn:
            self._drawn.pop().remove()
        # What everything stands on comes first: large triangles cannot be sorted among small ones.
        for ground in (True, False):
            corners, colours = self._triangles(moment, ground)
            if len(corners):
                order = 0 if ground else 2
                collection = Poly3DCollection(
                    corners, facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=order, clip_on=False
                )
                self._drawn.append(self._axis.add_collection3d(collection))
        for part in self._lines:
            assert isinstance(part.solid, Polyline)
            points = _moved(part.solid.points_m, self._T(part, moment))
            line = Line3DCollection([points], colors=[part.colour], linewidths=1.6, zorder=1, clip_on=False)
            self._drawn.append(self._axis.add_collection3d(line))

    def _triangles(self, moment: int, ground: bool) -> tuple[Array, Array]:
        corners, colours = [], []
        for part, mesh in self._solids:
            if part.frame.startswith("surfaces/") != ground:
                continue
            found = _moved(mesh.vertices_m, self._T(part, moment))[mesh.triangles]
            normals = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            lit = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ _LIGHT, 0.0, 1.0)
            corners.append(found)
            colours.append(
                np.column_stack([lit[:, None] * np.array(part.colour[:3]), np.full(len(lit), part.colour[3])])
            )
        if not corners:
            return np.empty((0, 3, 3)), np.empty((0, 4))
        return np.concatenate(corners), np.concatenate(colours)

    def _T(self, part: Part, moment: int) -> Array:  # noqa: N802  the pose's own name
        along = self._poses[part.frame]
        pose: Array = along[min(moment, len(along) - 1)] @ part.T_frame_solid
        return pose


def _moved(points: Array, T: Array) -> Array:
    moved: Array = points @ T[:3, :3].T + T[:3, 3]
    return moved
