"""Quasi-static pushing: objects slide on a table under soft tips, without inertia.

An object moves only as far as needed for the tips' forces to come down to what friction with the table can carry. The
friction is an ellipsoidal limit surface (Goyal, Ruina & Papadopoulos 1991; Howe & Cutkosky 1996): its force is that of
Coulomb's law, its moment that of a uniform pressure under the whole bottom, and the motion is along its normal, so that
friction always dissipates. Tips are the springs of ``contact.ContactLaw``, which stick and slip.

Each step is solved implicitly, like plasticity (a return mapping): nothing creeps below the limit, and no stiffness is
too large for the step. Objects stay upright and do not collide with each other or with the scene's surfaces; downward
forces on them add to their weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.objects import GRAVITY_M_S2 as GRAVITY_M_S2
from touchcell.simulation.objects import FreeObject, TableConfig
from touchcell.simulation.shapes import Ball
from touchcell.simulation.solids import friction_radius_m, plain_shape_of
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore
from touchcell.simulation.world import DeferredContact

_Three = tuple[float, float, float]
_Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""3 x 3 matrix, by rows."""

_MAX_ITERATIONS: Final = 30
_TOLERANCE_M: Final = 1e-10
_TOLERANCE: Final = 1e-7


class _Slider:
    """A sliding object: its pose and the motion of its surface.

    Friction acts about the centre of mass: under a body at rest the centre of pressure lies below it.

    Attributes:
        x, y, yaw: of the object's centre of mass in the world, m and rad.
        weight_n: its own weight plus the downward force of tips.
        com_x, com_y: centre of mass from the object's origin, m.
    """

    def __init__(self, name: str, body: FreeObject, table: TableConfig) -> None:
        T, solid = body.T_world_object, body.solid
        if isinstance(solid, Ball):
            raise ConfigError(
                "a ball rolls, which quasi-static physics does not model",
                key=f"scene.objects.{name}",
                hint="use physics: dynamic",
            )
        if T[2, 2] < 1.0 - 1e-9:
            raise ConfigError(
                "quasi-static physics keeps objects upright",
                key=f"scene.objects.{name}.pose_mm_deg",
                hint="rotate it about z only",
            )
        self.shape = plain_shape_of(solid)
        self.surface = Surface(self.shape, self)
        self.radius_m = friction_radius_m(solid)
        self.friction = body.friction
        gravity = table.gravity_m_s2
        self.own_weight_n = -body.mass_kg * gravity[2]
        self.downhill_n = body.mass_kg * gravity[0], body.mass_kg * gravity[1]
        self.weight_n = self.own_weight_n
        self._factor = table.factor if table.patches else None
        self.yaw = math.atan2(T[1, 0], T[0, 0])
        self.com_x, self.com_y = body.center_of_mass_m
        sin, cos = math.sin(self.yaw), math.cos(self.yaw)
        self.x = float(T[0, 3]) + cos * self.com_x - sin * self.com_y
        self.y = float(T[1, 3]) + sin * self.com_x + cos * self.com_y
        self.z = float(T[2, 3])
        self._velocity = np.zeros(6)
        self._T = T

    @property
    def limit_n(self) -> float:
        """Largest friction force of the table."""
        factor = 1.0 if self._factor is None else self._factor(self.x, self.y)
        return factor * self.friction * self.weight_n

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4) at the last step, whatever the time."""
        return self._T

    def twist(self, t_s: float) -> Array:
        """Return (6,) [v, w] in the last step, along world axes."""
        return self._velocity

    def snapshot(self) -> Restore:
        """Return a function that restores the present state."""
        kept = self.x, self.y, self.yaw, self.weight_n, self._velocity, self._T

        def restore() -> None:
            self.x, self.y, self.yaw, self.weight_n, self._velocity, self._T = kept

        return restore

    def move(self, shift: _Three, dt_s: float) -> None:
        """Move by ``shift``: x, y and friction radius times yaw, m, within ``dt_s``."""
        dx, dy, turn = shift[0], shift[1], shift[2] / self.radius_m
        self.x, self.y, self.yaw = self.x + dx, self.y + dy, self.yaw + turn
        if dt_s > 0.0:
            self._velocity = np.array([dx, dy, 0.0, 0.0, 0.0, turn]) / dt_s
        if dx or dy or turn:
            sin, cos = math.sin(self.yaw), math.cos(self.yaw)
            x = self.x - cos * self.com_x + sin * self.com_y
            y = self.y - sin * self.com_x - cos * self.com_y
            self._T = np.array([[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, self.z], [0.0, 0.0, 0.0, 1.0]])
            if dt_s > 0.0:
                # The twist is that of the object's origin.
                self._velocity[0] += turn / dt_s * (y - self.y) * -1.0
                self._velocity[1] += turn / dt_s * (x - self.x)


class QuasiStaticWorld:
    """Surfaces with prescribed motion, and sliding objects; each tip touches the nearest of them.

    Args:
        surfaces: surfaces by name.
        objects: objects by name.
        law: contact law of every tip.
        table: the table under the objects.

    Raises:
        ConfigError: nothing to touch, an object is not upright, or it is a ball.
    """

    def __init__(
        self,
        surfaces: Mapping[str, Surface],
        objects: Mapping[str, FreeObject],
        law: ContactLaw,
        table: TableConfig | None = None,
    ) -> None:
        if not (surfaces or objects):
            raise ConfigError("the scene has nothing to touch", key="scene")
        self.law = law
        self._sliders = {name: _Slider(name, body, table or TableConfig()) for name, body in objects.items()}
        self._bodies = [*(slider.surface for slider in self._sliders.values()), *surfaces.values()]
        self._models: dict[str, ContactModel] = {}
        self._t_s = 0.0

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Add ``sensor``; return its contact at ``T_world_s`` (4, 4) at ``t_s``."""
        self._t_s = t_s
        model = self._models[sensor] = ContactModel(self.law)
        return model.step(T_world_s, self._nearest(T_world_s, t_s), t_s)

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, DeferredContact]:
        """Let the tips push the objects until friction holds; return the contact of each sensor then."""
        dt_s, self._t_s = t_s - self._t_s, t_s
        touched = {sensor: self._nearest(pose, t_s) for sensor, pose in T_world_s.items()}
        for slider in self._sliders.values():
            tips = [
                _Tip(T_world_s[sensor][:3, 3], self._models[sensor].held_point(slider.surface))
                for sensor, surface in touched.items()
                if surface is slider.surface
            ]
            slider.move(_settle(slider, tips, self.law), dt_s)
        return {sensor: self._models[sensor].advance(pose, touched[sensor], t_s) for sensor, pose in T_world_s.items()}

    def objects(self) -> Mapping[str, Array]:
        """Return T_world_object (4, 4) of every free object at the last step."""
        return {name: slider.pose(self._t_s) for name, slider in self._sliders.items()}

    def snapshot(self) -> Restore:
        """Return a function that restores every object and contact."""
        parts = [slider.snapshot() for slider in self._sliders.values()]
        parts += [model.snapshot() for model in self._models.values()]

        def restore() -> None:
            for part in parts:
                part()

        return restore

    def _nearest(self, T_world_s: Array, t_s: float) -> Surface:
        if len(self._bodies) == 1:
            return self._bodies[0]
        return min(self._bodies, key=lambda each: each.nearest(T_world_s[:3, 3], t_s).distance_m)


