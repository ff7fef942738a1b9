"""Force mode, freedrive and teach mode of the emulated UR arm: the tool gives way to forces along some axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import Array

_GIVING = np.array([0.005] * 3 + [0.05] * 3)
"""Speed per force, m/s per N and rad/s per N m: of this emulator, as the real one's depends on its controller."""

BY_HAND_LIMITS = np.array([1.0] * 3 + [2.0] * 3)
"""Largest speeds in freedrive, m/s and rad/s."""


@dataclass(frozen=True, slots=True)
class Compliance:
    """Axes along which the tool gives way.

    Attributes:
        name: mode, for messages.
        R_base_frame: (3, 3) axes of the task frame.
        selection: (6,) 1 for an axis that gives way, 0 for a stiff one, along the frame's axes.
        wrench: (6,) N and N m that the arm exerts on the world along them.
        limits: (6,) largest speeds of the axes that give way, m/s and rad/s.
        follows_moves: whether the other axes can be moved meanwhile, as in force mode.
    """

    name: str
    R_base_frame: Array
    selection: Array
    wrench: Array
    limits: Array
    follows_moves: bool

    def twist(self, external: Array) -> Array:
        """Return the twist (6,) along base axes under an external wrench (6,) on the tool, along base axes."""
        R = self.R_base_frame
        felt = np.concatenate([R.T @ external[:3], R.T @ external[3:]])
        along = np.clip(self.selection * _GIVING * (self.wrench + felt), -self.limits, self.limits)
        return np.concatenate([R @ along[:3], R @ along[3:]])
