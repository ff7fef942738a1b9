"""Full dynamics of free objects and soft tips, by MuJoCo: pushing, slipping, toppling, holding.

Each sensor is connected to a rigid sphere by springs (``dynamics_model.TipMechanics``). The springs' other end, the
carriage, moves from pose to pose at constant speed, whatever the load. It keeps its z axis along the surface normal:
tilting about the tip's centre causes no shear, as in the definition of the contact, and the springs' deflection is the
contact's shear and torsion. MuJoCo receives the carriage's speed for all physics steps of a step of the scene; the
tip's coordinates, expressed along the carriage's axes at its start, are then re-expressed along those at its end.

Surfaces with prescribed motion are presented to each tip as a tangent patch in front of it.

Free objects touch the table, tips and each other, but not prescribed surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.geometry.vectors import cross
from touchcell.simulation.contact import about_z, tilt_of
from touchcell.simulation.dynamics_model import TipMechanics, build_model, quaternion, rotation
from touchcell.simulation.objects import FreeObject
from touchcell.simulation.solids import shape_of
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore
from touchcell.simulation.world import DeferredContact

# A carriage that would rotate faster than this in one step has reached another face: it is placed there, not swung.
_SWING_RAD = 0.1
# Friction is regularised: sliding contacts carry a little less than the cone allows.
_SLIDING_SHARE = 0.97
_IDENTITY = np.eye(4)
_UP = np.array([0.0, 0.0, 1.0])
_STILL = np.zeros(3)
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(slots=True)
class _Mounted:
    """One sensor's carriage after the last step.

    Attributes:
        T_world_s: (4, 4) pose of the sensor.
        R_world_c: (3, 3) axes of the carriage.
        R_start: (3, 3) the same before that step.
        speed: (6,) [v, w] in that step along ``R_start``, at the tip's position.
        normal: (3,) outward, of the nearest surface.
        depth: m, indentation after that step; negative out of contact.
        stiffness: N/m, of the springs across the normal.
    """

    T_world_s: Array
    R_world_c: Array
    R_start: Array
    speed: Array
    normal: Array
    depth: float
    stiffness: float


@dataclass(frozen=True, slots=True)
class _Coordinates:
    """A tip's part of MuJoCo's state, read and written in place.

    Attributes:
        q, rate: (6,) deflection of the springs along and about the carriage's axes, and its rate.
        applied: (6,) forces along the same.
        ctrl, act: (4,) speed of the springs' other ends along x, y, z and about z, and their displacement.
        position, turn: (3,), (4,) of the carriage in the world.
    """

    q: Array
    rate: Array
    applied: Array
    ctrl: Array
    act: Array
    position: Array
    turn: Array


class PhysicsError(TouchcellError, ArithmeticError):
    """The physics received or produced numbers that are not finite.

    Attributes:
        what: the quantity concerned.
        t_s: time of the scene.
    """

    def __init__(self, what: str, t_s: float) -> None:
        super().__init__(
            f"{what} is not finite at {t_s:.3f} s of the scene",
            hint="a smaller physics_step_ms helps where motions are very fast or tips very stiff",
        )
        self.what = what
        self.t_s = t_s


class DynamicWorld:
    """A world with dynamics by MuJoCo.

    Args:
        surfaces: surfaces with prescribed motion, by name.
        objects: free objects by name.
        table_height_m: height of the level plane under them.
        tip: mechanics of every tip.
        step_s: time step of the physics; steps of the scene must be multiples of it.
        gravity_m_s2: in the world frame.
        friction_factor: returns the table's friction at a place (x, y, m) over that elsewhere; None for the same
            everywhere.

    Raises:
        ConfigError: nothing to touch.
    """

    def __init__(
        self,
        surfaces: Mapping[str, Surface],
        objects: Mapping[str, FreeObject],
        table_height_m: float,
        tip: TipMechanics,
        step_s: float,
        gravity_m_s2: Sequence[float] = (0.0, 0.0, -9.81),
        friction_factor: Callable[[float, float], float] | None = None,
    ) -> None:
        if not (surfaces or objects):
            raise ConfigError("the scene has nothing to touch", key="scene")
        self.tip = tip
        self._surfaces = list(surfaces.values())
        self._things = dict(objects)
        self._shapes = {name: shape_of(thing.solid) for name, thing in objects.items()}
        self._table_height_m = table_height_m if objects else None
        self._step_s = step_s
        self._gravity_m_s2 = gravity_m_s2
        self._friction_factor = friction_factor
        self._mounted: dict[str, _Mounted] = {}
        self._t_s = 0.0
        self._build({})

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Add ``sensor``; return its contact at ``T_world_s`` (4, 4) at ``t_s``. All tips start undeformed and all
        objects at rest."""
        nearest = self._nearest(T_world_s[:3, 3], t_s)
        R_world_c, depth = _upright(T_world_s, nearest.normal), self.tip.radius_m - nearest.distance_m
        stiffness = self.tip.shear_stiffness_n_m
        self._mounted[sensor] = _Mounted(T_world_s, R_world_c, R_world_c, np.zeros(6), nearest.normal, depth, stiffness)
        self._t_s = t_s
        self._build(self.objects())
        return self._contact_of(sensor, T_world_s, t_s)()

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, DeferredContact]:
        """Advance to ``t_s``. Raises PhysicsError."""
        span_s = t_s - self._t_s
        for sensor, pose in T_world_s.items():
            self._carry(sensor, pose, span_s)
        if self._friction_factor is not None:
            self._place_feet(self._friction_factor)
        mujoco.mj_step(self._at.model, self._data, round(span_s / self._step_s))
        for sensor in T_world_s:
            self._settle(sensor)
        if not math.isfinite(float(self._qpos.sum())):
            raise PhysicsError("the state", t_s)
        self._t_s = t_s
        self._copy_object_poses()
        return {sensor: self._contact_of(sensor, pose, t_s) for sensor, pose in T_world_s.items()}

    def objects(self) -> Mapping[str, Array]:
        """Return the present T_world_object (4, 4) of every free object."""
        return self._T_world_object

    def snapshot(self) -> Restore:
        """Return a function that restores objects, tips and carriages."""
        model, data = self._at.model, self._data
        state = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, state, _STATE)
        t_s, mounted = self._t_s, {sensor: replace(each) for sensor, each in self._mounted.items()}

        def restore() -> None:
            mujoco.mj_setState(model, data, state, _STATE)
            self._t_s, self._mounted = t_s, {sensor: replace(each) for sensor, each in mounted.items()}
            self._copy_object_poses()

        return restore

    def _copy_object_poses(self) -> None:
        """Copy the poses of objects, anew each time, so that published ones stay unchanged."""
        self._T_world_object = {name: self._pose(name) for name in self._things}

    def _build(self, T_world_object: Mapping[str, Array]) -> None:
        """Compile the model again, with objects at ``T_world_object`` (4, 4) or at their initial poses."""
        self._at = build_model(
            self._things,
            self._table_height_m,
            list(self._mounted),
            self.tip,
            self._step_s,
            patches=bool(self._surfaces),
            gravity_m_s2=self._gravity_m_s2,
        )
        self._data = mujoco.MjData(self._at.model)
        model, data = self._at.model, self._data
        self._qpos, self._qvel = data.qpos, data.qvel
        self._tips = {
            sensor: _Coordinates(
                data.qpos[at.qpos : at.qpos + 6],
                data.qvel[at.qvel : at.qvel + 6],
                data.qfrc_applied[at.qvel : at.qvel + 6],
                data.ctrl[at.servo : at.servo + 4],
                data.act[at.servo : at.servo + 4],
                model.body_pos[at.body],
                model.body_quat[at.body],
            )
            for sensor, at in self._at.tips.items()
        }
        for name, pose in T_world_object.items():
            self._place(self._at.objects[name].qpos, pose[:3, 3], pose[:3, :3])
        self._copy_object_poses()

    def _carry(self, sensor: str, T_world_s: Array, span_s: float) -> None:
        """Move the carriage from its pose to ``T_world_s``, and place the surface in front of its tip.

        The normal that keeps it upright is that of the last step: the next pose of moving bodies is not known yet.
        """
        if not math.isfinite(float(T_world_s.sum())):
            raise PhysicsError(f"the pose of {sensor!r}", self._t_s)
        mounted, tip = self._mounted[sensor], self._tips[sensor]
        self._stiffen(sensor, mounted)
        position = mounted.T_world_s[:3, 3]
        R_start, R_end = mounted.R_world_c, _upright(T_world_s, mounted.normal)
        swing = _swing(R_start, R_end)
        if swing is None:
            R_start, swing = R_end, _STILL
        v = (T_world_s[:3, 3] - position) @ R_start / span_s
        w = swing @ R_start / span_s
        tip.position[:], tip.turn[:] = position, quaternion(R_start)
        tip.ctrl[:3], tip.ctrl[3] = v, w[2]
        # Of the carriage at the tip's position: springs are damped relative to it, and carrying a tip takes no force.
        speed = np.concatenate([v + cross(w, tip.q[:3]), w])
        tip.rate[:] += speed
        at = self._at.tips[sensor].qvel
        tip.applied[:] = self._at.model.dof_damping[at : at + 6] * speed
        if self._surfaces:
            self._place_patch(sensor, position + R_start @ tip.q[:3])
        mounted.T_world_s, mounted.R_world_c = T_world_s, R_end
        mounted.R_start, mounted.speed = R_start, speed

    def _stiffen(self, sensor: str, mounted: _Mounted) -> None:
        """Give the springs across the normal the stiffness of the last step's depth."""
        if self.tip.law is None:
            return
        stiffness = self.tip.shear_stiffness_at_n_m(mounted.depth)
        model, at = self._at.model, self._at.tips[sensor]
        model.jnt_stiffness[at.joint : at.joint + 2] = stiffness
        model.actuator_gainprm[at.servo : at.servo + 2, 0] = stiffness
        model.dof_damping[at.qvel : at.qvel + 2] = 2.0 * math.sqrt(stiffness * self.tip.mass_kg)
        mounted.stiffness = stiffness

    def _place_feet(self, factor: Callable[[float, float], float]) -> None:
        """Give every geometry of an object the friction of the table below it."""
        model, data = self._at.model, self._data
        for geom, friction in self._at.feet.items():
            x, y = data.geom_xpos[geom, 0], data.geom_xpos[geom, 1]
            model.geom_friction[geom, 0] = friction * factor(float(x), float(y))

    def _settle(self, sensor: str) -> None:
        """Express the tip's coordinates, and their rates, along its carriage's present axes."""
        mounted, tip = self._mounted[sensor], self._tips[sensor]
        turned = mounted.R_world_c.T @ mounted.R_start
        tip.q[:3] = turned @ (tip.q[:3] - tip.act[:3])
        tip.q[3:5] = 0.0
        tip.q[5] -= tip.act[3]
        tip.act[:] = 0.0
        tip.rate[:] -= mounted.speed
        tip.rate[:3] = turned @ tip.rate[:3]
        tip.rate[3:5] = 0.0

    def _place_patch(self, sensor: str, tip_centre: Array) -> None:
        """Place the tangent patch of the nearest surface at the tip's present position, moving with the surface."""
        surface, found = self._nearest_surface(tip_centre, self._t_s)
        at = self._at.patches[sensor]
        R = _facing(found.normal)
        self._place(at.qpos, found.point, R)
        twist = surface.motion.twist(self._t_s)
        if twist.any():
            arm = found.point - surface.motion.pose(self._t_s)[:3, 3]
            self._qvel[at.qvel : at.qvel + 3] = twist[:3] + cross(twist[3:], arm)
            self._qvel[at.qvel + 3 : at.qvel + 6] = R.T @ twist[3:]
        else:
            self._qvel[at.qvel : at.qvel + 6] = 0.0

    def _contact_of(self, sensor: str, T_world_s: Array, t_s: float) -> DeferredContact:
        nearest, tip = self._nearest(T_world_s[:3, 3], t_s), self._tips[sensor]
        mounted = self._mounted[sensor]
        mounted.normal, mounted.depth = nearest.normal, self.tip.radius_m - nearest.distance_m
        stiffness = mounted.stiffness
        dx, dy, dz, _, _, turned = tip.q.tolist()
        rate = float(tip.rate[2])
        return lambda: _contact(self.tip, stiffness, T_world_s, nearest, (dx, dy, dz), turned, rate)

    def _nearest(self, point: Array, t_s: float) -> SurfacePoint:
        """Return the nearest point to ``point`` (3,): of a surface, the table, or an object at its present pose."""
        found: SurfacePoint | None = None
        if self._surfaces:
            found = self._nearest_surface(point, t_s)[1]
        for name, shape in self._shapes.items():
            T = self._T_world_object[name]
            R, origin = T[:3, :3], T[:3, 3]
            local = shape.nearest((point - origin) @ R)
            if found is None or local.distance_m < found.distance_m:
                found = SurfacePoint(local.distance_m, R @ local.normal, R @ local.point + origin)
        if self._table_height_m is not None and (found is None or point[2] - self._table_height_m < found.distance_m):
            x, y, z = point.tolist()
            found = SurfacePoint(z - self._table_height_m, _UP, np.array([x, y, self._table_height_m]))
        assert found is not None
        return found

    def _nearest_surface(self, point: Array, t_s: float) -> tuple[Surface, SurfacePoint]:
        found = ((surface, surface.nearest(point, t_s)) for surface in self._surfaces)
        return min(found, key=lambda each: each[1].distance_m)

    def _pose(self, name: str) -> Array:
        at = self._at.objects[name].qpos
        T = _IDENTITY.copy()
        T[:3, :3] = rotation(self._qpos[at + 3 : at + 7])
        T[:3, 3] = self._qpos[at : at + 3]
        return T

    def _place(self, at: int, position: Array, R: Array) -> None:
        self._qpos[at : at + 3] = position
        self._qpos[at + 3 : at + 7] = quaternion(R)


