"""Quasi-static pushing: objects slide on a table under soft tips, without inertia.

An object moves only as far as needed for the tips' forces to come down to what friction with the table can carry. The
table carries it at nine points, each by Coulomb's law, which resist as an even pressure under the whole bottom does
(``solids.supports_m``): their limit surface (Goyal, Ruina & Papadopoulos 1991) is not an ellipsoid, and that of oblong
objects depends on the direction. Motion is along its normal, so that friction always dissipates. Tips are the springs
of ``contact.ContactLaw``, which stick and slip.

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
from touchcell.simulation.solids import friction_radius_m, plain_shape_of, supports_m
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore
from touchcell.simulation.world import DeferredContact

_Three = tuple[float, float, float]
_Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""3 x 3 matrix, by rows."""

_STILL: Final[_Three] = (0.0, 0.0, 0.0)
_MAX_ITERATIONS: Final = 60
_TOLERANCE: Final = 1e-7
_REST_M: Final = 1e-10
"""Motion of a support below which it rests."""
_SOFTEST_N_M: Final = 1e-3
"""Stiffness added in Newton's method, where nothing else resists a motion."""
_LARGEST_M: Final = 0.01
"""Largest slide that is expected of one step."""
_SURELY_RESTS: Final = 0.6
"""Share of the limit, by the ellipsoid through its axes, below which no motion is possible."""
_REST_CHECKS: Final = 4


