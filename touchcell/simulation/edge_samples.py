"""Random contacts of randomised simulated sensors with edges: Algorithm 1 of the paper, generalised.

For each sample the tip is tilted, turned and offset against the rim of a random part, pressed in and sheared. The
label is the pose of the sensor in the edge frame {e} (``touchcell.simulation.edges``), whose origin glides along the
edge with the tip: its y is zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.geometry.vectors import cross
from touchcell.simulation.contact import ContactLaw, about_z
from touchcell.simulation.edge_ways import contacts_on_way
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.pressed import felt_when_pressed
from touchcell.simulation.random_parts import random_part
from touchcell.simulation.samples import SampledContact, Variation, scattered
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import SkinContact, Tip, TipParameters, mirrored

_IMAGES_PER_TIP: Final = 64
_CREASE_RAD: Final = math.radians(30.0)
_SPREADS: Final = np.array([0.0, 0.2, 0.07])
"""Of the ranges, by which a third of the contacts each is scattered about the middle; zero for evenly."""
_NEAR_CORNER: Final = 0.35
_PAST_CORNER: Final = 0.3
_PAST_MM: Final = (-3.0, 6.0)
_PAST_MEAN: Final = (0.0, 0.0, 3.0, 0.0, 0.0)
_PAST_SPREAD: Final = (1.2, 0.0, 0.7, 3.0, 3.0)
"""Offset, way along the edge, depth and both tilts, mm and deg, of a tip that glides past a corner."""
_CORNER_RAD: Final = math.radians(15.0)
_RIM_RAD: Final = math.radians(50.0)
_SAME_M: Final = 1e-9
_BESIDE_CORNER_M: Final = 14e-3
"""As far as a tip at a side feels the next one."""
_ON_WAYS: Final = 0.7
"""Of the parts, along which the tip glides as a controller does, rather than being put down anywhere."""
_BEFORE_CORNER: Final = 0.8
_BEFORE_M: Final = 15e-3
_WAY_FRAMES: Final = 60
_ALONG: Final = 0.5
_ALONG_MM: Final = 0.1
"""Along the edge nothing is felt: a label within a tenth of a millimetre keeps its scale from being zero."""


@dataclass(frozen=True, slots=True)
class EdgeRanges:
    """From where contacts are drawn: evenly, about the middle, and close to it, where a controller holds them.

    Attributes:
        offset_mm: of the tip across the edge, to either side.
        depth_mm: smallest and largest.
        tilt_deg: largest about either axis.
        turn_deg: largest about the normal.
        shear_mm: the longest way that the tip is dragged, in any direction or, for half of them, along the edge
            alone. It is longer than the skin holds: a tip that follows an edge always slips.
        torsion_deg: the largest turn about the normal on that way, likewise: along a bend the skin is always twisted.
    """

    offset_mm: float = 8.0
    depth_mm: tuple[float, float] = (0.2, 7.0)
    tilt_deg: float = 25.0
    turn_deg: float = 78.0
    shear_mm: float = 6.0
    torsion_deg: float = 8.0

    def drawn(self, rng: np.random.Generator) -> Array:
        """Return a random contact (6,) mm and deg."""
        low, high = self.depth_mm
        most = np.array([self.offset_mm, 0.5 * (high - low), self.tilt_deg, self.tilt_deg, self.turn_deg])
        # One spread for all five, or each its own: far off in one alone is what a controller mostly sees.
        spread = rng.integers(len(_SPREADS), size=5) if rng.random() < 0.5 else rng.integers(len(_SPREADS))
        sigma = np.broadcast_to(_SPREADS[spread], 5)
        near = np.clip(sigma * rng.normal(size=5), -1.0, 1.0)
        offset, depth, alpha, beta, turn = np.where(sigma > 0.0, near, rng.uniform(-1.0, 1.0, 5)) * most
        return np.array([offset, 0.0, depth + 0.5 * (low + high), alpha, beta, turn])

    def holds(self, contact_mm_deg: Array) -> bool:
        """Return True if a contact (6,) is within."""
        offset, _, depth, alpha, beta, turn = np.abs(contact_mm_deg)
        low, high = self.depth_mm
        return bool(
            offset <= self.offset_mm
            and low <= depth <= high
            and max(alpha, beta) <= 1.3 * self.tilt_deg
            and turn <= 1.2 * self.turn_deg
        )


def edge_contacts(
    n: int,
    seed: int,
    *,
    ranges: EdgeRanges | None = None,
    variation: Variation | None = None,
    part: Callable[[np.random.Generator], TriangleMesh] = random_part,
) -> Iterator[SampledContact]:
    """Yield ``n`` random contacts with edges, the same for the same seed; ``part`` draws what is touched.

    Every other one is its predecessor in a mirror, seen by the same tip: what a mirrored part would give is as likely,
    and costs a tenth. The markers are another set of numbers, as the lattice is no mirror image of itself.
    """
    ranges, variation, law = ranges or EdgeRanges(), variation or Variation(), ContactLaw()
    for start in range(0, n, _IMAGES_PER_TIP):
        # Of its own for each part: a longer draw begins with the shorter one.
        rng = np.random.default_rng([seed, start])
        tip = Tip(scattered(TipParameters(), variation, rng))
        shape = shape_with_rim(part, rng)
        made = _on_ways if rng.random() < _ON_WAYS else _anywhere
        both = _and_mirrored(made(shape, tip, ranges, law, rng))
        for T_e_s, felt in islice(both, min(_IMAGES_PER_TIP, n - start)):
            pixels = tip.pixels(felt.T_f_s, felt.relief)
            pixels += rng.normal(0.0, variation.marker_px, pixels.shape)
            seen = rng.random(len(pixels)) >= variation.missing
            radius = tip.parameters.disc_radius_px * (1.0 + rng.normal(0.0, variation.disc_radius))
            yield SampledContact(T_e_s, pixels, seen, float(radius))


def shape_with_rim(part: Callable[[np.random.Generator], TriangleMesh], rng: np.random.Generator) -> MeshShape:
    """Return a drawn part with a rim: of one that is nearly flat at its edge the next is drawn in its place."""
    while True:
        shape = MeshShape(part(rng), _CREASE_RAD)
        if len(_corners(shape)[0]):
            return shape


def _and_mirrored(drawn: Iterator[tuple[Array, SkinContact]]) -> Iterator[tuple[Array, SkinContact]]:
    for T_e_s, felt in drawn:
        yield T_e_s, felt
        yield mirrored(T_e_s), felt.mirrored()


def _on_ways(
    shape: MeshShape, tip: Tip, ranges: EdgeRanges, law: ContactLaw, rng: np.random.Generator
) -> Iterator[tuple[Array, SkinContact]]:
    """Yield T_e_s (4, 4) and what the skin feels, of contacts within the ranges, on ways along the rim."""
    surface = Surface(shape)
    while True:
        T_world_e = frame_on_rim(
            shape, surface, law.tip_radius_m, rng, at_corners=_BEFORE_CORNER, beside_corner_m=_BEFORE_M
        )
        for label, felt in contacts_on_way(surface, tip, law, T_world_e, rng, _WAY_FRAMES):
            if not ranges.holds(label):
                break
            yield _labelled(label, rng), felt


def _anywhere(
    shape: MeshShape, tip: Tip, ranges: EdgeRanges, law: ContactLaw, rng: np.random.Generator
) -> Iterator[tuple[Array, SkinContact]]:
    """Yield T_e_s (4, 4) and what the skin feels, of contacts within the ranges, each by itself."""
    surface, radius_m = Surface(shape), law.tip_radius_m
    while True:
        past = _past_corner(shape, surface, radius_m, rng) if rng.random() < _PAST_CORNER else None
        if past is None:
            T_world_e = frame_on_rim(shape, surface, radius_m, rng)
            T_world_s = se3.compose(T_world_e, se3.from_euler_mm_deg(ranges.drawn(rng)))
        else:
            T_world_e, T_world_s = past
        # Beside corners and on bends the edge that the tip feels is not the one that it was placed at.
        nearest = nearest_edge([surface], T_world_s, 0.0, radius_m)
        assert nearest is not None
        label = se3.to_euler_mm_deg(se3.compose(se3.inverse(nearest), T_world_s))
        if not ranges.holds(label):
            continue
        T_start = dragged_to(T_world_e, T_world_s, ranges, rng)
        state, felt = felt_when_pressed(surface, tip, law, T_start, T_world_s)
        if not state.in_contact:
            continue
        yield _labelled(label, rng), felt


def _labelled(label_mm_deg: Array, rng: np.random.Generator) -> Array:
    label = label_mm_deg.copy()
    label[1] = rng.uniform(-_ALONG_MM, _ALONG_MM)
    return se3.from_euler_mm_deg(label)


def frame_on_rim(
    shape: MeshShape,
    surface: Surface,
    radius_m: float,
    rng: np.random.Generator,
    *,
    at_corners: float = _NEAR_CORNER,
    beside_corner_m: float = _BESIDE_CORNER_M,
) -> Array:
    """Return the frame {e} (4, 4) of a random point of the rim.

    With a probability of ``at_corners`` it is within ``beside_corner_m`` of a corner, where the part has one.
    """
    edges = shape.edges
    upper, corners = _corners(shape)
    if rng.random() < at_corners and len(corners):
        middles = 0.5 * (edges.starts[upper] + edges.ends[upper])
        corner = edges.ends[rng.choice(corners)]
        beside = upper[np.linalg.norm(middles - corner, axis=1) < beside_corner_m]
        upper = beside if len(beside) else corners
    return _frame_at(shape, surface, radius_m, int(rng.choice(upper)), float(rng.random()))


def _past_corner(
    shape: MeshShape, surface: Surface, radius_m: float, rng: np.random.Generator
) -> tuple[Array, Array] | None:
    """Return T_world_e (4, 4) beside a random corner and T_world_s (4, 4) of a tip that glides past it, or turns there.

    None for a part without corners. So does a controller: a corner is felt when the tip is beyond it.
    """
    upper, corners = _corners(shape)
    if not len(corners):
        return None
    before = int(rng.choice(corners))
    after = int(upper[(int(np.searchsorted(upper, before)) + 1) % len(upper)])
    onwards = rng.random() < 0.5
    T_world_e = _frame_at(shape, surface, radius_m, *((before, 0.999) if onwards else (after, 0.001)))
    edges = shape.edges
    side = edges.ends[before] - edges.starts[before] if onwards else edges.starts[after] - edges.ends[after]
    way = T_world_e[:3, 1] * np.sign(T_world_e[:3, 1] @ side)
    T_world_a = T_world_e.copy()
    T_world_a[:3, 3] += 1e-3 * rng.uniform(*_PAST_MM) * way
    turn = rng.uniform(-90.0, 90.0) if rng.random() < 0.6 else rng.normal(0.0, 8.0)
    scattered_mm_deg = rng.normal(_PAST_MEAN, _PAST_SPREAD)
    return T_world_e, se3.compose(T_world_a, se3.from_euler_mm_deg(np.append(scattered_mm_deg, turn)))


def _corners(shape: MeshShape) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pieces of the rims of a part, and those of them that end at a corner."""
    edges = shape.edges
    normals = edges.middle_normals
    # Where the mesh of a part ends, both normals are the same: no edge.
    sharp = np.einsum("kc,kc->k", normals[:, 0], normals[:, 1]) < math.cos(_CREASE_RAD)
    upper = np.flatnonzero(sharp & (normals[:, :, 2].max(axis=1) > math.cos(_RIM_RAD)))
    sides = edges.ends[upper] - edges.starts[upper]
    units = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    bends = np.einsum("kc,kc->k", units, np.roll(units, -1, axis=0))
    apart = np.linalg.norm(np.roll(edges.starts[upper], -1, axis=0) - edges.ends[upper], axis=1)
    return upper, upper[(np.abs(bends) < math.cos(_CORNER_RAD)) & (apart < _SAME_M)]


