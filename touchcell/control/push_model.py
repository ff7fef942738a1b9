"""Planar mechanics of a pushed object, and what touch and arm poses tell about it.

Under quasi-static friction with an ellipsoidal limit surface (Howe & Cutkosky 1996) a force ``f`` at a contact that
sticks moves an object with ``v ~ f`` and ``omega ~ m / c^2``, its velocity ``v`` and moment ``m`` taken at the centre
of friction, ``c`` its friction radius (Lynch & Mason 1996). With the contact ``a`` behind the centre along the contact
normal and the centre ``s`` to the left of it, all forces drop out:

    (a^2 + c^2) omega = s v_n - a u_l,      v_n = u_n - s omega,      v_l = u_l + a omega,

``u`` being the velocity of the contact, n along the inward normal and l to its left. The point ``c^2 / a`` ahead of
the centre moves along a direction that is fixed in the object, ``atan(s / a)`` left of the normal, whatever the force:
there the object is a unicycle (a flat output, as the rear axle of a car is). So motion tells ``s`` and ``c``.

Motion does not tell where the object's middle is. It is the centre of friction where the centre of mass is in the
middle and nothing else presses. A follower with the normal force F and the friction force T, at a lever D and beside
the pusher's N by q, moves ``s`` by ``(q F + D T) / (N - F)``: 5 mm for 0.1 mm of shear that is misread. So middle and
``s`` are estimates of their own: touch tells the middle (``touchcell.control.edge_search``, or the normal of a round
side), motion tells ``s``.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.geometry.types import Array

_WINDOW_M: Final = 0.020
"""Travel over which a motion is compared with the model: over less of it, noise of the contact prevails."""
_LATERAL_NOISE_M: Final = 0.25e-3
_HEADING_NOISE_RAD: Final = math.radians(0.3)
_OFFSET_PRIOR_M: Final = 0.015
_LEVER_PRIOR: Final = 0.15
"""Standard deviation of ``c^2`` over its first value."""
_DRIFT_M_PER_SQRT_M: Final = 0.0015
"""Growth of the uncertainty of ``s`` over travel: what presses on the table, and where, changes ..."""
_FOLLOWED_DRIFT_M_PER_SQRT_M: Final = 0.010
"""... and where a follower presses, too."""
_CREEP_M_PER_SQRT_M: Final = 0.0005
"""The same of the middle: contacts creep by 0.1 mm in 0.3 m."""
_FEWEST_M: Final = 0.002
_SHORTEST_M: Final = 0.005
"""Travel from which a motion is compared with the model."""
_BUILDING_M: Final = 0.003
"""Travel over which a new contact's shear builds up, which is no motion of the object."""


_OPPOSITE_RAD: Final = math.radians(30.0)
"""Angle between a normal and the line to another contact up to which they are on opposite sides ..."""
_PARALLEL_RAD: Final = math.radians(4.0)
"""... and between two sides that are as good as parallel: models misread normals by a degree."""


@dataclass(frozen=True, slots=True)
class Contact:
    """Contact of a pushing tip, in top view.

    Attributes:
        x_m, y_m: point of the object at which it is pushed.
        heading_rad: direction of the inward contact normal.
        depth_m: of the indentation: the tip's centre is by its radius less this behind the point.
    """

    x_m: float
    y_m: float
    heading_rad: float
    depth_m: float = 0.0


