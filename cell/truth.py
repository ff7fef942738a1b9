"""The simulator's own contact state in place of an estimate, so that control error is seen apart from estimation."""

from __future__ import annotations

import numpy as np

from drivers.simulation.scene import Scene
from geometry.gaussian import PoseGaussian
from geometry.types import Array
from perception.estimate import ContactEstimate

# As good as exact, yet a proper covariance: a micrometre and a microradian.
_COVARIANCE = np.eye(6) * 1e-12


class TrueContactSource:
    """A ``ContactSource`` that asks the scene."""

    ended = False

    def __init__(self, scene: Scene, sensor: str) -> None:
        self._scene = scene
        self._sensor = sensor

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """The scene knows already."""

    def update(self, now_ns: int) -> ContactEstimate | None:
        """The contact as it is now, after slip."""
        contact = self._scene.contact(self._sensor)
        belief = PoseGaussian(contact.value.T_s_f, _COVARIANCE) if contact.value.in_contact else None
        return ContactEstimate(contact.value.in_contact, belief, contact.t_ns, contact.seq, contact.t_ns)
