"""Where the processor's time goes, by looking at the running stack every millisecond of it."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

_PERIOD_S = 0.001


@contextmanager
def cpu_shares(parts: Mapping[str, str], other: str) -> Iterator[Counter[str]]:
    """Count samples by part, in the main thread.

    Args:
        parts: part by what the path of a source file contains; the innermost frame that matches decides.
        other: the part of whatever matches nothing.
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
