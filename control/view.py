"""What the interlocks look at in one control cycle: measured, stamped, and the command that is about to go out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.commands import TwistCommand
from drivers.samples import Stamped, TcpState


@dataclass(frozen=True, slots=True)
class ArmView:
    """One arm.

    Attributes:
        state: newest measured state.
        command: what is about to be sent; None when it is told to stop.
    """

    state: Stamped[TcpState]
    command: TwistCommand | None = None


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
    """

    t_frame_ns: int
    seq: int
    in_contact: bool
    depth_m: float | None = None
    in_range: bool = True
    nis: float | None = None
    sigma_depth_m: float | None = None


@dataclass(frozen=True, slots=True)
class CellView:
    """The cell at ``now_ns``, arms and sensors by their role in the task."""

    now_ns: int
    arms: Mapping[str, ArmView] = field(default_factory=dict)
    sensors: Mapping[str, SensorView] = field(default_factory=dict)
