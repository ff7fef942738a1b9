"""Samples that devices deliver: values with timestamp, sequence number and quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeAlias, TypeVar

import numpy as np

from touchcell.geometry.types import Array, ImageArray

T = TypeVar("T")
Health: TypeAlias = Mapping[str, float | int | str | bool]
"""What a device reports about itself: named readings, with units in the names."""


class Quality(Enum):
    """Trustworthiness of a sample."""

    GOOD = "good"
    SUSPECT = "suspect"


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T]):
    """A value with the time at which it was measured.

    Attributes:
        value: the sample.
        t_ns: CLOCK_MONOTONIC (or injected clock) time of capture where the device reports it, else of reception.
        seq: sequence number at the source; a gap means lost samples.
        t_device_ns: the device's own clock, where it has one.
        quality: SUSPECT when the device itself flags the sample as doubtful.
    """

    value: T
    t_ns: int
    seq: int
    t_device_ns: int | None = None
    quality: Quality = Quality.GOOD

    def age_s(self, now_ns: int) -> float:
        """Return the seconds from the sample's timestamp to ``now_ns``."""
        return (now_ns - self.t_ns) * 1e-9


@dataclass(frozen=True, slots=True)
class Frame:
    """A camera image: uint8, (height, width) grey or (height, width, 3) BGR."""

    image: ImageArray
    exposure: float | None = None
    gain: float | None = None


@dataclass(frozen=True, slots=True)
class JointState:
    """Joint positions (n,) rad, velocities (n,) rad/s, and torques (n,) N m where the arm measures them."""

    q: Array
    dq: Array
    tau: Array | None = None


@dataclass(frozen=True, slots=True)
class TcpState:
    """Pose and velocity of the tool centre point.

    Attributes:
        T_base_tcp: pose (4, 4).
        twist: (6,) [v, w] of the tool centre point: linear velocity of that point and angular velocity, both along
            base axes (as ``TwistFrame.BASE``).
    """

    T_base_tcp: Array
    twist: Array


def of_other_point(state: TcpState, T_base_point: Array) -> TcpState:
    """Return the state of another point of the tool, now at pose ``T_base_point`` (4, 4), from that of one of it."""
    v, w = state.twist[:3], state.twist[3:]
    lever = T_base_point[:3, 3] - state.T_base_tcp[:3, 3]
    return TcpState(T_base_point, np.concatenate([v + np.cross(w, lever), w]))
