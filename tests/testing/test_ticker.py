"""The emulators' periodic timer: late ticks are made up for, but no two ticks coincide."""

from __future__ import annotations

import asyncio
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from touchcell.testing.emulation.ticker import Tick, Ticker, following_tick

PERIOD_NS = 2_000_000


def ticks_of(held_up_ns: dict[int, int], enough: int) -> list[tuple[int, Tick]]:
    """Time and tick until there are ``enough``, with the process held up before some of them."""
    now_ns, due_ns = PERIOD_NS, PERIOD_NS
    seen: list[tuple[int, Tick]] = []
    while len(seen) < enough:
        now_ns += held_up_ns.get(len(seen), 0)
        due_ns, in_ns, tick = following_tick(due_ns, now_ns, PERIOD_NS)
        seen.append((now_ns, tick))
        now_ns += in_ns
    return seen


def test_a_few_ticks_that_were_slept_through_are_made_up_for_but_never_at_once() -> None:
    seen = ticks_of({5: 4 * PERIOD_NS}, 60)
    assert not any(tick.late for _, tick in seen[:5])
    assert seen[5][1].late
    # Each that is made up for wins a quarter of a period: after sixteen the four are regained.
    assert not seen[-1][1].late
    assert not any(tick.coasted for _, tick in seen)
    assert seen[-1][0] == 60 * PERIOD_NS


def test_more_are_coasted_through_at_once_so_that_the_device_keeps_time() -> None:
    seen = ticks_of({5: 30 * PERIOD_NS}, 20)
    assert [tick.coasted for _, tick in seen] == [0] * 5 + [30] + [0] * 14
    assert seen[-1][0] == (20 + 30) * PERIOD_NS
    assert not seen[6][1].late


def test_a_long_suspended_process_skips_the_missed_ticks() -> None:
    seen = ticks_of({5: 75 * PERIOD_NS}, 20)
    times = [t_ns for t_ns, _ in seen]
    assert all(b - a == PERIOD_NS for a, b in pairwise(times[5:]))
    assert not any(tick.coasted for _, tick in seen)


@given(st.dictionaries(st.integers(0, 79), st.integers(0, 200 * PERIOD_NS), max_size=8))
def test_two_ticks_are_never_closer_than_three_quarters_of_a_period(held_up_ns: dict[int, int]) -> None:
    times = [t_ns for t_ns, _ in ticks_of(held_up_ns, 80)]
    assert min(b - a for a, b in pairwise(times)) >= 3 * PERIOD_NS // 4


@given(st.dictionaries(st.integers(0, 40), st.integers(0, 40 * PERIOD_NS), max_size=4))
def test_no_time_is_lost_on_a_busy_machine(held_up_ns: dict[int, int]) -> None:
    seen = ticks_of(held_up_ns, 120)
    passed = len(seen) + sum(tick.coasted for _, tick in seen)
    assert passed == seen[-1][0] // PERIOD_NS


def test_the_timer_ticks_in_the_running_loop_until_it_is_closed() -> None:
    async def tick() -> int:
        counted = 0
        enough = asyncio.Event()

        def on_tick(tick: Tick) -> None:
            nonlocal counted
            counted += 1
            if counted == 5:
                enough.set()
                ticker.close()

        ticker = Ticker(PERIOD_NS, on_tick)
        await asyncio.wait_for(enough.wait(), 30.0)
        return counted

    assert asyncio.run(tick()) == 5
