"""Contact of a soft hemispherical tip with a rigid surface: depth, tilt, shear that sticks, and slip.

{s} has its origin at the centre of the tip's sphere and z out of the tip. {f} has z along the inward normal and
its origin one tip radius outside the surface, so that {f} = {s} at a normal contact of zero depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from touchcell.drivers.core.scene import ContactState
from touchcell.geometry.types import Array
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore

_Three: TypeAlias = tuple[float, float, float]
_Axes: TypeAlias = tuple[_Three, _Three, _Three]
"""Rows of a rotation matrix. On so few numbers NumPy's calls would take most of a step."""

_IDENTITY = np.eye(4)
_OPPOSITE = 1e-9


@dataclass(frozen=True, slots=True)
class ContactLaw:
    """Compliance and slip of a TacTip.

    Attributes:
        tip_radius_m: radius of the hemisphere.
        stiffness_n_m: normal force per depth.
        friction: tangential force per normal force with which the skin slips.
        slip_at_1mm_m: shear that survives at 1 mm depth, measured on public images.
        slip_exponent: growth of that shear with depth, measured on the same images.
        torsion_grip: fraction of the sticking shear by which the patch may rotate before it slips. The same images fit
            best with 0.08; 0.15 lets 5 deg stick from 4.5 mm on.
    """

    tip_radius_m: float = 0.020
    stiffness_n_m: float = 1500.0
    friction: float = 0.9
    slip_at_1mm_m: float = 0.34e-3
    slip_exponent: float = 1.83
    torsion_grip: float = 0.15

    def max_shear_m(self, depth_m: float) -> float:
        """Return the largest tangential displacement that sticks."""
        return self.slip_at_1mm_m * (1e3 * depth_m) ** self.slip_exponent if depth_m > 0.0 else 0.0

    def shear_stiffness_n_m(self, depth_m: float) -> float:
        """Return the tangential force per shear at a positive depth, so that shear and friction limits coincide."""
        return self.friction * self.stiffness_n_m * depth_m / self.max_shear_m(depth_m)

    def max_torsion_rad(self, depth_m: float) -> float:
        """Return the largest rotation about the normal that sticks.

        A uniformly pressed disc of radius a turns against its friction with the mean lever 2a/3; a is the radius of the
        sphere's cap at that depth. Skin there slips after ``torsion_grip`` of the displacement that it holds in pure
        shear. Gives 0.7 deg at 1 mm and 5.4 deg at 4.5 mm. The form is our own.
        """
        if depth_m <= 0.0:
            return 0.0
        disc_radius_m = math.sqrt(depth_m * max(2.0 * self.tip_radius_m - depth_m, self.tip_radius_m))
        return self.torsion_grip * self.max_shear_m(depth_m) / (2.0 / 3.0 * disc_radius_m)


@dataclass(slots=True)
class _Anchor:
    """Point where the skin sticks to the surface, in the surface's own frame, so that a moving surface drags it.

    Attributes:
        surface: the surface.
        point: (3,) m, on the surface.
        axes: of {f} at ``point``.
    """

    surface: Surface
    point: _Three
    axes: _Axes


