"""Objects that slide on a table where soft tips push them, so slowly that inertia does not matter.

An object moves only as far as it must for the tips' forces to come down to what friction with the table can carry. The
friction is an ellipsoidal limit surface (Goyal, Ruina & Papadopoulos 1991; Howe & Cutkosky 1996): its force is that of
Coulomb's law, its moment that of a uniform pressure under the whole bottom, and the motion is along its normal, so that
friction always dissipates. Tips are the springs of ``contact.ContactLaw``, which stick and slip.

Each step is solved implicitly, as plasticity is (a return mapping): nothing creeps below the limit, and no stiffness is
too large for the step. Objects stay upright, do not feel each other nor the scene's surfaces, and what presses down on
them adds to their weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.simulation.contact import ContactLaw, ContactModel, ContactState
from drivers.simulation.objects import Ball, FreeObject
from drivers.simulation.solids import friction_radius_m, shape_of
from drivers.simulation.surfaces import Surface
from drivers.simulation.timeline import Restore
from geometry.types import Array

GRAVITY_M_S2: Final = 9.81

_MAX_ITERATIONS: Final = 30
_TOLERANCE_M: Final = 1e-10
_TOLERANCE: Final = 1e-7


class _Slider:
    """A free object and where it is; the motion of its own surface.

    Attributes:
        x, y, yaw: of the object's origin in the world, m and rad.
        weight_n: its own weight and what tips press down on it.
    """

    def __init__(self, name: str, body: FreeObject) -> None:
        T, solid = body.T_world_object, body.solid
        if isinstance(solid, Ball):
            raise ConfigError(
                "a ball rolls, which quasi-static physics does not know",
                key=f"scene.objects.{name}",
                hint="use physics: dynamic",
            )
        if T[2, 2] < 1.0 - 1e-9:
            raise ConfigError(
                "quasi-static physics holds objects upright",
                key=f"scene.objects.{name}.pose_mm_deg",
                hint="turn it about z only",
            )
        self.surface = Surface(shape_of(solid), self)
        self.radius_m = friction_radius_m(solid)
        self.friction = body.friction
        self.own_weight_n = body.mass_kg * GRAVITY_M_S2
        self.weight_n = self.own_weight_n
        self.x, self.y, self.z = (float(value) for value in T[:3, 3])
        self.yaw = math.atan2(T[1, 0], T[0, 0])
        self._velocity = np.zeros(6)
        self._T = T

    @property
    def limit_n(self) -> float:
        """Largest friction force of the table."""
        return self.friction * self.weight_n

    def pose(self, t_s: float) -> Array:
        """T_world_body (4, 4) at the last step, whatever the time."""
        return self._T

    def twist(self, t_s: float) -> Array:
        """(6,) [v, w] in the last step, along world axes."""
        return self._velocity

    def snapshot(self) -> Restore:
        """What brings it back where it is now."""
        kept = self.x, self.y, self.yaw, self.weight_n, self._velocity, self._T

        def restore() -> None:
            self.x, self.y, self.yaw, self.weight_n, self._velocity, self._T = kept

        return restore

    def move(self, shift: Array, dt_s: float) -> None:
        """Move by ``shift`` (3,): x, y and friction radius times yaw, m, within ``dt_s``."""
        dx, dy, turn = float(shift[0]), float(shift[1]), float(shift[2]) / self.radius_m
        self.x, self.y, self.yaw = self.x + dx, self.y + dy, self.yaw + turn
        if dt_s > 0.0:
            self._velocity = np.array([dx, dy, 0.0, 0.0, 0.0, turn]) / dt_s
        if dx or dy or turn:
            sin, cos = math.sin(self.yaw), math.cos(self.yaw)
            self._T = np.array(
                [[cos, -sin, 0.0, self.x], [sin, cos, 0.0, self.y], [0.0, 0.0, 1.0, self.z], [0.0, 0.0, 0.0, 1.0]]
            )


class QuasiStaticWorld:
    """Surfaces that move as they were told, and objects that slide; each tip touches the nearest of them.

    Args:
        surfaces: by name.
        objects: by name.
        law: how every tip gives and slips.

    Raises:
        ConfigError: there is nothing to touch, an object does not stand upright, or one is a ball.
    """

    def __init__(self, surfaces: Mapping[str, Surface], objects: Mapping[str, FreeObject], law: ContactLaw) -> None:
        if not (surfaces or objects):
            raise ConfigError("the scene has nothing to touch", key="scene")
        self.law = law
        self._sliders = {name: _Slider(name, body) for name, body in objects.items()}
        self._bodies = [*(slider.surface for slider in self._sliders.values()), *surfaces.values()]
        self._models: dict[str, ContactModel] = {}
        self._t_s = 0.0

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Let ``sensor`` feel; returns what it feels at ``T_world_s`` (4, 4) at ``t_s``."""
        self._t_s = t_s
        model = self._models[sensor] = ContactModel(self.law)
        return model.step(T_world_s, self._nearest(T_world_s, t_s), t_s)

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, ContactState]:
        """Let the tips push the objects until friction holds; returns what each sensor feels then."""
        dt_s, self._t_s = t_s - self._t_s, t_s
        touched = {sensor: self._nearest(pose, t_s) for sensor, pose in T_world_s.items()}
        for slider in self._sliders.values():
            tips = [
                _Tip(T_world_s[sensor][:3, 3], self._models[sensor].held_point(slider.surface))
                for sensor, surface in touched.items()
                if surface is slider.surface
            ]
            slider.move(_settle(slider, tips, self.law), dt_s)
        return {sensor: self._models[sensor].step(pose, touched[sensor], t_s) for sensor, pose in T_world_s.items()}

    def objects(self) -> Mapping[str, Array]:
        """T_world_object (4, 4) of every free object at the last step."""
        return {name: slider.pose(self._t_s) for name, slider in self._sliders.items()}

    def snapshot(self) -> Restore:
        """What brings every object and contact back."""
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
    """A tip that may press on an object: its centre (3,) in the world, and where its skin holds on to the object."""

    __slots__ = ("centre", "held")

    def __init__(self, centre: Array, held: Array | None) -> None:
        self.centre = centre
        self.held = held