@dataclass(frozen=True, slots=True)
class PushModel:
    """Constants of a pushed object.

    Attributes:
        reach_m: ``a``, from the contact to the centre of friction, along the normal.
        offset_m: ``s``, of the centre to the left of the contact.
        lever_m2: ``c^2``.
        middle_m: of the object's middle to the left of the contact; None where it is the centre of friction.
    """

    reach_m: float
    offset_m: float
    lever_m2: float
    middle_m: float | None = None

    @property
    def eccentricity_m(self) -> float:
        """Distance of the centre of friction to the left of the object's middle."""
        return 0.0 if self.middle_m is None else self.offset_m - self.middle_m

    @property
    def lead_m(self) -> float:
        """Distance of the point that moves as a unicycle, ahead of the centre."""
        return self.lever_m2 / self.reach_m

    @property
    def drift_rad(self) -> float:
        """Direction in which that point moves, to the left of the contact normal."""
        return math.atan2(self.offset_m, self.reach_m)

    def curvatures(self, friction: float) -> tuple[float, float]:
        """Return the smallest and largest curvature, 1/m, of that point's path inside a friction cone."""
        scale = math.cos(self.drift_rad) / self.lever_m2
        return scale * (self.offset_m - self.reach_m * friction), scale * (self.offset_m + self.reach_m * friction)

    def motion(self, speed_m_s: float, curvature: float) -> Motion:
        """Return the motion in which that point travels at ``speed_m_s`` along a path of ``curvature``, 1/m."""
        turn = curvature * speed_m_s
        ahead = speed_m_s * math.cos(self.drift_rad)
        left = (self.offset_m * ahead - self.lever_m2 * turn) / self.reach_m
        return Motion(ahead, left, turn, ahead + self.offset_m * turn, left - self.reach_m * turn)


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of a pushed object along and to the left of the contact normal.

    Attributes:
        ahead_m_s, left_m_s: velocity of its centre.
        turn_rad_s: its rate of turn, positive to the left.
        contact_ahead_m_s, contact_left_m_s: velocity of the contact.
    """

    ahead_m_s: float
    left_m_s: float
    turn_rad_s: float
    contact_ahead_m_s: float
    contact_left_m_s: float


def half_between(one: Contact, other: Contact, *, flat: bool) -> float | None:
    """Return the distance from a contact to the middle between it and one on the far side of an object.

    None where the normals are not those of a straight side and a parallel one behind it, or of a circle (not ``flat``).
    """
    dx, dy = other.x_m - one.x_m, other.y_m - one.y_m
    apart_m, chord = math.hypot(dx, dy), math.atan2(dy, dx)
    beside = math.remainder(chord - one.heading_rad, 2.0 * math.pi)
    beyond = math.remainder(chord - other.heading_rad - math.pi, 2.0 * math.pi)
    if max(abs(beside), abs(beyond)) > _OPPOSITE_RAD:
        return None
    if flat:
        return 0.5 * apart_m * math.cos(0.5 * (beside + beyond)) if abs(beside - beyond) < _PARALLEL_RAD else None
    return 0.5 * apart_m / math.cos(0.5 * (beside - beyond)) if abs(beside + beyond) < _PARALLEL_RAD else None


class PushEstimator:
    """Estimates where a pushed object's centre of friction and middle are, and its lever: a Kalman filter.

    Args:
        reach_m: from the contact to the centre along the normal.
        lever_m2: first value of ``c^2``.
        flat: True where the normal does not tell where the middle is (a flat side); a round side's points at it.
        eccentricity_m: standard deviation of the centre of friction from the middle.
        followed: True where a follower presses, too.
    """

    def __init__(
        self, reach_m: float, lever_m2: float, *, flat: bool = True, eccentricity_m: float = 0.0, followed: bool = False
    ) -> None:
        self._reach_m = reach_m
        self._first_lever_m2 = lever_m2
        self._flat = flat
        self._eccentricity_m = max(eccentricity_m, 1e-6)
        drift = _FOLLOWED_DRIFT_M_PER_SQRT_M if followed else _DRIFT_M_PER_SQRT_M
        # Growth of the covariance of offset, lever and middle over travel.
        self._drift = np.diag([drift**2, 0.0, _CREEP_M_PER_SQRT_M**2]) if flat or followed else np.zeros((3, 3))
        self._mean = np.array([0.0, lever_m2, 0.0])
        self._covariance = np.diag([0.0, (_LEVER_PRIOR * lever_m2) ** 2, 0.0])
        # Of each contact so far: travel, way to the left in the object's frame, heading.
        self._past: deque[tuple[float, float, float]] = deque()
        self.move_contact(0.0, _OFFSET_PRIOR_M if flat else 0.0)

    def change_reach(self, reach_m: float) -> None:
        """Take the centre to be at another distance along the normal; the lever is that of a larger object, then."""
        scale = (reach_m / self._reach_m) ** 2
        self._reach_m = reach_m
        self._mean[1] *= scale
        self._covariance[1, :] *= scale
        self._covariance[:, 1] *= scale

    def shift(self, left_m: float) -> None:
        """Take the object to be farther to the left of its contact by a distance than was known."""
        self._mean[::2] += left_m

    def move_contact(self, middle_m: float, sigma_m: float, *, keep_eccentricity: bool = False) -> None:
        """Begin again with another contact of the same object.

        Args:
            middle_m: of the object's middle to the left of it.
            sigma_m: standard deviation of that.
            keep_eccentricity: the centre of friction is where it was beside the middle, as well as that was known.
        """
        P, x = self._covariance, self._mean
        eccentricity_m, variance = 0.0, self._eccentricity_m**2
        if keep_eccentricity:
            eccentricity_m = float(x[0] - x[2])
            variance = min(max(float(P[0, 0] + P[2, 2] - 2.0 * P[0, 2]), 0.0), variance)
        self._mean = np.array([middle_m + eccentricity_m, x[1], middle_m])
        shared = sigma_m**2
        self._covariance = np.array([[shared + variance, 0.0, shared], [0.0, P[1, 1], 0.0], [shared, 0.0, shared]])
        self._past.clear()
        self._last: Contact | None = None
        self._used_m = 0.0

    @property
    def model(self) -> PushModel:
        """The object as it is estimated."""
        offset_m, lever_m2, middle_m = self._mean.tolist()
        return PushModel(self._reach_m, offset_m, lever_m2, middle_m)

    @property
    def offset_sigma_m(self) -> float:
        """Standard deviation of the offset."""
        return math.sqrt(max(float(self._covariance[0, 0]), 0.0))

    @property
    def middle_sigma_m(self) -> float:
        """Standard deviation of the middle."""
        return math.sqrt(max(float(self._covariance[2, 2]), 0.0))

    def update(self, contact: Contact) -> None:
        """Take a new contact into account."""
        last, self._last = self._last, contact
        if last is None:
            self._past.append((0.0, 0.0, contact.heading_rad))
            return
        turned = math.remainder(contact.heading_rad - last.heading_rad, 2.0 * math.pi)
        middle = last.heading_rad + 0.5 * turned
        dx, dy = contact.x_m - last.x_m, contact.y_m - last.y_m
        travel, left, heading = self._past[-1]
        travel += math.cos(middle) * dx + math.sin(middle) * dy
        left += -math.sin(middle) * dx + math.cos(middle) * dy
        self._past.append((travel, left, heading + turned))
        while len(self._past) > 2 and travel - self._past[1][0] > _WINDOW_M:
            self._past.popleft()
        if travel < _BUILDING_M:
            self._past = deque([self._past[-1]])
        elif travel - self._used_m >= _FEWEST_M and travel - self._past[0][0] >= _SHORTEST_M:
            self._correct(travel - self._used_m)
            self._used_m = travel

    def _correct(self, since_m: float) -> None:
        a = self._reach_m
        (travel0, left0, heading0), (travel1, left1, heading1) = self._past[0], self._past[-1]
        travel, left, turn = travel1 - travel0, left1 - left0, heading1 - heading0
        # Along the normal the contact moves by s omega more than the centre.
        s = float(self._mean[0])
        H = np.array([travel - s * turn, -turn, 0.0])
        # Windows overlap: each frame's noise is counted as often as it is used.
        shared = max(travel / max(since_m, _FEWEST_M), 1.0)
        noise = 2.0 * shared * ((a * _LATERAL_NOISE_M) ** 2 + (a * a * _HEADING_NOISE_RAD) ** 2)
        P = self._covariance + since_m * self._drift
        gain: Array = P @ H / (H @ P @ H + noise)
        self._mean = self._mean + gain * (a * a * turn + a * left - H @ self._mean)
        self._covariance = P - np.outer(gain, H @ P)
        reach_sq = a * a
        self._mean[::2] = np.clip(self._mean[::2], -1.2 * a, 1.2 * a)
        self._mean[1] = min(max(float(self._mean[1]), 0.25 * reach_sq), 1.5 * reach_sq)
