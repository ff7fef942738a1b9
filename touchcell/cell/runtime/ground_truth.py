"""What is known to be true: the simulator's own contact, or the label of a replayed image.

In place of an estimate it shows control error apart from estimation error; beside one it gives the estimate's error.
"""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.scene import SceneTruth
from touchcell.drivers.replay.arm import ReplayArm
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.pipeline import ContactSource

# As good as exact, yet a proper covariance: a micrometre and a microradian.
_COVARIANCE = np.eye(6) * 1e-12


class TrueContactSource(ContactSource):
    """A ``ContactSource`` that asks the scene."""

    def __init__(self, scene: SceneTruth, sensor: str) -> None:
        self._scene = scene
        self._sensor = sensor

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """The scene knows already."""

    def update(self, now_ns: int) -> ContactEstimate | None:
        """The contact as it was at ``now_ns``, after slip."""
        # In real time the scene is ahead of a cycle that began a moment ago.
        contact = self._scene.contact(self._sensor, now_ns)
        belief = PoseGaussian(contact.value.T_s_f, _COVARIANCE) if contact.value.in_contact else None
        return ContactEstimate(contact.value.in_contact, belief, contact.t_ns, contact.seq, contact.t_ns)


class TrueEdgeSource(ContactSource):
    """A ``ContactSource`` that asks the scene for the edge under the tip, in place of the surface."""

    def __init__(self, scene: SceneTruth, sensor: str) -> None:
        self._scene = scene
        self._sensor = sensor

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """The scene knows already."""

    def update(self, now_ns: int) -> ContactEstimate | None:
        """The edge as it was at ``now_ns``. There is none without a contact."""
        contact, edge = self._scene.contact(self._sensor, now_ns), self._scene.edge(self._sensor, now_ns)
        touches = contact.value.in_contact and edge is not None
        belief = PoseGaussian(edge.value, _COVARIANCE) if touches and edge is not None else None
        return ContactEstimate(touches, belief, contact.t_ns, contact.seq, contact.t_ns)


class LabelledContactSource(ContactSource):
    """A ``ContactSource`` that asks the arm which remembers where the images were taken."""

    def __init__(self, arm: ReplayArm, T_tcp_sensor: Array) -> None:
        self._arm = arm
        self._T_tcp_sensor = T_tcp_sensor

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """The arm knows already."""

    def update(self, now_ns: int) -> ContactEstimate | None:
        """The contact that the newest image is labelled with."""
        pose = self._arm.tcp()
        T_s_f = se3.inverse(se3.compose(pose.value.T_base_tcp, self._T_tcp_sensor))
        return ContactEstimate(True, PoseGaussian(T_s_f, _COVARIANCE), pose.t_ns, pose.seq, pose.t_ns)
