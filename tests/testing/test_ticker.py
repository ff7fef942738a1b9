"""The emulators' periodic timer: late ticks are made up for, but no two ticks coincide."""

from __future__ import annotations

import asyncio
import time
from itertools import pairwise

from touchcell.testing.emulation.ticker import Ticker

PERIOD_NS = 2_000_000


def ticks_of(oversleeps: dict[int, float], enough: int) -> list[tuple[int, bool]]:
    """(monotonic time, late) of each tick until there are ``enough``, with the process held up in some of them."""
    seen: list[tuple[int, bool]] = []

    async def tick() -> None:
        done = asyncio.Event()

        def on_tick(late: bool) -> None:
            seen.append((time.monotonic_ns(), late))
            time.sleep(oversleeps.get(len(seen), 0.0))
            if len(seen) == enough:
                done.set()

        ticker = Ticker(PERIOD_NS, on_tick)
        try:
            await asyncio.wait_for(done.wait(), 30.0)
        finally:
            ticker.close()

    asyncio.run(tick())
    return seen


def test_ticks_that_were_slept_through_are_made_up_for_but_never_at_once() -> None:
    seen = ticks_of({5: 0.02}, 60)
    times = [t_ns for t_ns, _ in seen]
    assert min(b - a for a, b in pairwise(times)) >= 3 * PERIOD_NS // 4
    assert seen[5][1]
    # The sleep was ten periods. Had they been lost, the last would come ten periods later.
    made_up = [b - a < PERIOD_NS for a, b in pairwise(times[5:])]
    assert sum(made_up) > 20


def test_a_long_suspended_process_skips_the_missed_ticks() -> None:
    seen = ticks_of({5: 0.15}, 20)
    # Were the seventy made up for, four would come within three periods.
    assert seen[9][0] - seen[5][0] >= 3.5 * PERIOD_NS
