"""MuJoCo model of a dynamic scene: table, free objects, and soft tips on carriages.

Settings and reasons: docs/explanation/simulation.md. Imported only for ``physics: dynamic``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.objects import FreeObject
from touchcell.simulation.shapes import Ball, Prism, Solid, Turned
from touchcell.simulation.solids import friction_radius_m, mass_properties

FEET = 8
_FOOT_RADIUS_M = 0.002
# Small enough that an object leans by only 0.3 deg before its own edge carries it.
_FOOT_HEIGHT_M = 0.05e-3
# So heavy that contact forces do not move it: a lighter body lets friction creep, by 30 um/s at 1000 kg.
_PATCH_KG = 1e6
_PATCH_KG_M2 = 1e4
# Likewise against rotation of a tip about axes along the surface.
_SWING_KG_M2 = 1e3
# Smallest improvement per solver iteration, kg m^2/s^4: MuJoCo's own is relative to the mean inertia.
_SOLVER_TOLERANCE = 5e-5
# Time constant (s) and damping ratio. Contact damping loads faster sliding feet more: at a ratio of 1 an object pushed
# off centre at 20 mm/s turns 12 % too little, at 0.5 it turns as the limit surface predicts.
_TABLE_SOLREF = (0.004, 0.5)
_PATCH_HALF_M = (0.1, 0.1, 0.02)
# Below this depth the springs across the normal stiffen no further.
_SHALLOWEST_M = 0.2e-3


@dataclass(frozen=True, slots=True)
class TipMechanics:
    """A tip as springs between the sensor's body and a rigid sphere; critically damped.

    Attributes:
        radius_m: radius of the sphere.
        stiffness_n_m: along the surface normal.
        friction: coefficient of sliding friction against everything.
        mass_kg: mass of the sphere. Lighter ones creep where they should stick (docs/explanation/simulation.md).
        torsion_friction_m: frictional torque about the contact normal, per normal force.
        law: contact law whose largest shear at each depth the springs across the normal have; None for springs of one
            stiffness.
    """

    radius_m: float = 0.020
    stiffness_n_m: float = 1500.0
    friction: float = 0.9
    mass_kg: float = 0.1
    torsion_friction_m: float = 0.005
    law: ContactLaw | None = None

    @property
    def shear_stiffness_n_m(self) -> float:
        """Stiffness across the normal, in the proportion of 1 N/mm across to 1.5 N/mm along it."""
        return self.stiffness_n_m / 1.5

    def shear_stiffness_at_n_m(self, depth_m: float) -> float:
        """Return the stiffness across the normal at a depth, with which the skin slips at the shear of ``law``."""
        if self.law is None:
            return self.shear_stiffness_n_m
        return self.law.shear_stiffness_n_m(max(depth_m, _SHALLOWEST_M))

    @property
    def torsion_stiffness_n_m_rad(self) -> float:
        """Stiffness about the normal, in the same proportion: 0.3 N m/rad."""
        return 0.2e-3 * self.stiffness_n_m

    @property
    def inertia_kg_m2(self) -> float:
        """Moment of inertia of the sphere about its centre."""
        return 0.4 * self.mass_kg * self.radius_m**2

    @property
    def damping_n_s_m(self) -> float:
        """Critical damping along the normal."""
        return 2.0 * math.sqrt(self.stiffness_n_m * self.mass_kg)

    @property
    def shear_damping_n_s_m(self) -> float:
        """Critical damping across the normal."""
        return 2.0 * math.sqrt(self.shear_stiffness_n_m * self.mass_kg)

    @property
    def torsion_damping_n_m_s(self) -> float:
        """Critical damping about the normal."""
        return 2.0 * math.sqrt(self.torsion_stiffness_n_m_rad * self.inertia_kg_m2)


@dataclass(frozen=True, slots=True)
class Address:
    """Indices of a body's coordinates.

    Attributes:
        qpos, qvel: index of the first one.
    """

    qpos: int
    qvel: int


@dataclass(frozen=True, slots=True)
class TipAddress:
    """Indices of a tip's six coordinates: along x, y, z and about x, y, z of its carriage.

    Attributes:
        qpos, qvel: index of the first one.
        servo: index of the first of four actuators, which are the springs along x, y, z and about z.
        joint: index of the first of its six joints.
        body: its body, whose frame in the world is the carriage's.
    """

    qpos: int
    qvel: int
    servo: int
    joint: int
    body: int


@dataclass(frozen=True, slots=True)
class SceneModel:
    """A compiled model with the indices of its parts.

    Attributes:
        model: mujoco.MjModel.
        objects: free joint of each object.
        tips: tip of each sensor.
        patches: free joint of the surface patch in front of each sensor; empty without surfaces.
        feet: friction coefficient of each geometry that touches the table, by its index.
    """

    model: Any
    objects: Mapping[str, Address]
    tips: Mapping[str, TipAddress]
    patches: Mapping[str, Address]
    feet: Mapping[int, float]


def build_model(
    objects: Mapping[str, FreeObject],
    table_height_m: float | None,
    sensors: Sequence[str],
    tip: TipMechanics,
    step_s: float,
    *,
    patches: bool,
    gravity_m_s2: Sequence[float] = (0.0, 0.0, -9.81),
) -> SceneModel:
    """Compile the model.

    Args:
        objects: free objects by name.
        table_height_m: height of the level plane under the objects; None for no table.
        sensors: names of the sensors that carry a tip.
        tip: mechanics of every tip.
        step_s: time step.
        patches: whether each sensor has a patch of prescribed surface in front of it.
        gravity_m_s2: in the world frame.
    """
    spec = mujoco.MjSpec()
    option = spec.option
    option.gravity = list(gravity_m_s2)
    option.timestep = step_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 1000.0
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # Auto-reset would hide a non-finite state by starting anew.
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    if table_height_m is not None:
        spec.worldbody.add_geom(
            name="table",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[2.0, 2.0, 0.1],
            pos=[0.0, 0.0, table_height_m],
        )
    for name, thing in objects.items():
        _add_object(spec, f"object/{name}", thing)
    for index, sensor in enumerate(sensors):
        own_bit = 2 << index
        _add_tip(spec, sensor, tip, own_bit)
        if patches:
            _add_patch(spec, f"patch/{sensor}", own_bit)
    model = spec.compile()
    model.opt.tolerance = _SOLVER_TOLERANCE / (model.stat.meaninertia * max(model.nv, 1))

    def address(joint: str) -> Address:
        found = model.joint(joint)
        return Address(int(found.qposadr[0]), int(found.dofadr[0]))

    return SceneModel(
        model,
        {name: address(f"object/{name}") for name in objects},
        {sensor: _tip_address(model, sensor) for sensor in sensors},
        {sensor: address(f"patch/{sensor}") for sensor in sensors} if patches else {},
        {
            geom: float(model.geom_friction[geom, 0])
            for name in objects
            for geom in np.flatnonzero(model.geom_bodyid == model.body(f"object/{name}").id).tolist()
        },
    )


def _tip_address(model: Any, sensor: str) -> TipAddress:
    first = model.joint(f"tip/{sensor}/x")
    servo = int(model.actuator(f"tip/{sensor}/x").id)
    body = int(model.body(f"tip/{sensor}").id)
    return TipAddress(int(first.qposadr[0]), int(first.dofadr[0]), servo, int(first.id), body)


def _add_tip(spec: Any, sensor: str, tip: TipMechanics, own_bit: int) -> None:
    body = spec.worldbody.add_body(
        name=f"tip/{sensor}",
        gravcomp=1.0,
        mass=tip.mass_kg,
        inertia=[tip.inertia_kg_m2] * 3,
        explicitinertial=True,
    )
    springs = {
        "x": (tip.shear_stiffness_n_m, tip.shear_damping_n_s_m),
        "y": (tip.shear_stiffness_n_m, tip.shear_damping_n_s_m),
        "z": (tip.stiffness_n_m, tip.damping_n_s_m),
        "turn": (tip.torsion_stiffness_n_m_rad, tip.torsion_damping_n_m_s),
    }
    along, about = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    # A tip rotates about x and y with its carriage only: it coasts, because friction ignores the velocity of placed
    # bodies.
    for name, kind, axis, armature in (
        ("x", along, 0, 0.0),
        ("y", along, 1, 0.0),
        ("z", along, 2, 0.0),
        ("roll", about, 0, _SWING_KG_M2),
        ("pitch", about, 1, _SWING_KG_M2),
        ("turn", about, 2, 0.0),
    ):
        joint = f"tip/{sensor}/{name}"
        stiffness, damping = springs.get(name, (0.0, 0.0))
        body.add_joint(
            name=joint,
            type=kind,
            axis=np.eye(3)[axis],
            stiffness=[stiffness, 0.0, 0.0],
            damping=[damping, 0.0, 0.0],
            armature=armature,
        )
        if name in springs:
            # The control input is the speed of the spring's other end, which so moves evenly over the physics steps.
            servo = spec.add_actuator(
                name=joint,
                target=joint,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR,
                actearly=True,
            )
            servo.gainprm[0] = stiffness
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[tip.radius_m, 0.0, 0.0],
        contype=1 | own_bit,
        conaffinity=1 | own_bit,
        condim=4,
        priority=2,
        friction=[tip.friction, tip.torsion_friction_m, 0.0001],
        solref=[0.004, 1.0],
        solimp=[0.95, 0.99, 0.0005, 0.5, 2.0],
    )


def _add_patch(spec: Any, name: str, own_bit: int) -> None:
    body = spec.worldbody.add_body(
        name=name, gravcomp=1.0, mass=_PATCH_KG, inertia=[_PATCH_KG_M2] * 3, explicitinertial=True
    )
    body.add_freejoint(name=name)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=list(_PATCH_HALF_M),
        pos=[0.0, 0.0, -_PATCH_HALF_M[2]],
        contype=own_bit,
        conaffinity=own_bit,
        mass=0.0,
    )


def _add_object(spec: Any, name: str, thing: FreeObject) -> None:
    properties = mass_properties(thing.solid)
    body = spec.worldbody.add_body(
        name=name,
        pos=thing.T_world_object[:3, 3],
        quat=quaternion(thing.T_world_object[:3, :3]),
        mass=thing.mass_kg,
        ipos=properties.com_m + np.array([*thing.center_of_mass_m, 0.0]),
        inertia=thing.mass_kg * properties.inertia_per_kg_m2,
        explicitinertial=True,
    )
    body.add_freejoint(name=name)
    contact = {
        "friction": [thing.friction, 0.005, 0.0001],
        "solref": list(_TABLE_SOLREF),
        "priority": 1,
        "mass": 0.0,
    }
    match thing.solid:
        case Ball(radius_m):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius_m, 0.0, 0.0], condim=6, **contact)
        case Turned(sections_m):
            bottom = 0.0
            for height_m, radius_m in sections_m:
                low = bottom + (_FOOT_HEIGHT_M if bottom == 0.0 else 0.0)
                top = bottom + height_m
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                    size=[radius_m, 0.5 * (top - low), 0.0],
                    pos=[0.0, 0.0, 0.5 * (top + low)],
                    **contact,
                )
                bottom = top
            _add_feet(body, thing.solid, contact)
        case Prism(outline_m, height_m):
            _add_prism(spec, body, name, outline_m, height_m, contact)
            _add_feet(body, thing.solid, contact)


def _add_prism(spec: Any, body: Any, name: str, outline_m: Array, height_m: float, contact: dict[str, Any]) -> None:
    half = 0.5 * np.ptp(outline_m, axis=0)
    half_height = 0.5 * (height_m - _FOOT_HEIGHT_M)
    middle = [0.0, 0.0, 0.5 * (height_m + _FOOT_HEIGHT_M)]
    if len(outline_m) == 4 and np.allclose(np.abs(outline_m), half):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[*half, half_height], pos=middle, **contact)
        return
    corners = [[x, y, z] for z in (-half_height, half_height) for x, y in outline_m]
    spec.add_mesh(name=name, uservert=np.ravel(corners))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=middle, **contact)


def _add_feet(body: Any, solid: Solid, contact: dict[str, Any]) -> None:
    """Add small feet on a ring where friction has the lever arm of uniform pressure.

    A flat bottom would touch at its corners alone and resist rotation almost twice as much.
    """
    if isinstance(solid, Ball):
        return
    extent = np.ptp(solid.outline_m, axis=0) if isinstance(solid, Prism) else np.ones(2)
    angles = 2.0 * math.pi * (np.arange(FEET) + 0.5) / FEET
    ring = extent * np.column_stack([np.cos(angles), np.sin(angles)])
    ring *= friction_radius_m(solid) / np.linalg.norm(ring, axis=1).mean()
    for x, y in ring:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_FOOT_RADIUS_M, 0.0, 0.0], pos=[x, y, _FOOT_RADIUS_M], **contact
        )


def quaternion(R: Array) -> Array:
    """Return [w x y z] of a rotation (3, 3)."""
    q = np.empty(4)
    mujoco.mju_mat2Quat(q, np.ascontiguousarray(R).ravel())
    return q


def rotation(q: Array) -> Array:
    """Return the rotation (3, 3) of [w x y z]."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, q)
    return R.reshape(3, 3)
