"""Project twists to the feasible motions of arms with fewer than six joints: linear part first, then rotation.

A least-squares compromise would push the tip off its path for a rotation that the arm cannot make. So the joints follow
the linear velocity, and only motion in the null space of the tip position serves the angular one (task priority, after
Nakamura, Hanafusa & Yoshikawa 1987).
"""

from __future__ import annotations

import numpy as np

from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry.types import Array

_SHORTEST_LEVER_M = 0.01
_SMALLEST_TURN = 0.05
_NEGLIGIBLE_M_S = 1e-5
_NEGLIGIBLE_RAD_S = 1e-4


def project_to_feasible(J: Array, twist: Array) -> tuple[Array, tuple[Adjustment, ...]]:
    """Project ``twist`` (6,) onto the feasible motions of the joints.

    Args:
        J: (6, n) geometric Jacobian along base axes.
        twist: (6,) [v, w] along base axes.

    Returns:
        The feasible twist, and one adjustment per part (linear, angular) that differs, with the norms of that part. The
        arm may rotate without being commanded to, where the tip cannot move otherwise.
    """
    linear, angular = J[:3], J[3:]
    push = np.linalg.pinv(linear, rcond=_relative(linear, _SHORTEST_LEVER_M))
    dq = push @ twist[:3]
    turn = angular @ (np.eye(J.shape[1]) - push @ linear)
    dq = dq + np.linalg.pinv(turn, rcond=_relative(turn, _SMALLEST_TURN)) @ (twist[3:] - angular @ dq)
    followed = J @ dq
    adjustments = []
    for name, part, negligible in (
        ("joints: linear", slice(0, 3), _NEGLIGIBLE_M_S),
        ("joints: angular", slice(3, 6), _NEGLIGIBLE_RAD_S),
    ):
        if np.linalg.norm(twist[part] - followed[part]) > negligible:
            norms = float(np.linalg.norm(twist[part])), float(np.linalg.norm(followed[part]))
            adjustments.append(Adjustment(name, *norms))
    return followed, tuple(adjustments)


def _relative(matrix: Array, smallest: float) -> float:
    """Return ``smallest`` as a fraction of the largest singular value."""
    return smallest / max(float(np.linalg.norm(matrix, 2)), smallest)
