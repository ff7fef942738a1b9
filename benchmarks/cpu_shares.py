"""CPU time by part of the program, from samples of the running stack every few milliseconds."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

# Kernels deliver the timer at their own tick, often 4 ms.
_PERIOD_S = 0.001


@contextmanager
def cpu_shares(parts: Mapping[str, str], other: str) -> Iterator[Counter[str]]:
    """Count samples by part, in the main thread.

    Args:
        parts: part by a substring of a source file's path; the innermost frame that matches decides.
        other: the part of frames that match nothing.
    """
    counts: Counter[str] = Counter()

    def sample(_: int, frame: FrameType | None) -> None:
        while frame is not None:
            path = frame.f_code.co_filename
            part = next((part for piece, part in parts.items() if piece in path), None)
            if part is not None:
                counts[part] += 1
                return
            frame = frame.f_back
        counts[other] += 1

    before = signal.signal(signal.SIGPROF, sample)
    signal.setitimer(signal.ITIMER_PROF, _PERIOD_S, _PERIOD_S)
    try:
        yield counts
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
