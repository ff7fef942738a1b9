"""Distances between bodies: capsules on arms against each other and against boxes. Pure geometry, no state.

A capsule is the set of points within a radius of a segment. Its two ends may be fixed to different frames of an arm:
one from the shoulder to the tool stands for all links between, for an arm that reports only its tool pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchcell import compiled
from touchcell.geometry.types import Array

BASE = 0
TOOL = -1
"""Frames of an arm: its base, its links from 1 on if it reports joint angles, and last its tool."""
_LINKS_APART = 4
"""Neighbouring links always touch, and those around a wrist nearly so: their joint limits keep them apart."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """Capsule-shaped part of an arm.

    Attributes:
        name: name in messages.
        frames: indices of the arm's frames to which its two ends are fixed.
        ends_m: (3,) of each, in its frame.
        radius_m: around the segment between them.
    """

    name: str
    frames: tuple[int, int]
    ends_m: tuple[tuple[float, float, float], tuple[float, float, float]]
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Static box, for example a table.

    Attributes:
        name: name in messages.
        T_world_box: pose (4, 4) of its centre.
        half_m: (3,) half of its sides.
    """

    name: str
    T_world_box: Array
    half_m: Array


@dataclass(frozen=True, slots=True)
class Pair:
    """Two bodies whose distance is checked: the capsule and its arm, and the other body."""

    arm: str
    part: str
    other_arm: str | None
    other: str


class Clearances:
    """Distances of all checked pairs: between the capsules of some arms, and from them to some boxes.

    Capsules of one arm are checked against each other where their links are at least four apart; those fixed to a base
    at both ends are not checked against boxes, as neither moves.

    Args:
        bodies: capsules of each arm, by its role.
        frame_counts: number of frames of each arm.
        boxes: static obstacles.

    Attributes:
        pairs: the pair that each entry of ``distances`` belongs to, in order.
    """

    def __init__(
        self, bodies: dict[str, Sequence[Capsule]], frame_counts: dict[str, int], boxes: Sequence[Box]
    ) -> None:
        capsules: list[tuple[str, Capsule, tuple[int, int]]] = []
        first: dict[str, int] = {}
        total = 0
        for arm, parts in bodies.items():
            first[arm] = total
            count = frame_counts[arm]
            capsules += [(arm, part, (part.frames[0] % count, part.frames[1] % count)) for part in parts]
            total += count
        of_arms = [
            (i, j)
            for i, (arm, _, frames) in enumerate(capsules)
            for j, (other, _, other_frames) in enumerate(capsules[:i])
            if arm != other or _links_between(frames, other_frames) >= _LINKS_APART
        ]
        of_boxes = [(i, k) for i, (_, _, frames) in enumerate(capsules) if any(frames) for k in range(len(boxes))]
        self.pairs = tuple(
            Pair(capsules[i][0], capsules[i][1].name, capsules[j][0], capsules[j][1].name) for i, j in of_arms
        ) + tuple(Pair(capsules[i][0], capsules[i][1].name, None, boxes[k].name) for i, k in of_boxes)
        of_ends = [[first[arm] + frame for frame in frames] for arm, _, frames in capsules]
        ends = [[*part.ends_m] for _, part, _ in capsules]
        radius = np.array([part.radius_m for _, part, _ in capsules])
        arms, obstacles = _transposed(of_arms), _transposed(of_boxes)
        poses = np.array([box.T_world_box for box in boxes], dtype=np.float64).reshape(-1, 4, 4)
        half = np.array([box.half_m for box in boxes], dtype=np.float64).reshape(-1, 3)
        # In the order in which the compiled function takes them.
        self._about = (
            _transposed(of_ends),
            np.array(ends, dtype=np.float64).reshape(-1, 2, 3).transpose(1, 0, 2).copy(),
            arms,
            obstacles,
            np.concatenate([radius[arms].sum(axis=0), radius[obstacles[0]]]),
            poses[obstacles[1]],
            half[obstacles[1]],
        )
        self._compiled = compiled.unless_plain("touchcell.control.interlocks._distances")

    def distances(self, T_world_frames: Array) -> Array:
        """Return (p,) distances in m of all pairs; negative where they overlap, by at most a capsule's radius.

        Args:
            T_world_frames: (f, 4, 4) all frames of all arms, in the order of ``bodies``.
        """
        if self._compiled is not None:
            found: Array = self._compiled.clearances(
                np.ascontiguousarray(T_world_frames, dtype=np.float64), *self._about
            )
            return found
        frames, ends, of_arms, of_boxes, radii, T_box, half = self._about
        T = T_world_frames[frames]
        tail, head = np.einsum("ecij,ecj->eci", T[:, :, :3, :3], ends) + T[:, :, :3, 3]
        i, j = of_arms
        k = of_boxes[0]
        apart = np.empty(len(self.pairs))
        if i.size:
            apart[: i.size] = segment_distances(tail[i], head[i], tail[j], head[j])
        if k.size:
            apart[i.size :] = segment_box_distances(tail[k], head[k], T_box, half)
        clear: Array = apart - radii
        return clear