class _Tip:
    """A tip that may push an object: its centre in the world, and the point of the object to which its skin sticks."""

    __slots__ = ("centre", "held")

    def __init__(self, centre: Array, held: Array | None) -> None:
        self.centre: _Three = (float(centre[0]), float(centre[1]), float(centre[2]))
        self.held: _Three | None = None if held is None else (float(held[0]), float(held[1]), float(held[2]))


def _settle(slider: _Slider, tips: Sequence[_Tip], law: ContactLaw) -> _Three:
    """Return the slide of the object under its tips in one step: x, y and friction radius times yaw, m.

    In these coordinates the limit surface is a sphere: the object rests while the force ``f`` on it is below the limit;
    otherwise it moves along ``f`` until ``f`` has come down to the limit. Newton's method on both conditions,
    ``shift = way f / limit`` and ``|f| = limit``.
    """
    slider.weight_n = slider.own_weight_n
    f, K, down = _force(slider, tips, law, (0.0, 0.0, 0.0))
    slider.weight_n = max(slider.own_weight_n + down, 0.0)
    limit = max(slider.limit_n, 1e-9)
    size = math.hypot(*f)
    x = y = turn = way = 0.0
    if size <= limit:
        return x, y, turn
    for _ in range(_MAX_ITERATIONS):
        fx, fy, ft = f
        scale, excess = way / limit, size / limit - 1.0
        unmoved = scale * fx - x, scale * fy - y, scale * ft - turn
        if abs(excess) < _TOLERANCE and max(map(abs, unmoved)) < _TOLERANCE_M:
            break
        inverse = _inverse(scale, K)
        resting = _times(inverse, unmoved)
        moving = _times(inverse, (fx / limit, fy / limit, ft / limit))
        per_n = size * limit
        falls = (
            (fx * K[0] + fy * K[3] + ft * K[6]) / per_n,
            (fx * K[1] + fy * K[4] + ft * K[7]) / per_n,
            (fx * K[2] + fy * K[5] + ft * K[8]) / per_n,
        )
        further = (excess - _dot(falls, resting)) / _dot(falls, moving)
        part = 1.0
        while True:
            trial = (
                x + part * (resting[0] + further * moving[0]),
                y + part * (resting[1] + further * moving[1]),
                turn + part * (resting[2] + further * moving[2]),
            )
            f, K, _ = _force(slider, tips, law, trial)
            size = math.hypot(*f)
            # A step that breaks the contact is too long: there the force has no direction.
            if size > 0.1 * limit or part < 1e-3:
                break
            part *= 0.5
        x, y, turn = trial
        way = max(way + part * further, 0.0)
        if size == 0.0:
            break
    return x, y, turn


