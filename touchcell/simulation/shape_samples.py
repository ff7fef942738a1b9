"""Random contacts of randomised simulated sensors with curved surfaces and ridges, by Algorithm 1 of the paper.

The paper presses on a plane. Here a fifth of the surfaces are planes, the others bend both ways, as far as a tip of
20 mm fits into them, or are waves, whose bend changes under the tip; a third of those have a ridge. The label is the
pose of the sensor in the surface frame {f} at the nearest point, as on a plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import random_poses
from touchcell.simulation.contact import ContactLaw, about_z
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.primitives import height_field
from touchcell.simulation.pressed import pressed
from touchcell.simulation.random_parts import random_waves
from touchcell.simulation.samples import SampledContact, Variation, scattered
from touchcell.simulation.surfaces import Plane, Surface
from touchcell.simulation.tip import Tip, TipParameters

_IMAGES_PER_TIP: Final = 32
_PLANES: Final = 0.2
_RIDGES: Final = 0.35
_WAVES: Final = 0.35
"""Of the bent surfaces, to which ridges come on top."""
_SPACING_M: Final = 1.5e-3
_POINTS: Final = 47
_HOLLOW_PER_M: Final = 1.0 / 0.028
_CONVEX_PER_M: Final = 1.0 / 0.025
_STEEPEST_RIDGE: Final = math.tan(math.radians(25.0))
_CREASE_RAD: Final = math.radians(10.0)
_ASIDE_M: Final = 8e-3
_FARTHEST_M: Final = 30e-3


def shape_contacts(
    n: int,
    seed: int,
    *,
    depth_mm: tuple[float, float],
    variation: Variation | None = None,
    tips: Callable[[np.random.Generator], TipParameters] | None = None,
) -> Iterator[SampledContact]:
    """Yield ``n`` random contacts with curved surfaces, the same for the same seed.

    Depth is uniform in ``depth_mm``, tilt in a 25 deg disc, shear up to 5 mm, torsion in +-5 deg; what the depth
    cannot hold slips, and the label is the remaining pose.

    Args:
        n: number of contacts.
        seed: seed of all randomness.
        depth_mm: smallest and largest depth.
        variation: amount of variation about a sensor.
        tips: draws the sensor; None for the default tip.
    """
    rng = np.random.default_rng(seed)
    variation, law = variation or Variation(), ContactLaw()
    for start in range(0, n, _IMAGES_PER_TIP):
        tip = Tip(scattered(TipParameters() if tips is None else tips(rng), variation, rng))
        surface = random_curved_surface(rng, ridges=_RIDGES)
        for _ in range(min(_IMAGES_PER_TIP, n - start)):
            T_f_s, pixels = _contact(surface, tip, law, depth_mm, rng)
            pixels = pixels + rng.normal(0.0, variation.marker_px, pixels.shape)
            seen = rng.random(len(pixels)) >= variation.missing
            radius = tip.parameters.disc_radius_px * (1.0 + rng.normal(0.0, variation.disc_radius))
            yield SampledContact(T_f_s, pixels, seen, float(radius))


def random_curved_surface(rng: np.random.Generator, *, ridges: float = 0.0) -> Surface:
    """Return a plane, a surface that bends both ways, or waves.

    A share of ``ridges`` of those that are no plane has a ridge in its middle.
    """
    if rng.random() < _PLANES:
        return Surface(Plane())
    # Convex is negative: heights fall away from the middle.
    low, high = -_CONVEX_PER_M, _HOLLOW_PER_M
    curvature = rng.uniform(low, high, 2) * rng.random()
    turn, along_x = rng.uniform(0.0, math.pi), rng.random() < 0.5
    slope = rng.uniform(0.0, _STEEPEST_RIDGE) if rng.random() < ridges else 0.0
    side = (np.arange(_POINTS) - 0.5 * (_POINTS - 1)) * _SPACING_M
    x, y = np.meshgrid(side, side)
    u, v = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x
    heights = 0.5 * (curvature[0] * u * u + curvature[1] * v * v)
    if rng.random() < _WAVES:
        ways = turn + np.array([0.0, rng.uniform(0.25, 0.75) * math.pi])
        heights = random_waves(rng, ways)(np.stack([x, y], axis=2))
    # A ridge runs along rows or columns of the grid, so that it is as sharp as its edges.
    heights -= slope * np.abs(y if along_x else x)
    return Surface(MeshShape(height_field(heights, _SPACING_M), _CREASE_RAD))


def _contact(
    surface: Surface, tip: Tip, law: ContactLaw, depth_mm: tuple[float, float], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return T_f_s (4, 4) that remains, and pixels (markers, 2)."""
    while True:
        T_f_s = random_poses(1, rng, depth_mm)[0]
        # Even in its length: what has just been pressed on is hardly sheared.
        T_f_s[:2, 3] *= math.sqrt(rng.random())
        x, y = rng.uniform(-_ASIDE_M, _ASIDE_M, 2)
        above = surface.nearest(np.array([x, y, 2.0 * law.tip_radius_m]), 0.0)
        # Convex places may be asked for from above alone: nearest points of far queries crowd on ridges.
        found = surface.nearest(above.point + 1e-4 * above.normal, 0.0)
        T_world_f = _frame(found.point + law.tip_radius_m * found.normal, found.normal, rng)
        T_world_s = se3.compose(T_world_f, T_f_s)
        sheared = np.eye(4)
        sheared[:2, 3] = T_f_s[:2, 3]
        T_start = se3.compose(T_world_f, se3.compose(se3.inverse(sheared), T_f_s))
        if np.abs(T_start[:2, 3]).max() > _FARTHEST_M:
            continue
        state, pixels = pressed(surface, tip, law, _unturned(T_start, T_world_f, T_f_s), T_world_s)
        if state.in_contact and abs(1e3 * state.T_f_s[2, 3]) <= depth_mm[1]:
            return state.T_f_s, pixels


def _unturned(T_start: Array, T_world_f: Array, T_f_s: Array) -> Array:
    """Return ``T_start`` without the torsion of ``T_f_s``, so that the way to the end twists the skin."""
    torsion = math.atan2(T_f_s[1, 0], T_f_s[0, 0])
    R = T_world_f[:3, :3]
    T = T_start.copy()
    T[:3, :3] = R @ about_z(-torsion) @ R.T @ T_start[:3, :3]
    return T


def _frame(origin: Array, normal: Array, rng: np.random.Generator) -> Array:
    """Return a frame (4, 4) with z against the outward ``normal`` (3,), turned about it at random."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    y = np.cross(-normal, [math.cos(angle), math.sin(angle), 0.0])
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = np.cross(y, -normal), y, -normal
    T[:3, 3] = origin
    return T