def _settle(slider: _Slider, tips: Sequence[_Tip], law: ContactLaw) -> Array:
    """How far (3,) the object slides under its tips in one step: x, y and friction radius times yaw, m.

    In these coordinates the limit surface is a sphere: the object rests while the force ``f`` on it is below the limit;
    otherwise it moves along ``f`` until ``f`` has come down to the limit. Newton's method on both conditions.
    """
    shift = np.zeros(3)
    slider.weight_n = slider.own_weight_n
    if not tips:
        return shift
    f, K, down = _force(slider, tips, law, shift)
    slider.weight_n = max(slider.own_weight_n + down, 0.0)
    limit = max(slider.limit_n, 1e-9)
    size = math.sqrt(float(f @ f))
    if size <= limit:
        return shift
    way = 0.0
    M = np.zeros((4, 4))
    r = np.empty(4)
    miss = math.inf
    for _ in range(_MAX_ITERATIONS):
        r[:3] = shift - way / limit * f
        r[3] = size / limit - 1.0
        miss = float(np.abs(r[:3]).max())
        if miss < _TOLERANCE_M and abs(r[3]) < _TOLERANCE:
            break
        M[:3, :3] = np.eye(3) + way / limit * K
        M[:3, 3] = -f / limit
        M[3, :3] = -(f @ K) / (size * limit)
        change = np.linalg.solve(M, -r)
        part = 1.0
        while True:
            trial = shift + part * change[:3]
            f_trial, K_trial, _ = _force(slider, tips, law, trial)
            size_trial = math.sqrt(float(f_trial @ f_trial))
            # A step that lets go of the object has gone too far: there the force has no direction.
            if size_trial > 0.1 * limit or part < 1e-3:
                break
            part *= 0.5
        shift, way = trial, max(way + part * float(change[3]), 0.0)
        f, K, size = f_trial, K_trial, size_trial
        if size == 0.0:
            break
    return shift


def _force(slider: _Slider, tips: Sequence[_Tip], law: ContactLaw, shift: Array) -> tuple[Array, Array, float]:
    """Force (3,) of all tips on the object moved by ``shift``, in its coordinates; how it falls with the shift, (3, 3),
    to first order; and how hard the tips press down, N."""
    radius = slider.radius_m
    x, y, yaw = slider.x + float(shift[0]), slider.y + float(shift[1]), slider.yaw + float(shift[2]) / radius
    sin, cos = math.sin(yaw), math.cos(yaw)
    f = np.zeros(3)
    K = np.zeros((3, 3))
    down = 0.0
    for tip in tips:
        cx, cy, cz = tip.centre[0] - x, tip.centre[1] - y, tip.centre[2] - slider.z
        near = slider.surface.shape.nearest(np.array([cos * cx + sin * cy, cos * cy - sin * cx, cz]))
        depth = law.tip_radius_m - near.distance_m
        if depth <= 0.0:
            continue
        pull_x = pull_y = 0.0
        nx, ny, nz = (float(value) for value in near.normal)
        stiff_n, stiff_t = law.stiffness_n_m, 0.0
        push = -stiff_n * depth
        if tip.held is not None:
            sx, sy, sz = (float(value) for value in near.point - tip.held)
            along = sx * nx + sy * ny + sz * nz
            sx, sy, sz = sx - along * nx, sy - along * ny, sz - along * nz
            length, longest = math.sqrt(sx * sx + sy * sy + sz * sz), law.max_shear_m(depth)
            stiff_t = law.shear_stiffness_n_m(depth)
            if length > longest:
                stiff_t *= longest / length
            pull_x, pull_y = stiff_t * sx, stiff_t * sy
            down -= stiff_t * sz
        fx, fy = push * nx + pull_x, push * ny + pull_y
        down -= push * nz
        px, py = float(near.point[0]), float(near.point[1])
        f += (cos * fx - sin * fy, sin * fx + cos * fy, (px * fy - py * fx) / radius)
        # What counts for depth and shear is how the object moves where the tip's centre is.
        bx, by = cos * cx + sin * cy, cos * cy - sin * cx
        for stiff, ux, uy in ((stiff_n, nx, ny), (stiff_t, -ny, nx)):
            wx, wy = cos * ux - sin * uy, sin * ux + cos * uy
            pushed = np.array([wx, wy, (px * uy - py * ux) / radius])
            felt = np.array([wx, wy, (bx * uy - by * ux) / radius])
            K += stiff * np.outer(pushed, felt)
    return f, K, down
