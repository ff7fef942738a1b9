"""Faults that tests and benchmarks switch on in simulated devices while they run: ``device.faults = ...``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """What goes wrong with a simulated camera.

    Attributes:
        frozen: frames keep coming, with new stamps and numbers, but show the last image that was drawn.
        last_seq: no frame after this number comes; None for no such fault.
        extra_latency_s: by how much later frames become available, at most 1 s.
    """

    frozen: bool = False
    last_seq: int | None = None
    extra_latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ArmFaults:
    """What goes wrong with a simulated arm.

    Attributes:
        nan_state: it tells a pose and a twist that are not numbers.
        deaf: stops do not reach it; what it follows still expires.
    """

    nan_state: bool = False
    deaf: bool = False
