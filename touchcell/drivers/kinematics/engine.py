"""Faster kinematics by pinocchio, where it is installed (extra ``kinematics``); the plain chain is its oracle."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np

from touchcell.geometry.types import Array


class PinocchioEngine:
    """Forward kinematics, Jacobian and gravity torques of one chain of turning joints with its tool.

    Args:
        placements: (n, 4, 4) of the joint frames in the link before, at zero.
        axes: (n, 3) unit axes in the joint frames.
        masses: (n,) kg that each joint moves, without those beyond the next.
        centres: (n, 3) m centres of these masses in the joint frames.
        T_joint_tcp: (4, 4) tool centre point in the last joint's frame.
        gravity_m_s2: (3,) along base axes.

    Raises:
        ImportError: pinocchio is not installed.
    """

    def __init__(
        self,
        placements: Array,
        axes: Array,
        masses: Array,
        centres: Array,
        T_joint_tcp: Array,
        gravity_m_s2: Array,
    ) -> None:
        import pinocchio as pin

        self._pin = pin
        model = pin.Model()
        parent = 0
        for i, (T, axis) in enumerate(zip(placements, axes, strict=True)):
            joint = pin.JointModelRevoluteUnaligned(*axis.tolist())
            parent = model.addJoint(parent, joint, pin.SE3(T[:3, :3], T[:3, 3]), f"joint{i}")
            inertia = pin.Inertia(float(masses[i]), centres[i], np.zeros((3, 3)))
            model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        self._frame = model.addFrame(
            pin.Frame("tcp", parent, pin.SE3(T_joint_tcp[:3, :3], T_joint_tcp[:3, 3]), pin.FrameType.OP_FRAME)
        )
        model.gravity.linear = gravity_m_s2
        self._model = model
        # Pinocchio computes in place: the thread of a bus and those that ask for its state each need a place.
        self._places = threading.local()
        self._count = len(axes)

    @property
    def _data(self) -> Any:
        try:
            return self._places.data
        except AttributeError:
            self._places.data = self._model.createData()
            return self._places.data

    def accepts(self, q: Array) -> bool:
        """Return whether ``q`` is a finite vector of the right length; the plain chain says what is wrong otherwise."""
        return isinstance(q, np.ndarray) and q.shape == (self._count,) and math.isfinite(float(q @ q))

    def forward(self, q: Array) -> Array:
        """Return the pose ``T_base_tcp`` (4, 4)."""
        data = self._data
        self._pin.forwardKinematics(self._model, data, q)
        return np.array(self._pin.updateFramePlacement(self._model, data, self._frame).homogeneous)

    def forward_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return pose and Jacobian (6, n) along base axes."""
        data = self._data
        self._pin.computeJointJacobians(self._model, data, q)
        pose = self._pin.updateFramePlacement(self._model, data, self._frame)
        J = self._pin.getFrameJacobian(self._model, data, self._frame, self._pin.LOCAL_WORLD_ALIGNED)
        return np.array(pose.homogeneous), np.array(J)

    def gravity_torques(self, q: Array) -> Array:
        """Return the motor torques (n,) N m that hold the arm still."""
        return np.array(self._pin.computeGeneralizedGravity(self._model, self._data, q))