def _contact(
    tip: TipMechanics,
    stiffness: float,
    T_world_s: Array,
    nearest: SurfacePoint,
    deflection: tuple[float, float, float],
    turned: float,
    rate: float,
) -> ContactState:
    """Return the contact of a tip whose springs, of ``stiffness`` across the normal, are deflected by ``deflection``
    and ``turned``."""
    R_f_s, depth = tilt_of(-nearest.normal @ T_world_s[:3, :3]), tip.radius_m - nearest.distance_m
    shear = pull = (0.0, 0.0)
    force, slipping = 0.0, False
    if depth > 0.0:
        dx, dy, dz = deflection
        # The sphere stays behind with the surface, so its deflection is the sensor's own displacement reversed.
        sin, cos = math.sin(turned), math.cos(turned)
        shear = (-cos * dx - sin * dy, sin * dx - cos * dy)
        pull = (-stiffness * shear[0], -stiffness * shear[1])
        pressing = -tip.stiffness_n_m * dz
        held = math.hypot(
            stiffness * math.hypot(dx, dy) / tip.friction,
            tip.torsion_stiffness_n_m_rad * turned / tip.torsion_friction_m,
        )
        force = max(pressing - tip.damping_n_s_m * rate, 0.0)
        slipping = held >= _SLIDING_SHARE * pressing
        R_f_s = about_z(-turned) @ R_f_s
    T_f_s = _IDENTITY.copy()
    T_f_s[:3, :3] = R_f_s
    T_f_s[:3, 3] = (*shear, depth)
    T_world_f = _IDENTITY.copy()
    T_world_f[:3, :3] = T_world_s[:3, :3] @ R_f_s.T
    T_world_f[:3, 3] = T_world_s[:3, 3] - T_world_f[:3, :3] @ T_f_s[:3, 3]
    return ContactState(T_f_s, T_world_f, depth > 0.0, slipping, force, pull)


def _swing(R_start: Array, R_end: Array) -> Array | None:
    """Return the rotation vector (3,) along world axes from one to the other; None if it is not small."""
    (a, b, c), (d, e, f), (g, h, i) = (R_end @ R_start.T).tolist()
    if a + e + i <= 1.0 + 2.0 * math.cos(_SWING_RAD):
        return None
    return np.array([0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)])


def _upright(T_world_s: Array, normal: Array) -> Array:
    """Return the axes of {s} without its tilt: z along the inward normal, heading as the sensor's."""
    R = T_world_s[:3, :3]
    upright: Array = R @ tilt_of(-normal @ R).T
    return upright


def _facing(normal: Array) -> Array:
    """Return axes (3, 3) with z along the unit vector ``normal``."""
    x, y, z = normal.tolist()
    # A rotation about an axis normal to both takes the world's z axis, or its opposite, there.
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b, x], [sign * b, sign + y * y * a, y], [-sign * x, -y, z]])
