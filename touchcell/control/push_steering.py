"""Predictive steering of a pushed object: the path of least curvature from its estimated pose to the target.

The estimated object is a unicycle at a point ``d`` ahead of its centre (``touchcell.control.push_model``), so that the
centre swings out by ``-d`` per turn. Over the distance ``L`` that is left a path of curvature ``k(x)`` takes the centre
to the left by the integral of ``(L - d - x) k`` and turns it by that of ``k``, to first order. Of all paths that
arrive, the one with the least integral of ``k^2`` has a curvature linear in ``x``, with the value now

    3 y (L - d) / ((L - d)^3 + d^3 + r^3)                where the heading at the target is free,
    psi / L + 6 (y - (L / 2 - d) psi) / L^2              where it has to turn by ``psi``,

``y`` being the target's offset to the left, and ``r`` a length within which the last tenths of a millimetre are not
worth the curvature: so near, it would follow the noise of the contact. It is planned anew in each cycle:
model-predictive control (linear dynamics, quadratic cost, a terminal constraint) in closed form. The friction cone
bounds the curvature.

Where the heading is free, that curvature is the way that is left less ``d``, times a slope that stays the same while
all goes as planned. Most of what moves the centre aside is done in the last centimetre, the other way round, where one
frame's normal would change it by too much: there the plan that was made before is carried out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from touchcell.control.path import Point
from touchcell.control.push_model import PushModel

_SHORTEST_M: Final = 0.012
"""Way below which nothing is planned anew: noise would prevail, and each turn swings its centre aside."""
_CALM_M: Final = 0.012
"""The length r."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in top view, m and rad."""

    x: float
    y: float
    heading: float

    def ahead(self, distance: float, direction: float = 0.0) -> Pose:
        """Return the pose at a distance in a direction, rad to the left of the heading."""
        angle = self.heading + direction
        return Pose(self.x + distance * math.cos(angle), self.y + distance * math.sin(angle), self.heading)

    def local(self, point: Point) -> Point:
        """Return a point in this pose's own frame."""
        dx, dy = point[0] - self.x, point[1] - self.y
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return cos * dx + sin * dy, cos * dy - sin * dx


@dataclass(frozen=True, slots=True)
class Plan:
    """What steers the object now.

    Attributes:
        curvature: of the unicycle's path, 1/m, inside the friction cone.
        wanted: the same without that limit.
        remaining_m: way to the target.
        miss_m: by how much the target will be missed, because the friction cone does not allow what is wanted.
        slope: of the wanted curvature over the way, 1/m^2, where the heading at the target is free.
    """

    curvature: float
    wanted: float
    remaining_m: float
    miss_m: float = 0.0
    slope: float = 0.0

    @property
    def limited(self) -> bool:
        """True if the friction cone does not allow what is wanted."""
        return abs(self.wanted - self.curvature) > 1e-9


def steer(
    center: Pose, model: PushModel, target: Point, goal_heading: float | None, friction: float, before: Plan
) -> Plan:
    """Return the plan that takes an object's centre to the target.

    Args:
        center: the centre of friction, with the heading of the contact normal.
        model: the object.
        target: where the object's middle is to arrive.
        goal_heading: of the contact normal there, rad; None where it is free.
        friction: slope of the friction cone that may be used.
        before: the plan so far, whose slope or, where a heading is asked for, curvature counts where the target is too
            near to plan anew.
    """
    lowest, highest = model.curvatures(friction)
    # The centre, moving as the unicycle does: parallel to it while the path is straight, and swinging behind it.
    moving = Pose(center.x, center.y, center.heading + model.drift_rad)
    # The middle arrives where the centre of friction arrives beside it: nearly so with the present heading, and exactly
    # so at the end.
    beside = Pose(*target, center.heading).ahead(model.eccentricity_m, 0.5 * math.pi)
    ahead, left = moving.local((beside.x, beside.y))
    length, swing = math.hypot(ahead, left), model.lead_m * math.cos(model.drift_rad)
    slope = before.slope
    if goal_heading is None:
        if ahead > _SHORTEST_M:
            slope = 3.0 * left / ((length - swing) ** 3 + swing**3 + _CALM_M**3)
        wanted = slope * (max(ahead, 0.0) - swing if ahead < _SHORTEST_M else length - swing)
    elif ahead < _SHORTEST_M:
        wanted = before.curvature
    else:
        turn = math.remainder(goal_heading - center.heading, 2.0 * math.pi)
        wanted = turn / length + 6.0 * (left - (0.5 * length - swing) * turn) / length**2
    allowed = min(max(wanted, lowest), highest)
    # Effects of the curvature on the end are linear in it.
    miss_m = 0.0
    if wanted != allowed:
        miss_m = math.hypot(left, swing) * abs(wanted - allowed) / max(abs(wanted), abs(allowed))
    return Plan(allowed, wanted, ahead, miss_m, slope)
