"""Where a sensor first touched, from how its image changes as the arm moves on: depth without a model.

The image of a soft tip changes in proportion to depth while that is small, whatever the camera and the skin are. So the
change over that per advance of the arm is the depth, as long as the object rests; the difference from what a model
reads is the model's error there. Timestamps of frames may all be late by the same, which leaves the change per advance
as it is; the depth is that of a frame taken at rest. Pressed in farther, the depth grows with the arm's advance until
the object gives way, which shows how the error grows.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import Final

import numpy as np

from touchcell.geometry.types import Array

_FIRST_CHANGE: Final = 0.012
"""Change from which a frame counts: less is noise ..."""
LAST_CHANGE: Final = 0.2
"""... and to which: the change of deeper contacts is no straight line ..."""
_LAST_AT_REST: Final = 0.3
"""... by much, up to 2 mm or so."""
_FEWEST: Final = 3
_STRAIGHT: Final = 0.6
"""Share of the steepest growth of the change from which the object still rests."""
_AT_REST_M: Final = 0.1e-3
"""Way within the last poses from which the sensor does not rest: of one that sways, the ends may be at one place."""
_UNSHEARED_M: Final = 0.1e-3
"""Distance from the line of the approach up to which the contact is not sheared."""
_NOW: Final = 4
"""Last poses that tell whether the sensor still moves ..."""
_EVEN: Final = 0.8
"""... as fast as before."""
_ALONG: Final = 0.9
"""Share of a motion that is along the sensor's axis if it is an approach."""
_MOST_TURN: Final = 0.9998
"""Cosine of the turn (1.1 deg) up to which the sensor's motion is a straight one."""
_MOST_TURN_AT_REST: Final = 0.99
"""The same (8 deg) of one that has made contact, and turns to face it: that leaves a round tip as deep as it is."""
_HISTORY_NS: Final = 200_000_000
_WINDOW: Final = 3
"""Frames over which the depth is to grow with the arm's advance while the object rests ..."""
_SHORTEST_PRESS_M: Final = 0.4e-3
_RESTING: Final = 0.8
"""... and the share of it by which it has to."""
LARGEST_M: Final = 1.5e-3
"""A larger error is none of the model's depth: something else has changed the image."""


