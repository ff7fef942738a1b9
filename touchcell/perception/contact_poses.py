"""Random contacts over the ranges of the public data (docs/glossary.md, "contact pose and shear")."""

from __future__ import annotations

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array

PUBLIC_DEPTH_MM = (0.5, 6.0)


def random_poses(
    n: int,
    rng: np.random.Generator,
    depth_mm: tuple[float, float] = PUBLIC_DEPTH_MM,
    *,
    tilt_deg: float = 25.0,
    shear_mm: float = 5.0,
    torsion_deg: float = 5.0,
) -> Array:
    """Draw (n, 4, 4) contacts T_f_s over the ranges of the public data, before any slip."""
    tilt, shear = _disc(n, tilt_deg, rng), _disc(n, shear_mm, rng)
    depth, gamma = rng.uniform(*depth_mm, n), rng.uniform(-torsion_deg, torsion_deg, n)
    return se3.from_euler_mm_deg(np.column_stack([shear, depth, tilt, gamma]))


def _disc(n: int, radius: float, rng: np.random.Generator) -> Array:
    """Draw (n, 2) points uniformly from a disc."""
    length, angle = radius * np.sqrt(rng.random(n)), rng.uniform(0.0, 2.0 * np.pi, n)
    return np.column_stack([length * np.cos(angle), length * np.sin(angle)])
