"""What the interlocks look at in one control cycle: measured, stamped, and the command that is about to go out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from touchcell.drivers.core.commands import Sent, TwistCommand, in_base_axes
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class ArmView:
    """One arm.

    Attributes:
        state: newest measured state.
        command: what is about to be sent; None when it is told to stop.
        sent: what its gate let through in the cycle before, and why it differs; None when it was told to stop.
        joints: newest joint angles, where an interlock looks at them.
    """

    state: Stamped[TcpState]
    command: TwistCommand | None = None
    sent: Sent[TwistCommand] | None = None
    joints: Stamped[JointState] | None = None

    def commanded_twist(self) -> Array | None:
        """(6,) the command's twist of the tool centre point along base axes; None without a command."""
        return None if self.command is None else in_base_axes(self.command, self.state.value.T_base_tcp)

    def commanded_velocity(self, T_tcp_point: Array) -> Array | None:
        """(3,) velocity along base axes that the command asks of a point of the tool; None without a command."""
        twist = self.commanded_twist()
        if twist is None:
            return None
        velocity: Array = twist[:3] + np.cross(twist[3:], self.state.value.T_base_tcp[:3, :3] @ T_tcp_point[:3, 3])
        return velocity


@dataclass(frozen=True, slots=True)
class SensorView:
    """One tactile sensor.

    Attributes:
        t_frame_ns: capture stamp of the newest frame.
        seq: its number.
        in_contact: whether it touches anything.
        depth_m: estimated indentation; None without contact.
        in_range: False when the network left the range that it was trained on.
        nis: normalised innovation squared of the last filter correction, where there was one.
        sigma_depth_m: standard deviation of the depth, where there is one.
        shear_m: size of the estimated tangential shear; None without contact.
        torsion_rad: estimated rotation about the surface normal; None without contact.
        content: number that changes with the frame's picture, noise included; None where nobody looks at it.
        brightness: the frame's mean grey level; None likewise.
        T_s_f: (4, 4) estimated pose of the surface in the sensor's frame; None without contact.
        markers: share of the markers expected in view that are seen; None where the estimator looks at none.
        arm: role of the arm that carries it; None where nothing moves it.
    """

    t_frame_ns: int
    seq: int
    in_contact: bool
    depth_m: float | None = None
    in_range: bool = True
    nis: float | None = None
    sigma_depth_m: float | None = None
    shear_m: float | None = None
    torsion_rad: float | None = None
    content: int | None = None
    brightness: float | None = None
    T_s_f: Array | None = None
    markers: float | None = None
    arm: str | None = None


@dataclass(frozen=True, slots=True)
class CellView:
    """The cell at ``now_ns``: arms and sensors by their role in the task, and the state that the task is in.

    ``at_work`` is False while a run that has tripped waits for a person: then nothing is being pushed or held.
    """

    now_ns: int
    arms: Mapping[str, ArmView] = field(default_factory=dict)
    sensors: Mapping[str, SensorView] = field(default_factory=dict)
    task_state: str = ""
    at_work: bool = True

    def works_in(self, states: frozenset[str]) -> bool:
        """Whether the task is at work, and in one of ``states`` if any are named."""
        return self.at_work and (not states or self.task_state in states)
