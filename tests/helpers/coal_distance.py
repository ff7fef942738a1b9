"""Capsules and boxes of the clearance interlock as bodies of coal, which judges their distances. Needs coal."""

from __future__ import annotations

from typing import Any

import numpy as np

from touchcell.control.interlocks.collision import Box, Capsule
from touchcell.geometry.types import Array

Body = tuple[Any, Any]
"""Shape and place, as coal takes them."""


def capsule_body(capsule: Capsule, T_world_frames: Array) -> Body:
    """Return a capsule of an arm whose frames are at (f, 4, 4)."""
    import coal

    a, b = (
        T[:3, :3] @ end + T[:3, 3] for T, end in zip(T_world_frames[list(capsule.frames)], capsule.ends_m, strict=True)
    )
    length = float(np.linalg.norm(b - a))
    x, y = np.linalg.svd((b - a)[None])[2][1:]
    T_world_capsule = np.eye(4)
    T_world_capsule[:3, :3], T_world_capsule[:3, 3] = np.column_stack([x, y, np.cross(x, y)]), 0.5 * (a + b)
    return coal.Capsule(capsule.radius_m, length), _placed(T_world_capsule)


def box_body(box: Box) -> Body:
    """Return a box."""
    import coal

    return coal.Box(*(2.0 * box.half_m)), _placed(box.T_world_box)


def _placed(T: Array) -> Any:
    import coal

    place = coal.Transform3s()
    place.setRotation(T[:3, :3])
    place.setTranslation(T[:3, 3])
    return place
