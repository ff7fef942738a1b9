"""Snapshot of the cell that the interlocks check in one control cycle: stamped measurements and pending commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from touchcell.drivers.core.commands import Sent, TwistCommand, in_base_axes
from touchcell.drivers.core.enabling import EnablingPosition
from touchcell.drivers.core.samples import Health, JointState, Stamped, TcpState
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class ArmView:
    """Snapshot of one arm.

    Attributes:
        state: newest measured state.
        command: the command about to be sent; None when the arm is commanded to stop.
        sent: the command that its gate passed in the previous cycle, and its adjustments; None for a stop.
        joints: newest joint angles, where an interlock needs them.
        wrench: (6,) newest wrench on the tool, N and N m, where an interlock needs it.
        external_torque: (n,) newest external torque of each joint, N m, where an interlock needs it.
    """

    state: Stamped[TcpState]
    command: TwistCommand | None = None
    sent: Sent[TwistCommand] | None = None
    joints: Stamped[JointState] | None = None
    wrench: Stamped[Array] | None = None
    external_torque: Stamped[Array] | None = None

    def commanded_twist(self) -> Array | None:
        """(6,) twist of the tool centre point along base axes that the command asks for; None without a command."""
        return None if self.command is None else in_base_axes(self.command, self.state.value.T_base_tcp)

    def commanded_velocity(self, T_tcp_point: Array) -> Array | None:
        """Return the (3,) commanded velocity of a point of the tool along base axes; None without a command."""
        twist = self.commanded_twist()
        if twist is None:
            return None
        velocity: Array = twist[:3] + np.cross(twist[3:], self.state.value.T_base_tcp[:3, :3] @ T_tcp_point[:3, 3])
        return velocity


@dataclass(frozen=True, slots=True)
class SensorView:
    """Snapshot of one tactile sensor.

    Attributes:
        t_frame_ns: capture stamp of the newest frame.
        seq: its number.
        in_contact: True while it touches anything.
        depth_m: estimated indentation; None without contact.
        in_range: False when the estimate is outside the network's training range.
        nis: normalised innovation squared of the last filter correction, where there was one.
        sigma_depth_m: standard deviation of the depth, where there is one.
        shear_m: magnitude of the estimated tangential shear; None without contact.
        torsion_rad: estimated rotation about the surface normal; None without contact.
        content: hash that changes with the frame's image, noise included; None where no interlock needs it.
        brightness: the frame's mean grey level; None likewise.
        T_s_f: (4, 4) estimated pose of the surface in the sensor's frame; None without contact.
        markers: fraction of the markers expected in view that are detected; None for an estimator without markers.
        arm: role of the arm that carries it; None for a fixed sensor.
        refusal: why the frame does not show a contact as the model's camera would; empty where it does.
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
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class DeviceView:
    """Snapshot of a device that is neither an arm nor a tactile sensor.

    Attributes:
        reading: newest named numbers; None for a device that is not read.
        setting: named set values about to be applied; None when they stay as they are.
    """

    reading: Stamped[Mapping[str, float]] | None = None
    setting: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True)
class CellView:
    """Snapshot of the cell at ``now_ns``: arms, sensors and other devices by their role, and the task's state.

    ``at_work`` is False while a tripped run waits for an operator: then nothing is being pushed or held. ``enabling``
    is the position of the enabling device, where the cell has one. ``health`` is what devices last reported about
    themselves, by their name in the cell file, where a rule of the cell needs it.
    """

    now_ns: int
    arms: Mapping[str, ArmView] = field(default_factory=dict)
    sensors: Mapping[str, SensorView] = field(default_factory=dict)
    task_state: str = ""
    at_work: bool = True
    enabling: Stamped[EnablingPosition] | None = None
    devices: Mapping[str, DeviceView] = field(default_factory=dict)
    health: Mapping[str, Stamped[Health]] = field(default_factory=dict)

    def works_in(self, states: frozenset[str]) -> bool:
        """Return True if the task is at work, and in one of ``states`` if any are named."""
        return self.at_work and (not states or self.task_state in states)
