"""Kinematics of e-Series and CB3 arms: flange pose and velocity for given joint angles and speeds.

Denavit-Hartenberg parameters: Universal Robots, "DH parameters for calculations of kinematics and dynamics". A real arm
differs by millimetres, because each has its own calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array

JOINTS = 6


class Model(NamedTuple):
    """Lengths of one model, m: offsets along the joints' axes and lengths of the links."""

    d_m: tuple[float, float, float, float, float, float]
    a_m: tuple[float, float, float, float, float, float]


UR5E = Model((0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996), (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0))
MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "ur3e": Model((0.15185, 0.0, 0.0, 0.13105, 0.08535, 0.0921), (0.0, -0.24355, -0.2132, 0.0, 0.0, 0.0)),
        "ur5e": UR5E,
        "ur10e": Model((0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655), (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)),
        "ur3": Model((0.1519, 0.0, 0.0, 0.11235, 0.08535, 0.0819), (0.0, -0.24365, -0.21325, 0.0, 0.0, 0.0)),
        "ur5": Model((0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823), (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)),
        "ur10": Model((0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922), (0.0, -0.612, -0.5723, 0.0, 0.0, 0.0)),
        "ur16e": Model((0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655), (0.0, -0.4784, -0.36, 0.0, 0.0, 0.0)),
    }
)
_ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
_SIN_ALPHA = tuple(math.sin(alpha) for alpha in _ALPHA)
_COS_ALPHA = tuple(math.cos(alpha) for alpha in _ALPHA)
_DAMPING = 1e-3


def forward(q: Array, T_flange_tcp: Array, model: Model = UR5E) -> tuple[Array, Array]:
    """Return pose ``T_base_tcp`` (4, 4), and Jacobian (6, 6) from joint speeds to [v, w] of the TCP along base axes."""
    T = np.eye(4)
    origins = np.empty((JOINTS, 3))
    axes = np.empty((JOINTS, 3))
    for i in range(JOINTS):
        origins[i] = T[:3, 3]
        axes[i] = T[:3, 2]
        c, s = math.cos(q[i]), math.sin(q[i])
        ca, sa = _COS_ALPHA[i], _SIN_ALPHA[i]
        T = T @ np.array(
            [
                [c, -s * ca, s * sa, model.a_m[i] * c],
                [s, c * ca, -c * sa, model.a_m[i] * s],
                [0, sa, ca, model.d_m[i]],
                [0, 0, 0, 1],
            ]
        )
    T = T @ T_flange_tcp
    arms = T[:3, 3] - origins
    J = np.empty((6, JOINTS))
    J[0] = axes[:, 1] * arms[:, 2] - axes[:, 2] * arms[:, 1]
    J[1] = axes[:, 2] * arms[:, 0] - axes[:, 0] * arms[:, 2]
    J[2] = axes[:, 0] * arms[:, 1] - axes[:, 1] * arms[:, 0]
    J[3:] = axes.T
    return T, J


def joint_speeds(J: Array, twist: Array) -> Array:
    """Return joint speeds (6,) for a twist (6,) along base axes; damped, so they stay finite at a singularity."""
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(6), twist))


def inverse(T_base_tcp: Array, q_near: Array, T_flange_tcp: Array, model: Model = UR5E) -> Array | None:
    """Return joint angles (6,) near ``q_near`` that reach the pose to 1 nm and 1 nrad, or None if Newton fails."""
    q = q_near.copy()
    for _ in range(50):
        T, J = forward(q, T_flange_tcp, model)
        error = np.concatenate([T_base_tcp[:3, 3] - T[:3, 3], rotation_vector(T_base_tcp[:3, :3] @ T[:3, :3].T)])
        if float(np.abs(error).max()) < 1e-9:
            return q
        step = joint_speeds(J, error)
        q = q + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
    return None


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector (3,) of a rotation matrix."""
    T = np.eye(4)
    T[:3, :3] = R
    return np.asarray(se3.log(T)[3:])


def pose_vector(T: Array) -> Array:
    """Return Universal Robots' pose (6,) [x y z rx ry rz]: metres and a rotation vector."""
    return np.concatenate([T[:3, 3], rotation_vector(T[:3, :3])])


def from_pose_vector(p: Array) -> Array:
    """Return the pose (4, 4) of [x y z rx ry rz]."""
    T = np.asarray(se3.exp(np.concatenate([np.zeros(3), p[3:]])))
    T[:3, 3] = p[:3]
    return T
