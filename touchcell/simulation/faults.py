"""Faults that tests and benchmarks inject into simulated devices while they run: ``device.faults = ...``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """Faults of a simulated camera.

    Attributes:
        frozen: frames keep coming, with fresh timestamps and numbers, but show the last rendered image.
        last_seq: number of the last frame delivered; None for no such fault.
        extra_latency_s: additional latency of frames, at most 1 s.
        gain: factor on the grey levels, like an exposure that has drifted.
    """

    frozen: bool = False
    last_seq: int | None = None
    extra_latency_s: float = 0.0
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class ArmFaults:
    """Faults of a simulated arm.

    Attributes:
        nan_state: it reports a pose and a twist that are NaN.
        ignores_stops: it ignores stops; twists still expire.
        ignores_expiry: it keeps following its last twist, stopped or expired; only removing its power stops it.
        drift_m_s: it sinks along -z of its base at this speed while it has power.
        stale: it keeps reporting the state at the start of the fault, with that timestamp.
    """

    nan_state: bool = False
    ignores_stops: bool = False
    ignores_expiry: bool = False
    drift_m_s: float = 0.0
    stale: bool = False
