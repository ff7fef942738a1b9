"""The watchdog's judgement on given times."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.hosting.layouts import Cause, Reason
from touchcell.drivers.hosting.watchdog import Beat, HeartbeatMonitor, silence_s

PERIOD_S = 0.01
MS = 1_000_000
STEP_NS = round(2.5 * MS)


class Scene:
    """A task and two hosts, polled four times per period as by the watchdog."""

    def __init__(self) -> None:
        self.judge = HeartbeatMonitor(PERIOD_S)
        self.now_ns = 1_000 * MS
        self.judge.begin(self.now_ns)
        self.task = Beat(1, self.now_ns)
        self.hosts = [Beat(1, self.now_ns), Beat(1, self.now_ns)]

    def run(self, beats_ns: list[int], *, silent_host: int | None = None) -> Cause | None:
        """Let the task beat at these times; hosts beat at every look unless one is silent."""
        for beat_ns in beats_ns:
            while self.now_ns + STEP_NS < beat_ns:
                if (cause := self.poll(silent_host)) is not None:
                    return cause
            period_ns = beat_ns - self.task.t_ns
            late = period_ns > 15 * MS
            self.task = Beat(
                self.task.count + 1,
                beat_ns,
                late=self.task.late + late,
                late_ns=period_ns if late else self.task.late_ns,
            )
        return self.poll(silent_host)

    def poll(self, silent_host: int | None = None) -> Cause | None:
        self.now_ns += STEP_NS
        self.hosts = [
            host if k == silent_host else Beat(host.count + 1, self.now_ns) for k, host in enumerate(self.hosts)
        ]
        return self.judge.update(self.now_ns, self.task, self.hosts)


def regular(start_ns: int, count: int, late: dict[int, int] | None = None) -> list[int]:
    return [start_ns + k * 10 * MS + (late or {}).get(k, 0) for k in range(1, count + 1)]


@settings(max_examples=20)
@given(st.lists(st.integers(0, 4 * MS), min_size=150, max_size=300))
def test_a_punctual_task_is_not_stopped(jitter: list[int]) -> None:
    """Up to 4 ms late in a period of 10 ms."""
    scene = Scene()
    assert scene.run(regular(scene.now_ns, len(jitter), dict(enumerate(jitter, start=1)))) is None


@given(good=st.integers(0, 50))
def test_a_silent_task_is_found_within_two_missed_beats(good: int) -> None:
    scene = Scene()
    assert scene.run(regular(scene.now_ns, good)) is None
    last_ns = scene.task.t_ns
    cause = None
    while cause is None:
        cause = scene.poll()
    assert cause.reason is Reason.TASK_SILENT
    assert cause.limit_s == silence_s(PERIOD_S) == 0.025
    assert 25 * MS < cause.t_ns - last_ns <= 25 * MS + STEP_NS
    assert cause.value_s * 1e9 == cause.t_ns - last_ns


def test_silence_from_before_the_guard_does_not_count() -> None:
    scene = Scene()
    scene.now_ns += 3_000 * MS
    scene.judge.begin(scene.now_ns)
    assert scene.poll() is None


def test_a_silent_host_is_named() -> None:
    scene = Scene()
    cause = scene.run(regular(scene.now_ns, 10), silent_host=1)
    assert cause is not None
    assert (cause.reason, cause.host) == (Reason.HOST_SILENT, 1)


def test_a_host_that_has_stopped_by_itself_stops_the_others() -> None:
    scene = Scene()
    scene.hosts[0] = Beat(2, scene.now_ns, latched=True)
    cause = scene.judge.update(scene.now_ns, scene.task, scene.hosts)
    assert cause is not None
    assert (cause.reason, cause.host) == (Reason.HOST_LATCHED, 0)


def test_one_late_period_is_tolerated_and_two_in_a_second_are_not() -> None:
    scene = Scene()
    assert scene.run(regular(scene.now_ns, 250, {150: 9 * MS})) is None
    scene = Scene()
    cause = scene.run(regular(scene.now_ns, 250, {120: 8 * MS, 150: 7 * MS}))
    assert cause is not None
    assert cause.reason is Reason.TASK_SLOW
    assert (cause.value_s, cause.limit_s) == pytest.approx((0.017, 0.015)), "found although it has caught up since"


def test_a_task_that_is_slow_throughout_is_found_after_a_second() -> None:
    scene = Scene()
    begun_ns = scene.now_ns
    cause = scene.run([begun_ns + k * 16 * MS for k in range(1, 100)])
    assert cause is not None
    assert cause.reason is Reason.TASK_SLOW
    assert 1_000 * MS <= cause.t_ns - begun_ns < 1_020 * MS
