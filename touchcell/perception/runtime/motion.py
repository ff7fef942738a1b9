"""Pose of the sensor at the capture time of a frame: a short history of poses with interpolation on SE(3)."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array


class PoseHistory:
    """Recent poses of a sensor in a fixed frame.

    Args:
        keep_s: duration of the history.
    """

    def __init__(self, keep_s: float = 1.0) -> None:
        self._keep_ns = round(keep_s * 1e9)
        self._times_ns: deque[int] = deque()
        self._poses: deque[Array] = deque()

    def __len__(self) -> int:
        return len(self._times_ns)

    def record(self, t_ns: int, T_base_sensor: Array) -> None:
        """Append a pose (4, 4); one that is not newer than the last is ignored."""
        if self._times_ns and t_ns <= self._times_ns[-1]:
            return
        self._times_ns.append(t_ns)
        self._poses.append(T_base_sensor)
        while self._times_ns[0] < t_ns - self._keep_ns and len(self._times_ns) > 2:
            self._times_ns.popleft()
            self._poses.popleft()

    def at(self, t_ns: int) -> Array:
        """Return the pose (4, 4) at ``t_ns``: on the geodesic between its neighbours, or the nearest recorded one.

        Raises:
            LookupError: no pose has been recorded.
        """
        if not self._times_ns:
            raise LookupError("no pose of the sensor has been recorded yet")
        after = bisect_left(self._times_ns, t_ns)
        if after == 0:
            return self._poses[0]
        if after == len(self._times_ns):
            return self._poses[-1]
        t0_ns, t1_ns = self._times_ns[after - 1], self._times_ns[after]
        T0, T1 = self._poses[after - 1], self._poses[after]
        fraction = (t_ns - t0_ns) / (t1_ns - t0_ns)
        step: Array = se3.log(np.asarray(se3.compose(se3.inverse(T0), T1)))
        return se3.compose(T0, se3.exp(fraction * step))
