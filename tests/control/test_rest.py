"""When an arm counts as being at rest although its measured speeds are noise, and which motion that must not hide."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.rest import LONGEST_GAP_NS, STARTED_NS, STOOD_FOR_NS, WINDOW_NS, RestMonitor
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3

START_NS = 10**12
CYCLE_NS = 10_000_000
NOISE = (0.006, 0, 0, 0, 0.02, 0)
Place = Callable[[int], Sequence[float]]
"""Pose in mm and deg at a number of nanoseconds since the start."""


def view(t_ns: int, pose_mm_deg: Sequence[float], twist: Sequence[float] = NOISE, age_ns: int = 0) -> CellView:
    T = se3.from_euler_mm_deg(np.array(pose_mm_deg, dtype=float))
    state = Stamped(TcpState(T, np.array(twist, dtype=float)), START_NS + t_ns - age_ns, 0)
    return CellView(START_NS + t_ns, {"arm": ArmView(state)}, {})


def judged(views: Iterable[CellView]) -> bool:
    """Whether the arm of the last view is at rest."""
    monitor = RestMonitor(1e-3, 1e-2)
    for each in views:
        monitor.note(each)
    return monitor.at_rest(each)


def along(place: Place, times_ns: Iterable[int] = range(0, 600_000_000, CYCLE_NS), **kwargs: int) -> bool:
    return judged(view(t_ns, place(t_ns), **kwargs) for t_ns in times_ns)


def standing(t_ns: int) -> Sequence[float]:
    return (100.0, -200.0, 300.0, 180.0, 10.0, 20.0)


def moved(axis: int, amount: float, since_ns: int = 300_000_000) -> Place:
    def place(t_ns: int) -> Sequence[float]:
        at = list(standing(t_ns))
        at[axis] += amount if t_ns >= since_ns else 0.0
        return at

    return place


@pytest.mark.parametrize(
    ("twist", "at_rest"),
    [
        ((1e-3, 0, 0, 0, 1e-2, 0), True),
        ((0.8e-3, 0.8e-3, 0, 0, 0, 0), False),
        ((0, 0, 0, 0.8e-2, 0, 0.8e-2), False),
        ((np.nan, 0, 0, 0, 0, 0), False),
    ],
)
def test_one_state_shows_an_arm_at_rest_by_its_speeds(twist: Sequence[float], at_rest: bool) -> None:
    assert judged([view(0, standing(0), twist)]) == at_rest


@pytest.mark.parametrize("age_ns", [WINDOW_NS + 1, -WINDOW_NS - 1])
def test_a_state_that_is_not_of_now_shows_nothing(age_ns: int) -> None:
    assert judged([view(0, standing(0), (0,) * 6, age_ns=age_ns // 2)])
    assert not judged([view(0, standing(0), (0,) * 6, age_ns=age_ns)])


def test_every_arm_has_to_be_at_rest() -> None:
    still, moving = (view(0, standing(0), twist).arms["arm"] for twist in ((0,) * 6, NOISE))
    assert judged([CellView(START_NS, {"left": still, "right": still}, {})])
    assert not judged([CellView(START_NS, {"left": still, "right": moving}, {})])
    assert not judged([CellView(START_NS, {"left": moving, "right": still}, {})])


def test_positions_that_stay_show_it_once_they_were_seen_for_long_enough() -> None:
    assert along(standing, range(0, STOOD_FOR_NS + 1, CYCLE_NS))
    assert not along(standing, range(0, STOOD_FOR_NS, CYCLE_NS))


@pytest.mark.parametrize(
    ("axis", "amount", "at_rest"),
    [
        (0, 0.5, True),
        (0, 0.6, False),
        (2, -0.5, True),
        (2, -0.6, False),
        (3, 0.28, True),
        (3, 0.34, False),
        (5, -0.34, False),
        (4, 180.0, False),
    ],
)
def test_positions_may_differ_by_what_the_speeds_at_rest_allow(axis: int, amount: float, at_rest: bool) -> None:
    # Half a second with 1 mm/s and 0.01 rad/s.
    assert along(moved(axis, amount)) == at_rest


def test_positions_count_from_one_end_to_the_other_and_not_from_the_first() -> None:
    def to_and_fro(t_ns: int) -> Sequence[float]:
        at = list(standing(t_ns))
        at[0] += (0.0, 0.4, 0.0, -0.4)[t_ns // CYCLE_NS % 4]
        return at

    assert not along(to_and_fro)


def test_a_state_is_of_now_until_it_is_as_old_as_the_window() -> None:
    assert judged([view(0, standing(0), (0,) * 6, age_ns=WINDOW_NS)])


def test_a_position_counts_for_as_long_as_the_window() -> None:
    place = moved(0, 50.0, since_ns=CYCLE_NS)
    assert not along(place, range(0, WINDOW_NS + 1, CYCLE_NS))
    assert along(place, range(0, WINDOW_NS + CYCLE_NS + 1, CYCLE_NS))


def test_a_shift_is_no_turn() -> None:
    monitor = RestMonitor(1.0, 1e-2)
    for t_ns in range(0, 600_000_000, CYCLE_NS):
        now = view(t_ns, moved(0, 100.0)(t_ns))
        monitor.note(now)
    assert monitor.at_rest(now)


def test_a_motion_that_begins_is_not_hidden_by_the_noise_of_turning_about_the_same_axis() -> None:
    noise = (0.006, 0, 0, 0.02, 0, 0)
    faster = (0.0126, 0, 0, 0.02, 0, 0)
    times_ns = range(0, 600_000_001, CYCLE_NS)
    assert judged(view(t_ns, standing(t_ns), noise) for t_ns in times_ns)
    assert not judged(view(t_ns, standing(t_ns), faster if t_ns > 550_000_000 else noise) for t_ns in times_ns)


def test_a_motion_that_is_over_counts_until_it_is_half_a_second_ago() -> None:
    place = moved(0, 50.0, since_ns=300_000_000)
    assert not along(place, range(0, 300_000_000 + STOOD_FOR_NS, CYCLE_NS))
    assert along(place, range(0, 300_000_000 + WINDOW_NS + CYCLE_NS, CYCLE_NS))


def test_between_states_that_are_far_apart_nothing_is_known() -> None:
    gap_ns = LONGEST_GAP_NS
    before = list(range(0, 300_000_001, CYCLE_NS))
    assert along(standing, [*before, *range(before[-1] + gap_ns, 550_000_001, CYCLE_NS)])
    assert not along(standing, [*before, *range(before[-1] + gap_ns + 1, 550_000_001, CYCLE_NS)])


def test_a_state_that_is_repeated_ages() -> None:
    seen = [view(t_ns, standing(t_ns)) for t_ns in range(0, 500_000_001, CYCLE_NS)]
    for age_ns, at_rest in ((LONGEST_GAP_NS, True), (LONGEST_GAP_NS + 1, False)):
        assert judged([*seen, view(500_000_000 + age_ns, standing(0), age_ns=age_ns)]) == at_rest


def test_a_clock_that_was_set_back_begins_anew() -> None:
    seen = [view(t_ns, standing(t_ns)) for t_ns in range(0, 600_000_000, CYCLE_NS)]
    set_back_ns = 100_000_000
    again = [view(t_ns, standing(t_ns), age_ns=set_back_ns) for t_ns in range(600_000_000, 1_500_000_000, CYCLE_NS)]
    assert not judged([*seen, *again[:30]])
    assert judged([*seen, *again])


def test_a_number_that_is_none_shows_nothing_for_as_long_as_it_is_remembered() -> None:
    for number in (np.nan, np.inf):
        seen = [view(t_ns, standing(t_ns)) for t_ns in range(0, 600_000_000, CYCLE_NS)]
        seen[30].arms["arm"].state.value.T_base_tcp[0, 3] = number
        assert not judged(seen)


@pytest.mark.parametrize(("times", "at_rest"), [(1.0, True), (2.0, True), (2.1, False)])
@pytest.mark.parametrize("part", [0, 1])
def test_a_speed_above_what_it_measured_while_it_stood_is_a_motion_that_has_begun(
    part: int, times: float, at_rest: bool
) -> None:
    faster = np.array(NOISE)
    faster[3 * part : 3 * part + 3] *= times
    begun_ns = 600_000_000 - STARTED_NS + CYCLE_NS
    assert (
        judged(
            view(t_ns, standing(t_ns), faster if t_ns >= begun_ns else NOISE)
            for t_ns in range(0, 600_000_001, CYCLE_NS)
        )
        == at_rest
    )


@pytest.mark.parametrize(("begun_ms", "at_rest"), [(50, False), (95, False), (100, False), (101, True), (150, True)])
def test_what_is_measured_for_a_tenth_of_a_second_while_the_positions_stay_is_usual(
    begun_ms: int, at_rest: bool
) -> None:
    faster = 3.0 * np.array(NOISE)
    begun_ns = 600_000_000 - 1_000_000 * begun_ms
    times_ns = range(0, 600_000_001, CYCLE_NS)
    assert judged(view(t, standing(t), faster if t > begun_ns else NOISE) for t in times_ns) == at_rest


speeds_mm_s = st.one_of(st.just(0.0), st.floats(-20.0, 20.0), st.floats(-0.9, 0.9))


@given(
    way=st.lists(st.tuples(speeds_mm_s, st.integers(1, 60)), min_size=1, max_size=8),
    noise_mm_s=st.sampled_from([0.0, 1.5, 6.0]),
    seed=st.integers(0, 1000),
)
def test_an_arm_at_rest_has_neither_moved_nor_begun_to(
    way: list[tuple[float, int]], noise_mm_s: float, seed: int
) -> None:
    """Whatever it did before: what is called rest has moved by no more than rest allows, and measures no motion."""
    rng, monitor = np.random.default_rng(seed), RestMonitor(1e-3, 1e-2)
    true_mm_s = [speed for speed, cycles in way for _ in range(cycles)]
    x_mm = np.concatenate([[0.0], np.cumsum(1e-9 * CYCLE_NS * np.array(true_mm_s))])
    for k, speed in enumerate(true_mm_s):
        measured_mm_s = speed + rng.uniform(-noise_mm_s, noise_mm_s)
        now = view(k * CYCLE_NS, (x_mm[k], 0, 0, 0, 0, 0), (1e-3 * measured_mm_s, 0, 0, 0, 0, 0))
        monitor.note(now)
        if not monitor.at_rest(now) or abs(measured_mm_s) <= 1.0:
            continue
        lately = slice(max(k - STOOD_FOR_NS // CYCLE_NS, 0), k + 1)
        assert k * CYCLE_NS >= STOOD_FOR_NS
        assert np.ptp(x_mm[lately]) <= 1e-6 * WINDOW_NS
        if not any(true_mm_s[max(k - WINDOW_NS // CYCLE_NS, 0) : k - STARTED_NS // CYCLE_NS + 1]):
            assert abs(speed) <= 3.0 * noise_mm_s