def _transposed(pairs: Sequence[Sequence[int]]) -> NDArray[np.intp]:
    return np.array(pairs, dtype=np.intp).reshape(-1, 2).T.copy()


def _links_between(frames: tuple[int, int], other: tuple[int, int]) -> int:
    return max(min(frames) - max(other), min(other) - max(frames))


def segment_distances(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Return (n,) distances between segments a0-a1 and b0-b1, each (n, 3); either may be a point.

    The point on one line that is nearest to the other is clamped to its segment, then the point nearest to it on the
    other segment is found, and the one nearest to that on the first (Ericson 2005, Real-Time Collision Detection).
    For nearly parallel segments of a metre the distance may come out 2 um too long.
    """
    sides = np.stack((a1 - a0, b1 - b0, a0 - b0), axis=1)
    products = np.matmul(sides, sides.transpose(0, 2, 1))
    uu, uv, uw, vv, vw = (products[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    slant = uu * vv - uv * uv
    # Along parallel lines all points are equally near.
    s = np.where(slant > 1e-12 * uu * vv, uv * vw - vv * uw, 0.0) / np.maximum(slant, _TINY)
    s = np.minimum(np.maximum(s, 0.0), 1.0)
    t = np.minimum(np.maximum((uv * s + vw) / np.maximum(vv, _TINY), 0.0), 1.0)
    s = np.minimum(np.maximum((uv * t - uw) / np.maximum(uu, _TINY), 0.0), 1.0)
    gap = sides[:, 2] + s[:, None] * sides[:, 0] - t[:, None] * sides[:, 1]
    distances: Array = np.sqrt(_dot(gap, gap))
    return distances


def segment_box_distances(a0: Array, a1: Array, T_world_box: Array, half_m: Array) -> Array:
    """Return (n,) distances between segments a0-a1 (n, 3) and solid boxes; 0 where they meet.

    The boxes are at (n, 4, 4) with half sides (n, 3). Along the segment the squared distance is convex and made of
    parabolas that join where a face's plane is crossed; so its slope at those points brackets its zero.
    """
    R, origin = T_world_box[:, :3, :3], T_world_box[:, :3, 3]
    p = np.einsum("nij,ni->nj", R, a0 - origin)
    d = np.einsum("nij,ni->nj", R, a1 - a0)
    safe = np.where(np.abs(d) > _TINY, d, 1.0)
    at = np.zeros((len(p), 8))
    at[:, 1:4] = (half_m - p) / safe
    at[:, 4:7] = (-half_m - p) / safe
    at[:, 7] = 1.0
    np.clip(at, 0.0, 1.0, out=at)
    at.sort(axis=1)
    point = p[:, None, :] + at[:, :, None] * d[:, None, :]
    outside = point - np.clip(point, -half_m[:, None, :], half_m[:, None, :])
    slope = np.einsum("nki,ni->nk", outside, d)
    rising = np.argmax(slope >= 0.0, axis=1)
    rows = np.arange(len(p))
    # Slope negative everywhere: the end is nearest. Positive from the start: the start is.
    rising = np.where(slope[:, -1] < 0.0, 7, rising)
    before = np.maximum(rising - 1, 0)
    low, high = slope[rows, before], slope[rows, rising]
    change = high - low
    share = np.where(change > 0.0, np.clip(-low / np.where(change > 0.0, change, 1.0), 0.0, 1.0), 0.0)
    best = at[rows, before] + share * (at[rows, rising] - at[rows, before])
    best = np.where(slope[:, -1] < 0.0, 1.0, best)
    point = p + best[:, None] * d
    off = point - np.clip(point, -half_m, half_m)
    distances: Array = np.sqrt(_dot(off, off))
    return distances


def _dot(a: Array, b: Array) -> Array:
    product: Array = np.einsum("ni,ni->n", a, b)
    return product


_TINY = 1e-30
