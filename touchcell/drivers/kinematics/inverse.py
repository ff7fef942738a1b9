"""Numerical inverse kinematics for a tool pose, from a nearby joint configuration."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_STEPS = 200
_DAMPING_M = 0.02
_LARGEST_STEP_RAD = 0.3
_CLOSE = 1e-9
_MARGIN_RAD = 0.02


def joints_for_pose(chain: SerialChain, T_base_tcp: Array, q_near: Array) -> Array:
    """Return joint angles (n,) rad within the limits at which the tool is at ``T_base_tcp`` (4, 4).

    Damped Gauss-Newton steps (Levenberg) from ``q_near`` (n,); angles beyond a limit are clamped to it. Converges to
    the solution in whose basin of attraction ``q_near`` lies, if any.

    Raises:
        ConfigError: no solution was found.
    """
    q = np.clip(q_near, chain.lower + _MARGIN_RAD, chain.upper - _MARGIN_RAD)
    for _ in range(_STEPS):
        T_now, J = chain.forward_and_jacobian(q)
        error = np.concatenate([T_base_tcp[:3, 3] - T_now[:3, 3], se3.log(_turn(T_now, T_base_tcp))[3:]])
        if float(np.abs(error).max()) < _CLOSE:
            return q
        damping = min(_DAMPING_M, float(np.linalg.norm(error)))
        step = J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(6), error)
        largest = float(np.abs(step).max())
        q = q + step * min(1.0, _LARGEST_STEP_RAD / largest)
        q = np.clip(q, chain.lower + _MARGIN_RAD, chain.upper - _MARGIN_RAD)
    raise ConfigError(
        f"no inverse kinematics solution: {1e3 * float(np.linalg.norm(error[:3])):.1f} mm and "
        f"{float(np.degrees(np.linalg.norm(error[3:]))):.1f} deg remain",
        value=se3.to_euler_mm_deg(T_base_tcp).round(1).tolist(),
        hint="move the pose closer to the base, or set near_joints_deg to a configuration closer to the solution",
    )


def _turn(T_from: Array, T_to: Array) -> Array:
    """Return the rotation from one pose to the other along base axes, as a pose."""
    T = np.eye(4)
    T[:3, :3] = T_to[:3, :3] @ T_from[:3, :3].T
    return T
