"""The emulators' periodic timer: late ticks are made up for, but no two ticks coincide."""

from __future__ import annotations

import asyncio
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from touchcell.testing.emulation.ticker import Ticker, following_tick

PERIOD_NS = 2_000_000


def ticks_of(held_up_ns: dict[int, int], enough: int) -> list[tuple[int, bool]]:
    """(time, late) of each tick until there are ``enough``, with the process held up before some of them."""
    now_ns, due_ns = PERIOD_NS, PERIOD_NS
    seen: list[tuple[int, bool]] = []
    while len(seen) < enough:
        now_ns += held_up_ns.get(len(seen), 0)
        due_ns, in_ns, late = following_tick(due_ns, now_ns, PERIOD_NS)
        seen.append((now_ns, late))
        now_ns += in_ns
    return seen


def test_ticks_that_were_slept_through_are_made_up_for_but_never_at_once() -> None:
    seen = ticks_of({5: 10 * PERIOD_NS}, 60)
    times = [t_ns for t_ns, _ in seen]
    assert not any(late for _, late in seen[:5])
    assert seen[5][1]
    # Each that is made up for wins a quarter of a period: after forty the ten are regained.
    assert not seen[-1][1]
    assert times[-1] == 60 * PERIOD_NS


def test_a_long_suspended_process_skips_the_missed_ticks() -> None:
    seen = ticks_of({5: 75 * PERIOD_NS}, 20)
    times = [t_ns for t_ns, _ in seen]
    assert all(b - a == PERIOD_NS for a, b in pairwise(times[5:]))


@given(st.dictionaries(st.integers(0, 79), st.integers(0, 200 * PERIOD_NS), max_size=8))
def test_two_ticks_are_never_closer_than_three_quarters_of_a_period(held_up_ns: dict[int, int]) -> None:
    times = [t_ns for t_ns, _ in ticks_of(held_up_ns, 80)]
    assert min(b - a for a, b in pairwise(times)) >= 3 * PERIOD_NS // 4


def test_the_timer_ticks_in_the_running_loop_until_it_is_closed() -> None:
    async def tick() -> int:
        counted = 0
        enough = asyncio.Event()

        def on_tick(late: bool) -> None:
            nonlocal counted
            counted += 1
            if counted == 5:
                enough.set()
                ticker.close()

        ticker = Ticker(PERIOD_NS, on_tick)
        await asyncio.wait_for(enough.wait(), 30.0)
        return counted

    assert asyncio.run(tick()) == 5