@dataclass(slots=True)
class ContactModel:
    """One tip's contact over time.

    The shear is not integrated: while the skin sticks it is the vector from the anchor to the present nearest point, so
    nothing drifts. When it exceeds what the depth can hold, the anchor is dragged along the surface, its axes rotated
    with the normal by the smallest rotation (parallel transport). Shear and torsion are limited separately.
    """

    law: ContactLaw = field(default_factory=ContactLaw)
    _anchor: _Anchor | None = None

    def held_point(self, surface: Surface) -> Array | None:
        """Return (3,) m, the point where the skin sticks to ``surface``, in its own frame; None where it does not."""
        anchor = self._anchor
        return np.array(anchor.point) if anchor is not None and anchor.surface is surface else None

    def step(self, T_world_s: Array, surface: Surface, t_s: float) -> ContactState:
        """Advance the contact to time ``t_s`` with the sensor at ``T_world_s`` (4, 4)."""
        return self.advance(T_world_s, surface, t_s)()

    def advance(self, T_world_s: Array, surface: Surface, t_s: float) -> Callable[[], ContactState]:
        """Advance the contact as ``step`` does; return a function that computes its state on demand."""
        T_world_b = surface.motion.pose(t_s)
        R_world_b = T_world_b[:3, :3]
        R_b_s = R_world_b.T @ T_world_s[:3, :3]
        nearest = surface.shape.nearest(R_world_b.T @ (T_world_s[:3, 3] - T_world_b[:3, 3]))
        depth = self.law.tip_radius_m - nearest.distance_m
        inward = _three(-nearest.normal)
        tilt = _tilt_axes(*(-nearest.normal @ R_b_s).tolist())

        if depth <= 0.0:
            self._anchor = None
            R_tilt = np.array(tilt)
            R_b_f = R_b_s @ R_tilt.T
            return lambda: self._state(T_world_s, R_world_b @ R_b_f, R_tilt, (0.0, 0.0, depth), slipping=False)

        px, py, pz = point = _three(nearest.point)
        anchor = self._anchor
        if anchor is None or anchor.surface is not surface:
            anchor = self._anchor = _Anchor(surface, point, _rows(R_b_s @ np.array(tilt).T))
        axes = _transport(anchor.axes, inward)
        slipping = False

        ax, ay, az = anchor.point
        shear_x, shear_y = _along(axes, px - ax, py - ay, pz - az)
        length, longest = math.hypot(shear_x, shear_y), self.law.max_shear_m(depth)
        if length > longest:
            slipping = True
            share = longest / length
            shear_x, shear_y = shear_x * share, shear_y * share
            held = surface.shape.nearest(
                np.array([px + (ax - px) * share, py + (ay - py) * share, pz + (az - pz) * share])
            )
            anchor.point = _three(held.point)
            anchor.axes = _transport(anchor.axes, _three(-held.normal))
            axes = _transport(anchor.axes, inward)

        # The first column of the torsion, R_b_f.T @ R_b_s @ R_tilt.T.
        cos, sin = _along(axes, *(R_b_s @ tilt[0]).tolist())
        torsion = math.atan2(sin, cos)
        largest = self.law.max_torsion_rad(depth)
        if abs(torsion) > largest:
            slipping = True
            held_torsion = math.copysign(largest, torsion)
            anchor.axes = _turned(anchor.axes, torsion - held_torsion)
            axes = _turned(axes, torsion - held_torsion)
            torsion = held_torsion
        position = shear_x, shear_y, depth
        return lambda: self._state(
            T_world_s, R_world_b @ axes, about_z(torsion) @ np.array(tilt), position, slipping=slipping
        )

    def snapshot(self) -> Restore:
        """Return a function that restores the present contact."""
        held = self._anchor and replace(self._anchor)

        def restore() -> None:
            self._anchor = held and replace(held)

        return restore

    def _state(
        self, T_world_s: Array, R_world_f: Array, R_f_s: Array, position: tuple[float, float, float], *, slipping: bool
    ) -> ContactState:
        T_f_s = _IDENTITY.copy()
        T_f_s[:3, :3] = R_f_s
        T_f_s[:3, 3] = position
        T_world_f = _IDENTITY.copy()
        T_world_f[:3, :3] = R_world_f
        T_world_f[:3, 3] = T_world_s[:3, 3] - R_world_f @ T_f_s[:3, 3]
        depth = position[2]
        force = self.law.stiffness_n_m * max(depth, 0.0)
        return ContactState(T_f_s, T_world_f, in_contact=depth > 0.0, slipping=slipping, normal_force_n=force)


