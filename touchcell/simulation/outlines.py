"""Outlines of solids, tips and surfaces seen from above and from the side, as flat polygons in mm."""

from __future__ import annotations

import math

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.shapes import Ball, Prism, Solid
from touchcell.simulation.surfaces import Surface

View = tuple[int, int]
ABOVE: View = (0, 1)
SIDE: View = (0, 2)

# Behind the hemisphere a TacTip has a body of about the same width.
_BODY_LENGTH_M = 0.045
_CIRCLE = np.linspace(0.0, 2.0 * math.pi, 49)


def solid_outlines_mm(solid: Solid, T_world_object: Array, view: View) -> list[Array]:
    """Return closed outlines (n, 2) of a solid's convex parts, in two of the world's axes."""
    return [_hull_mm(_moved(points, T_world_object), view) for points in _parts(solid)]


def tip_outlines_mm(T_world_s: Array, radius_m: float, view: View) -> list[Array]:
    """Return closed outlines of a tip: the body behind it, and its hemisphere as a ball."""
    circle = np.zeros((len(_CIRCLE), 3))
    circle[:, list(view)] = radius_m * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    rim = radius_m * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE), np.zeros_like(_CIRCLE)])
    body = np.concatenate([0.92 * rim, 0.92 * rim - np.array([0.0, 0.0, _BODY_LENGTH_M])])
    return [_hull_mm(_moved(body, T_world_s), view), _hull_mm(circle + T_world_s[:3, 3], view)]


def height_mm(surface: Surface, x_m: Array, y_m: Array | float, t_s: float) -> Array:
    """Return the height (n,) of a surface over points (``x_m``, ``y_m``), seen from above."""
    heights = []
    for x, y in np.broadcast(x_m, y_m):
        point = np.array([x, y, 1.0])
        # Sphere tracing: step down by the free distance until it is zero.
        for _ in range(200):
            gap = surface.nearest(point, t_s).distance_m
            point[2] -= gap
            if abs(gap) < 1e-5:
                break
        heights.append(1e3 * point[2])
    return np.array(heights)


def _parts(solid: Solid) -> list[Array]:
    if isinstance(solid, Prism):
        bottom = np.column_stack([solid.outline_m, np.zeros(len(solid.outline_m))])
        return [np.concatenate([bottom, bottom + np.array([0.0, 0.0, solid.height_m])])]
    if isinstance(solid, Ball):
        # Three great circles: close enough to the round outline from any side.
        circle = solid.radius_m * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE), np.zeros_like(_CIRCLE)])
        return [np.concatenate([circle, circle[:, [2, 0, 1]], circle[:, [1, 2, 0]]])]
    parts, z = [], 0.0
    for height, radius in solid.sections_m:
        rim = radius * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE), np.zeros_like(_CIRCLE)])
        parts.append(np.concatenate([rim + np.array([0, 0, z]), rim + np.array([0, 0, z + height])]))
        z += height
    return parts


def _moved(points: Array, T: Array) -> Array:
    moved: Array = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _hull_mm(points: Array, view: View) -> Array:
    import cv2

    flat = (1e3 * points[:, list(view)]).astype(np.float32)
    hull = cv2.convexHull(flat)[:, 0].astype(np.float64)
    return np.concatenate([hull, hull[:1]])