class TouchZero:
    """Records one approach along a sensor's axis, and how it is pressed in from then on until the object gives way."""

    def __init__(self) -> None:
        self._start: Array | None = None
        self._poses: deque[tuple[int, Array]] = deque()
        self._moving: list[tuple[float, float]] = []
        self._seq = -1
        self._approached = False
        self._approaching: Array | None = None
        self._touched_error_m = 0.0
        self._pressed: list[tuple[float, float]] = []
        self.ended = False
        """True once the error is known as well as it will be."""
        self.error_m: float | None = None
        """Depth that the model reads beyond what the arm's motion says; None while it is not known."""
        self.change_per_m: float | None = None
        """Change of the image per depth, while that is small; None while it is not known."""
        self.advance_error_m = 0.0
        """The error at the touch, once it is known, by how far the arm has advanced beyond where the change began."""

    def moved(self, t_ns: int, T_base_sensor: Array) -> None:
        """Take note of the sensor's pose (4, 4)."""
        if self._start is None:
            self._start = T_base_sensor
        if not self._poses or t_ns > self._poses[-1][0]:
            self._poses.append((t_ns, T_base_sensor))
        while t_ns - self._poses[0][0] > _HISTORY_NS:
            self._poses.popleft()

    def saw(self, t_frame_ns: int, seq: int, change: float, T_s_f: Array | None) -> None:
        """Take a frame into account: how much it has changed, and the contact (4, 4) that a model reads in it alone."""
        if seq == self._seq or self.ended or self._start is None or len(self._poses) < 2:
            return
        self._seq = seq
        straight = float(self._start[:3, 2] @ self._poses[-1][1][:3, 2])
        if straight < (_MOST_TURN_AT_REST if self.error_m is None and self._moving else _MOST_TURN):
            self.ended = self.ended or bool(self._pressed)
        elif self.error_m is not None:
            self._press(self._advance_m(t_frame_ns), T_s_f)
        elif self._moves():
            speed_m_s, now_m_s = self._speed_m_s(0), self._speed_m_s(-_NOW)
            # Not while it slows down: frames that are late would then show less than there is. Nor while it is
            # shifted aside: shear changes the image as much as depth does.
            if self._approached or not _FIRST_CHANGE < change < LAST_CHANGE:
                return
            if now_m_s > _EVEN * speed_m_s and self._advances(now_m_s):
                self._moving.append((self._advance_m(t_frame_ns), change))
                self._approaching = self._poses[-1][1]
            else:
                self._approached = len(self._moving) >= _FEWEST
        elif T_s_f is not None and _FIRST_CHANGE < change < _LAST_AT_REST and self._has_approached():
            self._conclude(self._advance_m(t_frame_ns), change, T_s_f)

    def _press(self, advance_m: float, T_s_f: Array | None) -> None:
        """Follow the error while the arm presses on, until the object gives way."""
        if T_s_f is None:
            self.ended = True
            return
        self._pressed.append((advance_m * float(T_s_f[2, 2]), depth_of(T_s_f)))
        if len(self._pressed) <= _WINDOW:
            return
        (along0_m, depth0_m), (along_m, depth_m) = self._pressed[-1 - _WINDOW], self._pressed[-1]
        if along_m - along0_m < _SHORTEST_PRESS_M:
            return
        if depth_m - depth0_m < _RESTING * (along_m - along0_m):
            self.ended = True
            return
        (rest_m, read_m), touched_error_m = self._pressed[0], self._touched_error_m
        error_m = touched_error_m + (depth0_m - read_m) - (along0_m - rest_m)
        if abs(error_m) < LARGEST_M:
            self.error_m = error_m

    def _while_resting(self) -> list[tuple[float, float]]:
        """Return the advances and changes up to which the change kept growing: then a light object gives way."""
        steepest = 0.0
        for count, (one, other) in enumerate(pairwise(self._moving), 1):
            slope = (other[1] - one[1]) / max(other[0] - one[0], 1e-6)
            if slope < _STRAIGHT * steepest:
                return self._moving[:count]
            steepest = max(steepest, slope)
        return self._moving

    def _speed_m_s(self, since: int) -> float:
        """Return the mean speed since one of the poses that were noted."""
        (then_ns, then), (now_ns, now) = self._poses[max(since, -len(self._poses))], self._poses[-1]
        return float(np.linalg.norm(now[:3, 3] - then[:3, 3])) / max(1e-9 * (now_ns - then_ns), 1e-9)

    def _moves(self) -> bool:
        """Return True if the sensor has moved within the last poses."""
        points = np.array([T[:3, 3] for _, T in self._poses])
        return float(np.linalg.norm(points - points[-1], axis=1).max()) > _AT_REST_M

    def _has_approached(self) -> bool:
        """Return True if the approach is known, and the sensor is on its line."""
        if self._approaching is None or len(self._moving) < _FEWEST:
            return False
        way, axis = self._poses[-1][1][:3, 3] - self._approaching[:3, 3], self._approaching[:3, 2]
        return float(np.linalg.norm(way - (way @ axis) * axis)) < _UNSHEARED_M

    def _advances(self, speed_m_s: float) -> bool:
        """Return True if the sensor now moves along its axis, at that speed."""
        (then_ns, then), (now_ns, now) = self._poses[-min(_NOW, len(self._poses))], self._poses[-1]
        along_m = float((now[:3, 3] - then[:3, 3]) @ now[:3, 2])
        return along_m > _ALONG * speed_m_s * 1e-9 * (now_ns - then_ns)

    def _advance_m(self, t_ns: int) -> float:
        """Return how far the sensor had moved along its axis at a time, between the poses that were noted."""
        assert self._start is not None
        times = np.array([t for t, _ in self._poses], np.float64) - t_ns
        along = [float((T[:3, 3] - self._start[:3, 3]) @ self._start[:3, 2]) for _, T in self._poses]
        return float(np.interp(0.0, times, along))

    def _conclude(self, advance_m: float, change: float, T_s_f: Array) -> None:
        advances, changes = np.array(self._while_resting()).T
        spread = advances - advances.mean()
        if float(spread @ spread) < 1e-9:
            return
        slope = float(spread @ changes / (spread @ spread))
        if slope <= 0.0:
            return
        # The arm advances along the sensor's axis, and depth is along the normal.
        depth_m = change / slope * float(T_s_f[2, 2])
        error_m = depth_of(T_s_f) - depth_m
        if abs(error_m) < LARGEST_M:
            self.error_m = self._touched_error_m = error_m
            self.change_per_m = change / depth_m
            began_m = float(advances.mean() - changes.mean() / slope)
            self.advance_error_m = depth_of(T_s_f) - (advance_m - began_m) * float(T_s_f[2, 2])
            self._pressed.append((advance_m * float(T_s_f[2, 2]), depth_of(T_s_f)))


def depth_of(T_s_f: Array) -> float:
    """Return the depth, m, of a contact (4, 4)."""
    return max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