def contact_at(T_f_s: Array, law: ContactLaw) -> ContactState:
    """Return the contact of a tip pressed and then sheared to ``T_f_s`` (4, 4): {f} at the world's origin, shear and
    torsion clipped to what its depth holds. Equals the end of Algorithm 1 of the paper (data collection), without the
    path."""
    depth = float(T_f_s[2, 3])
    R_tilt = tilt_of(T_f_s[2, :3])
    R_gamma = T_f_s[:3, :3] @ R_tilt.T
    asked_torsion, asked_shear = math.atan2(R_gamma[1, 0], R_gamma[0, 0]), math.hypot(T_f_s[0, 3], T_f_s[1, 3])
    largest, longest = law.max_torsion_rad(depth), law.max_shear_m(depth)
    torsion = min(max(asked_torsion, -largest), largest)
    T = np.eye(4)
    T[:3, :3] = about_z(torsion) @ R_tilt
    T[:2, 3] = T_f_s[:2, 3] * min(1.0, longest / max(asked_shear, 1e-12))
    T[2, 3] = depth
    slipping = asked_shear > longest or abs(asked_torsion) > largest
    return ContactState(T, np.eye(4), depth > 0.0, slipping, law.stiffness_n_m * max(depth, 0.0))


def tilt_of(inward_in_s: Array) -> Array:
    """Return the tilt (3, 3) of a sensor: the Ry(beta) Rx(alpha) that takes ``inward_in_s`` (3,), the inward normal in
    {s}, to the z axis of {f}."""
    return np.array(_tilt_axes(*inward_in_s.tolist()))


def _tilt_axes(x: float, y: float, z: float) -> _Axes:
    # The inverse rotation takes z to (-sin beta, sin alpha cos beta, cos alpha cos beta).
    cos_beta = math.hypot(y, z)
    # With the normal along the sensor's x axis alpha is free.
    sin_alpha, cos_alpha = (y / cos_beta, z / cos_beta) if cos_beta > 1e-12 else (0.0, 1.0)
    sin_beta = -x
    return (
        (cos_beta, sin_beta * sin_alpha, sin_beta * cos_alpha),
        (0.0, cos_alpha, -sin_alpha),
        (-sin_beta, cos_beta * sin_alpha, cos_beta * cos_alpha),
    )


def about_z(angle: float) -> Array:
    """Return the rotation (3, 3) about the z axis."""
    sin, cos = math.sin(angle), math.cos(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _three(vector: Array) -> _Three:
    x, y, z = vector.tolist()
    return x, y, z


def _rows(R: Array) -> _Axes:
    return _three(R[0]), _three(R[1]), _three(R[2])


def _along(axes: _Axes, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the components of a vector along the first two axes."""
    (a, b, _), (c, d, _), (e, f, _) = axes
    return a * x + c * y + e * z, b * x + d * y + f * z


def _turned(axes: _Axes, angle: float) -> _Axes:
    """Return the axes turned by ``angle`` about their z axis."""
    sin, cos = math.sin(angle), math.cos(angle)
    (a, b, x), (c, d, y), (e, f, z) = axes
    return (
        (a * cos + b * sin, b * cos - a * sin, x),
        (c * cos + d * sin, d * cos - c * sin, y),
        (e * cos + f * sin, f * cos - e * sin, z),
    )


def _transport(axes: _Axes, z: _Three) -> _Axes:
    """Turn ``axes`` by the smallest rotation that brings their z axis to the unit vector ``z``."""
    (x0, _, a0), (x1, _, a1), (x2, _, a2) = axes
    b0, b1, b2 = z
    # x + v x x + v x (v x x) / (1 + a.b) with v = a x b; x is normal to a, so it is x - (a + b) (b.x) / (1 + a.b).
    # Where the nearest point jumps to the other side of a plate every half turn is as small: the one about x.
    toward = 1.0 + a0 * b0 + a1 * b1 + a2 * b2
    scale = (b0 * x0 + b1 * x1 + b2 * x2) / toward if toward > _OPPOSITE else 0.0
    x0, x1, x2 = x0 - (a0 + b0) * scale, x1 - (a1 + b1) * scale, x2 - (a2 + b2) * scale
    # Rounding would accumulate over thousands of steps of sliding.
    along = x0 * b0 + x1 * b1 + x2 * b2
    x0, x1, x2 = x0 - b0 * along, x1 - b1 * along, x2 - b2 * along
    length = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    x0, x1, x2 = x0 / length, x1 / length, x2 / length
    return (x0, b1 * x2 - b2 * x1, b0), (x1, b2 * x0 - b0 * x2, b1), (x2, b0 * x1 - b1 * x0, b2)