def _dot(a: _Three, b: _Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(M: _Matrix, v: _Three) -> _Three:
    a, b, c, d, e, f, g, h, i = M
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _inverse(scale: float, K: _Matrix) -> _Matrix:
    """Return the inverse of the matrix 1 + scale K."""
    a, b, c, d, e, f, g, h, i = K
    a, b, c = 1.0 + scale * a, scale * b, scale * c
    d, e, f = scale * d, 1.0 + scale * e, scale * f
    g, h, i = scale * g, scale * h, 1.0 + scale * i
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    over = 1.0 / (a * p + b * q + c * r)
    return (
        over * p,
        over * (c * h - b * i),
        over * (b * f - c * e),
        over * q,
        over * (a * i - c * g),
        over * (c * d - a * f),
        over * r,
        over * (b * g - a * h),
        over * (a * e - b * d),
    )


def _force(slider: _Slider, tips: Sequence[_Tip], law: ContactLaw, shift: _Three) -> tuple[_Three, _Matrix, float]:
    """Return force of all tips on the object moved by ``shift``, in its coordinates; its decrease with the shift to
    first order; and the downward force of the tips, N."""
    radius, stiff_n, nearest = slider.radius_m, law.stiffness_n_m, slider.shape.nearest_numbers
    x, y, yaw = slider.x + shift[0], slider.y + shift[1], slider.yaw + shift[2] / radius
    sin, cos = math.sin(yaw), math.cos(yaw)
    com_x, com_y = slider.com_x, slider.com_y
    force_x, force_y = slider.downhill_n
    force_turn = down = 0.0
    xx = xy = xt = yx = yy = yt = tx = ty = tt = 0.0
    for tip in tips:
        cx, cy, cz = tip.centre[0] - x, tip.centre[1] - y, tip.centre[2] - slider.z
        # From here on in the object's frame; levers are from its centre of mass.
        bx, by = cos * cx + sin * cy, cos * cy - sin * cx
        distance, nx, ny, nz, px, py, pz = nearest(bx + com_x, by + com_y, cz)
        depth = law.tip_radius_m - distance
        if depth <= 0.0:
            continue
        stiff_t = 0.0
        push = -stiff_n * depth
        fx, fy = push * nx, push * ny
        down -= push * nz
        if tip.held is not None:
            sx, sy, sz = px - tip.held[0], py - tip.held[1], pz - tip.held[2]
            along = sx * nx + sy * ny + sz * nz
            sx, sy, sz = sx - along * nx, sy - along * ny, sz - along * nz
            length, longest = math.sqrt(sx * sx + sy * sy + sz * sz), law.max_shear_m(depth)
            stiff_t = law.shear_stiffness_n_m(depth)
            if length > longest:
                stiff_t *= longest / length
            fx, fy = fx + stiff_t * sx, fy + stiff_t * sy
            down -= stiff_t * sz
        force_x += cos * fx - sin * fy
        force_y += sin * fx + cos * fy
        px, py = px - com_x, py - com_y
        force_turn += (px * fy - py * fx) / radius
        # For a shift of the object's side against the tip, along the normal and along the tangent. Depth and shear
        # change with the object's motion at the tip's centre.
        for stiff, ux, uy in ((stiff_n, nx, ny), (stiff_t, -ny, nx)):
            wx, wy = cos * ux - sin * uy, sin * ux + cos * uy
            felt = (bx * uy - by * ux) / radius
            pushed_x, pushed_y, turned = stiff * wx, stiff * wy, stiff * (px * uy - py * ux) / radius
            xx, xy, xt = xx + pushed_x * wx, xy + pushed_x * wy, xt + pushed_x * felt
            yx, yy, yt = yx + pushed_y * wx, yy + pushed_y * wy, yt + pushed_y * felt
            tx, ty, tt = tx + turned * wx, ty + turned * wy, tt + turned * felt
    return (force_x, force_y, force_turn), (xx, xy, xt, yx, yy, yt, tx, ty, tt), down