class _Slider:
    """A sliding object: its pose and the motion of its surface.

    Friction acts about the centre of mass: under a body at rest the centre of pressure lies below it.

    Attributes:
        x, y, yaw: of the object's centre of mass in the world, m and rad.
        supports: points of its bottom, over its friction radius.
        shares: of its weight that each of them bears.
        slide: its motion in the last step: x, y and friction radius times yaw, m.
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
        self.supports = tuple((x / self.radius_m, y / self.radius_m) for x, y in supports_m(solid))
        self.shares = (1.0 / len(self.supports),) * len(self.supports)
        self._spread = tuple(sum(each[axis] ** 2 for each in self.supports) for axis in (0, 1))
        self.slide: _Three = (0.0, 0.0, 0.0)
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

    def lean(self, moment_nm: tuple[float, float], share: float) -> None:
        """Bear more of the weight where tips push it: what pushes above the table loads the front.

        Args:
            moment_nm: (x, y) of the tips, along the world's axes.
            share: of it that friction lets them exert.
        """
        count, lever_m = len(self.supports), share / max(self.weight_n * self.radius_m, 1e-9)
        sin, cos = math.sin(self.yaw), math.cos(self.yaw)
        ahead = lever_m * (cos * moment_nm[0] + sin * moment_nm[1]) / self._spread[0]
        left = lever_m * (cos * moment_nm[1] - sin * moment_nm[0]) / self._spread[1]
        shares = [max(1.0 / count + ahead * x + left * y, 0.0) for x, y in self.supports]
        total = sum(shares)
        self.shares = tuple(each / total for each in shares)

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4) at the last step, whatever the time."""
        return self._T

    def twist(self, t_s: float) -> Array:
        """Return (6,) [v, w] in the last step, along world axes."""
        return self._velocity

    def snapshot(self) -> Restore:
        """Return a function that restores the present state."""
        kept = self.x, self.y, self.yaw, self.weight_n, self.slide, self._velocity, self._T

        def restore() -> None:
            self.x, self.y, self.yaw, self.weight_n, self.slide, self._velocity, self._T = kept

        return restore

    def move(self, shift: _Three, dt_s: float) -> None:
        """Move by ``shift``: x, y and friction radius times yaw, m, within ``dt_s``."""
        self.slide = shift
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

    @property
    def bodies(self) -> list[Surface]:
        """Objects and surfaces, where they are now."""
        return self._bodies

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

    It is where the tips' energy and what friction dissipates are least together: the object rests while no motion
    frees more energy than it dissipates; otherwise it moves until the force on it is the gradient of the dissipation,
    the sum of the supports' ways. Newton's method, and where that does not come nearer, a step with each support's
    friction as a damper of its present speed, which always does.
    """
    slider.weight_n = slider.own_weight_n
    first, K, down, moment = _force(slider, tips, law, _STILL)
    slider.weight_n = max(slider.own_weight_n + down, 0.0)
    limit = max(slider.limit_n, 1e-9)
    slider.lean(moment, min(1.0, limit / max(math.hypot(first[0], first[1]), 1e-12)))
    if math.hypot(*first) <= _SURELY_RESTS * limit:
        return _STILL
    shift = slider.slide if any(slider.slide) else _times(_inverse(K, limit / _LARGEST_M), first)
    if not any(shift):
        shift = (1e-6, 0.0, 0.0)
    held, dampers, curvature, _ = _friction(slider, limit, shift)
    f, K, _, _ = _force(slider, tips, law, shift)
    left = (f[0] - held[0], f[1] - held[1], f[2] - held[2])
    resting = 0
    for _ in range(_MAX_ITERATIONS):
        size = math.hypot(*left)
        if size < _TOLERANCE * limit:
            return shift
        further = _times(_inverse(_sum(K, curvature), _SOFTEST_N_M), left)
        trial = (shift[0] + further[0], shift[1] + further[1], shift[2] + further[2])
        next_held, next_dampers, next_curvature, next_dissipated = _friction(slider, limit, trial)
        next_f, next_K, _, _ = _force(slider, tips, law, trial)
        next_left = (next_f[0] - next_held[0], next_f[1] - next_held[1], next_f[2] - next_held[2])
        if math.hypot(*next_left) > 0.9 * size:
            pulled = _times(K, shift)
            trial = _times(_inverse(_sum(K, dampers)), (f[0] + pulled[0], f[1] + pulled[1], f[2] + pulled[2]))
            next_held, next_dampers, next_curvature, next_dissipated = _friction(slider, limit, trial)
            next_f, next_K, _, _ = _force(slider, tips, law, trial)
            next_left = (next_f[0] - next_held[0], next_f[1] - next_held[1], next_f[2] - next_held[2])
            resting = resting + 1 if _dot(first, trial) < next_dissipated else 0
            if resting >= _REST_CHECKS or math.hypot(*trial) < _REST_M:
                return _STILL
        shift, f, K, left = trial, next_f, next_K, next_left
        dampers, curvature = next_dampers, next_curvature
    return shift


def _friction(slider: _Slider, limit_n: float, shift: _Three) -> tuple[_Three, _Matrix, _Matrix, float]:
    """Return the table's force against a slide, in the slide's coordinates; the same as dampers, and its growth with
    the slide, N/m; and the energy that the slide dissipates, J."""
    x, y, turn = shift
    sin, cos = math.sin(slider.yaw), math.cos(slider.yaw)
    fx = fy = ft = dissipated = 0.0
    dd = dxt = dyt = dtt = 0.0
    xx = xy = yy = xt = yt = tt = 0.0
    for (px, py), share in zip(slider.supports, slider.shares, strict=True):
        each_n = limit_n * share
        rx, ry = cos * px - sin * py, sin * px + cos * py
        vx, vy = x - turn * ry, y + turn * rx
        speed = math.sqrt(vx * vx + vy * vy + _REST_M * _REST_M)
        ux, uy, damper = vx / speed, vy / speed, each_n / speed
        lever = rx * uy - ry * ux
        dissipated += each_n * speed
        fx, fy, ft = fx + each_n * ux, fy + each_n * uy, ft + each_n * lever
        dd, dxt, dyt, dtt = dd + damper, dxt - damper * ry, dyt + damper * rx, dtt + damper * (rx * rx + ry * ry)
        # Only motion across its own direction turns a support's friction.
        xx, xy, yy = xx + damper * (1.0 - ux * ux), xy - damper * ux * uy, yy + damper * (1.0 - uy * uy)
        xt, yt = xt + damper * (-ry - ux * lever), yt + damper * (rx - uy * lever)
        tt += damper * (rx * rx + ry * ry - lever * lever)
    return (
        (fx, fy, ft),
        (dd, 0.0, dxt, 0.0, dd, dyt, dxt, dyt, dtt),
        (xx, xy, xt, xy, yy, yt, xt, yt, tt),
        dissipated,
    )


def _sum(a: _Matrix, b: _Matrix) -> _Matrix:
    return (
        a[0] + b[0],
        a[1] + b[1],
        a[2] + b[2],
        a[3] + b[3],
        a[4] + b[4],
        a[5] + b[5],
        a[6] + b[6],
        a[7] + b[7],
        a[8] + b[8],
    )


def _dot(a: _Three, b: _Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(M: _Matrix, v: _Three) -> _Three:
    a, b, c, d, e, f, g, h, i = M
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _inverse(K: _Matrix, added: float = 0.0) -> _Matrix:
    """Return the inverse of a matrix, with ``added`` on its diagonal."""
    a, b, c, d, e, f, g, h, i = K
    a, e, i = a + added, e + added, i + added
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


def _force(
    slider: _Slider, tips: Sequence[_Tip], law: ContactLaw, shift: _Three
) -> tuple[_Three, _Matrix, float, tuple[float, float]]:
    """Return force of all tips on the object moved by ``shift``, in its coordinates; its decrease with the shift to
    first order; the downward force of the tips, N; and the moment (x, y) by which they move the weight along the table,
    N m."""
    radius, stiff_n, nearest = slider.radius_m, law.stiffness_n_m, slider.shape.nearest_numbers
    x, y, yaw = slider.x + shift[0], slider.y + shift[1], slider.yaw + shift[2] / radius
    sin, cos = math.sin(yaw), math.cos(yaw)
    com_x, com_y = slider.com_x, slider.com_y
    force_x, force_y = slider.downhill_n
    force_turn = down = moment_x = moment_y = 0.0
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
        fx, fy, pressed = push * nx, push * ny, -push * nz
        if tip.held is not None:
            sx, sy, sz = px - tip.held[0], py - tip.held[1], pz - tip.held[2]
            along = sx * nx + sy * ny + sz * nz
            sx, sy, sz = sx - along * nx, sy - along * ny, sz - along * nz
            length, longest = math.sqrt(sx * sx + sy * sy + sz * sz), law.max_shear_m(depth)
            stiff_t = law.shear_stiffness_n_m(depth)
            if length > longest:
                stiff_t *= longest / length
            fx, fy = fx + stiff_t * sx, fy + stiff_t * sy
            pressed -= stiff_t * sz
        down += pressed
        force_x += cos * fx - sin * fy
        force_y += sin * fx + cos * fy
        px, py = px - com_x, py - com_y
        along_x, along_y = pz * fx + pressed * px, pz * fy + pressed * py
        moment_x += cos * along_x - sin * along_y
        moment_y += sin * along_x + cos * along_y
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
    return (force_x, force_y, force_turn), (xx, xy, xt, yx, yy, yt, tx, ty, tt), down, (moment_x, moment_y)
