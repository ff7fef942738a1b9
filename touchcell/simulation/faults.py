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
        gain: factor on the grey levels, as of an exposure that has drifted.
    """

    frozen: bool = False
    last_seq: int | None = None
    extra_latency_s: float = 0.0
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class ArmFaults:
    """What goes wrong with a simulated arm.

    Attributes:
        nan_state: it tells a pose and a twist that are not numbers.
        deaf: stops do not reach it; what it follows still expires.
        runs_on: it keeps following its last twist, stopped or expired; only removing its power stops it.
        drift_m_s: it sinks along -z of its base at this speed while it has power.
        stale: it tells the state that it had when this began, with the stamp of then.
    """

    nan_state: bool = False
    deaf: bool = False
    runs_on: bool = False
    drift_m_s: float = 0.0
    stale: bool = False
