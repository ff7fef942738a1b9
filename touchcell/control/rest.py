"""Whether arms are at rest: by their measured speeds, or by their positions where the speeds are noise."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from touchcell.control.interlocks.snapshot import CellView
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry.types import Array

WINDOW_NS: Final = 550_000_000
"""States older than this are forgotten, and an arm whose newest one is as old is not known to be at rest."""
STOOD_FOR_NS: Final = 450_000_000
"""Positions are judged over at least this long."""
LONGEST_GAP_NS: Final = 150_000_000
"""A motion there and back may hide between states that are further apart."""
STARTED_NS: Final = 100_000_000
"""A motion that has only just begun has hardly changed the position yet."""
_MOST_SEEN: Final = 1000


class RestMonitor:
    """Decide from the states of the last half a second whether an arm is at rest.

    Motors that report speed in steps of some mrad/s never report 0: a speed of 12 bits is coarser than 1 mm/s at the
    tool, a position of 16 bits is not. So an arm is also at rest if the positions that it had in this time are no
    further apart than the speeds at rest allow, and its newest speed is nothing unusual: at most twice what it measured
    while it stood. What stays unseen is a vibration of a quarter of a millimetre.

    Args:
        rest_m_s, rest_rad_s: an arm whose measured speeds are at most these is at rest.
    """

    def __init__(self, rest_m_s: float, rest_rad_s: float) -> None:
        self._rest = np.array([rest_m_s, rest_rad_s])
        self._seen: dict[str, deque[Stamped[TcpState]]] = {}

    def note(self, view: CellView) -> None:
        """Remember the state of every arm in ``view``."""
        for role, arm in view.arms.items():
            seen = self._seen.setdefault(role, deque(maxlen=_MOST_SEEN))
            seen.append(arm.state)
            while not 0 <= arm.state.t_ns - seen[0].t_ns <= WINDOW_NS:
                seen.popleft()

    def at_rest(self, view: CellView) -> bool:
        """Return whether every arm is at rest now; ``view`` is the one that was noted last."""
        return all(
            abs(view.now_ns - arm.state.t_ns) <= WINDOW_NS
            and (self._is_slow(arm.state) or self._has_stood(role, view.now_ns))
            for role, arm in view.arms.items()
        )

    def _is_slow(self, state: Stamped[TcpState]) -> bool:
        return bool((_norms(state.value.twist) <= self._rest).all())

    def _has_stood(self, role: str, now_ns: int) -> bool:
        seen = self._seen[role]
        t_ns = np.array([*(state.t_ns for state in seen), now_ns])
        gaps_ns, lasted_ns = np.diff(t_ns), t_ns[-2] - t_ns[0]
        if lasted_ns < STOOD_FOR_NS or gaps_ns.min() < 0 or gaps_ns.max() > LONGEST_GAP_NS:
            return False
        speeds = _norms(np.array([state.value.twist for state in seen]))
        usual = speeds[t_ns[:-1] <= t_ns[-2] - STARTED_NS].max(axis=0)
        poses = np.array([state.value.T_base_tcp for state in seen])
        with np.errstate(invalid="ignore"):
            extent = np.ptp(poses, axis=0)
        # |R - R'| is sqrt(8) sin(angle/2) in the Frobenius norm.
        moved = np.array([np.linalg.norm(extent[:3, 3]), np.linalg.norm(extent[:3, :3]) / np.sqrt(2.0)])
        # Every comparison with NaN is false.
        return bool((moved <= self._rest * 1e-9 * lasted_ns).all() and (speeds[-1] <= 2.0 * usual).all())


def _norms(twist: Array) -> Array:
    """Return the norms of the linear and the angular part (..., 2) of twists (..., 6)."""
    norms: Array = np.linalg.norm(twist.reshape(*twist.shape[:-1], 2, 3), axis=-1)
    return norms
