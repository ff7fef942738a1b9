"""Dynamics of one described arm by MuJoCo: links as rods, joints under a position servo with velocity feed-forward.

Links may also come from MuJoCo Menagerie (``menagerie.py``).

The arm is a model of its own, without contacts: contact forces on its tool come from the scene, one step of the scene
late. That is stable because a tip is soft (1.5 N/mm against some 5 kg at the tool: 3 rad/s per step of 2 ms), and lets
every arm work in every scene. Imported only for such an arm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from touchcell.drivers.kinematics.chain import ChainDescription, Tool
from touchcell.geometry.types import Array
from touchcell.geometry.vectors import cross
from touchcell.simulation.dynamics_model import quaternion

_ROD_RADIUS_M = 0.05
_ROTOR_KG_M2 = 0.1
_TOOL_RADIUS_M = 0.03
# Per newton metre of maximum torque: full torque at 1.1 deg of error, as stiff as position-controlled arms are.
_GAIN_PER_RAD = 52.0
_DAMPING_S = 0.1
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class ArmDynamics:
    """Dynamics of one arm on a fixed base.

    Args:
        description: joints and links.
        tool: tool on the flange.
        q: (n,) rad, initial joint angles.
        step_s: time step of the physics.
        links: an MjSpec of joints and links without motors, its last link, and the pose (4, 4) of the flange on it;
            rods along the chain by default.
    """

    def __init__(
        self,
        description: ChainDescription,
        tool: Tool,
        q: Array,
        step_s: float,
        links: tuple[Any, Any, Array] | None = None,
    ) -> None:
        spec, last, T_last_flange = links or _rods(description)
        self._model = _build(spec, last, T_last_flange, description, tool, step_s)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = q
        self._last = self._model.nbody - 1
        self.set_target(q, np.zeros_like(q))
        mujoco.mj_forward(self._model, self._data)

    @property
    def q(self) -> Array:
        """Joint angles (n,) rad."""
        return self._data.qpos.copy()  # type: ignore[no-any-return]

    @property
    def dq(self) -> Array:
        """Joint velocities (n,) rad/s."""
        return self._data.qvel.copy()  # type: ignore[no-any-return]

    @property
    def torque(self) -> Array:
        """Motor torques (n,) N m in addition to gravity compensation."""
        return self._data.qfrc_actuator.copy()  # type: ignore[no-any-return]

    def T_base_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the present pose (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self._data.site_xmat[0].reshape(3, 3)
        T[:3, 3] = self._data.site_xpos[0]
        return T

    def set_target(self, q: Array, dq: Array) -> None:
        """Set the servo target ``q`` (n,) rad, with velocity feed-forward ``dq`` (n,) rad/s."""
        self._data.ctrl[:] = q + _DAMPING_S * dq

    def apply_force(self, force: Array, point: Array) -> None:
        """Apply ``force`` (3,) N at ``point`` (3,) m on the last link from now on, both in the base frame."""
        self._data.xfrc_applied[self._last, :3] = force
        self._data.xfrc_applied[self._last, 3:] = cross(point - self._data.xipos[self._last], force)

    def step(self, steps: int) -> None:
        """Advance by that many time steps."""
        mujoco.mj_step(self._model, self._data, steps)
        mujoco.mj_kinematics(self._model, self._data)

    def snapshot(self) -> Callable[[], None]:
        """Return a function that restores joints, target and load."""
        state = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_getState(self._model, self._data, state, _STATE)

        def restore() -> None:
            mujoco.mj_setState(self._model, self._data, state, _STATE)
            mujoco.mj_forward(self._model, self._data)

        return restore


def _rods(description: ChainDescription) -> tuple[Any, Any, Array]:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    ends = [np.array(joint.origin_mm) * 1e-3 for joint in description.joints[1:]]
    ends.append(np.array(description.flange.origin_mm) * 1e-3)
    for joint, end in zip(description.joints, ends, strict=True):
        placement = joint.pose()
        body = body.add_body(
            name=joint.name,
            pos=placement[:3, 3],
            quat=quaternion(placement[:3, :3]),
            gravcomp=1.0,
            mass=max(joint.mass_kg, 0.1),
            ipos=np.array(joint.com_mm) * 1e-3,
            inertia=_rod_inertia(max(joint.mass_kg, 0.1), end),
            explicitinertial=True,
        )
        body.add_joint(
            name=joint.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=joint.axis,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=np.deg2rad([joint.lower_deg, joint.upper_deg]),
            armature=_ROTOR_KG_M2,
        )
    return spec, body, description.flange.pose()


def _build(spec: Any, last: Any, T_last_flange: Array, description: ChainDescription, tool: Tool, step_s: float) -> Any:
    """Compile the model with motors and tool."""
    spec.option.timestep = step_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    for hinge, joint in zip(spec.joints, description.joints, strict=True):
        gain = _GAIN_PER_RAD * joint.torque_n_m
        spec.add_actuator(
            name=hinge.name,
            target=hinge.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=_padded(gain),
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=_padded(0.0, -gain, -_DAMPING_S * gain),
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=[-joint.torque_n_m, joint.torque_n_m],
        )
    mass_kg = max(tool.mass_kg, 0.01)
    body = last.add_body(
        name="tool",
        pos=T_last_flange[:3, 3],
        quat=quaternion(T_last_flange[:3, :3]),
        gravcomp=1.0,
        mass=mass_kg,
        ipos=np.array(tool.com_mm) * 1e-3,
        inertia=[0.4 * mass_kg * _TOOL_RADIUS_M**2] * 3,
        explicitinertial=True,
    )
    T_flange_tcp = tool.pose()
    body.add_site(name="tcp", pos=T_flange_tcp[:3, 3], quat=quaternion(T_flange_tcp[:3, :3]))
    return spec.compile()


def _rod_inertia(mass_kg: float, end_m: Array) -> Array:
    """Return (3,) of a rod from the link's joint to the next, about its centre, along the link's axes; never thin."""
    length = end_m @ end_m
    across = mass_kg * (3.0 * _ROD_RADIUS_M**2 + length) / 12.0
    along = 0.5 * mass_kg * _ROD_RADIUS_M**2
    share = end_m**2 / length if length > 0.0 else np.zeros(3)
    inertia: Array = across + (along - across) * share
    return inertia


def _padded(*values: float) -> Array:
    parameters = np.zeros(10)
    parameters[: len(values)] = values
    return parameters