def _frame_at(shape: MeshShape, surface: Surface, radius_m: float, i: int, share: float) -> Array:
    edges = shape.edges
    point = edges.starts[i] + share * (edges.ends[i] - edges.starts[i])
    normal = edges.middle_normals[i, edges.middle_normals[i, :, 2].argmax()]
    T_world_s = np.eye(4)
    T_world_s[:3, :3] = _with_z(-normal)
    T_world_s[:3, 3] = point + radius_m * normal
    T_world_e = nearest_edge([surface], T_world_s, 0.0, radius_m)
    assert T_world_e is not None
    return T_world_e


def _with_z(z: Array) -> Array:
    x = cross(np.array([0.0, 1.0, 0.0]), z)
    x /= np.linalg.norm(x)
    return np.stack([x, cross(z, x), z], axis=1)


def dragged_to(T_world_e: Array, T_world_s: Array, ranges: EdgeRanges, rng: np.random.Generator) -> Array:
    """Return from where a contact is dragged to ``T_world_s`` along the face, and turned about its normal."""
    along = rng.random() < _ALONG
    angle = rng.choice([-0.5, 0.5]) * math.pi if along else rng.uniform(0.0, 2.0 * math.pi)
    length = 1e-3 * ranges.shear_mm * rng.random()
    torsion = math.radians(ranges.torsion_deg) * rng.uniform(-1.0, 1.0)
    R = T_world_e[:3, :3]
    T = T_world_s.copy()
    T[:3, :3] = R @ about_z(-torsion) @ R.T @ T_world_s[:3, :3]
    T[:3, 3] -= R @ np.array([length * math.cos(angle), length * math.sin(angle), 0.0])
    return T
