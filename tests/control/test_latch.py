"""The latch: single cases, and as a state machine against a model."""

from __future__ import annotations

import logging

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, LatchState, Refusal, ResetDone, ResetRefused
from touchcell.drivers.core.device import OperatorToken


def violation(name="depth", severity=Severity.TRIP, t_ns=100, subject="sensor") -> Violation:
    return Violation(name, severity, subject, "too deep", t_ns, value=7.0, limit=6.0, unit="mm", frame_seq=3)


def token(t_ns=1_000) -> OperatorToken:
    return OperatorToken("ada", t_ns)


def reset(latch, at=1_000, at_rest=True, commanded=False):
    return latch.reset(token(at), at_rest=at_rest, commanded=commanded)


def test_first_cause_is_kept_and_later_ones_are_listed_once():
    latch = Latch()
    first, second = violation("depth"), violation("frame_age", t_ns=200)
    latch.update([first])
    for t_ns in (200, 300):
        latch.update([violation("depth", t_ns=t_ns), violation("frame_age", t_ns=t_ns)])
    assert latch.first_cause == first
    assert latch.causes == (first, second)


def test_stays_latched_when_the_cause_goes():
    latch = Latch()
    latch.update([violation()])
    assert latch.state is LatchState.TRIPPED
    latch.update([])
    assert latch.state is LatchState.CAUSE_GONE
    latch.update([violation("frame_age", t_ns=200)])
    assert latch.state is LatchState.TRIPPED
    assert latch.causes == (violation(), violation("frame_age", t_ns=200))


def test_a_fault_raises_a_trip_and_a_trip_never_lowers_a_fault():
    latch = Latch()
    latch.update([violation()])
    latch.update([violation("finite", Severity.FAULT)])
    latch.update([violation()])
    assert latch.state is LatchState.FAULTED


def test_a_limit_does_not_latch():
    latch = Latch()
    latch.update([violation(severity=Severity.LIMIT)])
    assert latch.state is LatchState.CLEAR
    assert latch.first_cause is None


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"at": 99}, Refusal.OLD_TOKEN),
        ({"at_rest": False}, Refusal.NOT_AT_REST),
        ({"commanded": True}, Refusal.MOTION_COMMANDED),
    ],
)
def test_reset_is_refused_with_the_reason(how, reason):
    latch = Latch()
    latch.update([violation(t_ns=100)])
    latch.update([])
    assert reset(latch, **how) == ResetRefused(reason)
    assert latch.state is LatchState.CAUSE_GONE
    assert latch.first_cause == violation(t_ns=100)


def test_reset_is_refused_while_the_cause_is_present():
    latch = Latch()
    latch.update([violation()])
    assert reset(latch) == ResetRefused(Refusal.CAUSE_PRESENT)


def test_reset_reports_what_it_cleared_and_each_token_works_once():
    latch = Latch()
    held = token(1_000)
    latch.update([violation()])
    latch.update([])
    assert latch.reset(held, at_rest=True, commanded=False) == ResetDone("ada", (violation(),))
    assert latch.state is LatchState.CLEAR
    assert latch.causes == ()
    assert latch.reset(held, at_rest=True, commanded=False) == ResetRefused(Refusal.NOT_LATCHED)
    latch.update([violation(t_ns=900)])
    latch.update([])
    assert latch.reset(held, at_rest=True, commanded=False) == ResetRefused(Refusal.OLD_TOKEN)


def test_a_token_made_in_the_moment_of_the_violation_resets_it():
    latch = Latch()
    latch.update([violation(t_ns=100)])
    latch.update([])
    assert isinstance(reset(latch, at=100), ResetDone)


def test_each_cause_and_the_reset_are_logged_once(caplog):
    latch = Latch()
    with caplog.at_level(logging.INFO, "touchcell.control.latch"):
        for _ in range(3):
            latch.update([violation()])
        latch.update([])
        reset(latch)
    assert [(r.levelname, r.getMessage()) for r in caplog.records] == [
        ("WARNING", "trip: depth: sensor: too deep"),
        ("INFO", "reset by ada"),
    ]


class LatchAgainstModel(RuleBasedStateMachine):
    """Any order of violations and resets: only a justified reset clears, and the first cause stays first."""

    def __init__(self):
        super().__init__()
        self.latch = Latch()
        self.t_ns = 0
        self.latest_ns = 0
        self.first = None
        self.expected = LatchState.CLEAR
        self.present = False

    @rule(severities=st.lists(st.sampled_from(Severity), max_size=3))
    def cycle(self, severities):
        self.t_ns += 10
        found = [violation(f"rule {i}", s, self.t_ns) for i, s in enumerate(severities)]
        self.latch.update(found)
        latching = [v for v in found if v.severity >= Severity.TRIP]
        self.present = bool(latching)
        if latching:
            self.latest_ns = self.t_ns
            self.first = self.first or latching[0]
            worst = max(v.severity for v in latching)
            if worst is Severity.FAULT or self.expected is LatchState.FAULTED:
                self.expected = LatchState.FAULTED
            else:
                self.expected = LatchState.TRIPPED

    @rule(at_rest=st.booleans(), commanded=st.booleans(), late=st.booleans())
    def try_reset(self, at_rest, commanded, late):
        self.t_ns += 10
        outcome = reset(self.latch, self.t_ns if late else self.latest_ns - 1, at_rest, commanded)
        justified = self.expected is not LatchState.CLEAR and late and at_rest
        justified = justified and not commanded and not self.present
        assert isinstance(outcome, ResetDone) == justified
        if justified:
            self.expected, self.first = LatchState.CLEAR, None

    @precondition(lambda self: self.expected is not LatchState.CLEAR)
    @rule()
    def quiet_cycle_changes_nothing(self):
        self.latch.update([])
        self.present = False

    @invariant()
    def agrees(self):
        latched = self.expected is not LatchState.CLEAR
        gone = latched and not self.present
        assert self.latch.state is (LatchState.CAUSE_GONE if gone else self.expected)
        assert self.latch.faulted == (self.expected is LatchState.FAULTED)
        assert self.latch.first_cause == self.first


TestLatchAgainstModel = LatchAgainstModel.TestCase
TestLatchAgainstModel.settings = settings(max_examples=60, stateful_step_count=30)
