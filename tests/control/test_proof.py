"""The proof that an interlock can trip: also of one from another package, and of one that lies about itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import pytest

from touchcell.control.interlocks.coverage import (
    ArmFacts,
    CannotTrip,
    CellFacts,
    Fault,
    Provable,
    SensorFacts,
    just_beyond,
    with_sensor,
)
from touchcell.control.interlocks.settings import GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.proof import Proof, prove
from touchcell.drivers.core.gate import TwistLimits

LIMITS = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)
FACTS = CellFacts(
    0.01,
    ("settle", "run"),
    {"arm": ArmFacts(LIMITS, 1.0)},
    {"sensor": SensorFacts("network", "arm", np.eye(4), 7e-3, 6e-3, 0.1)},
)


@dataclass
class Bright:
    """An interlock of a stranger: no sensor is brighter than its limit, in the states that it secretly likes."""

    limit: float
    name: str = "it"
    severity: Severity = Severity.TRIP
    states: tuple[str, ...] = ()
    judge: Callable[[CellView], Violation | None] | None = None
    seen: list[CellView] = field(default_factory=list)

    def check(self, view: CellView) -> Violation | None:
        self.seen.append(view)
        if self.judge is not None:
            return self.judge(view)
        for role, sensor in view.sensors.items():
            bright = sensor.brightness is not None and sensor.brightness > self.limit
            if bright and (not self.states or view.task_state in self.states):
                return Violation(self.name, self.severity, role, "too bright", view.now_ns)
        return None


class BrightConfig(GradedSettings):
    """Its settings, without a description of its faults."""

    kind: Literal["bright"] = "bright"
    limit: float = 200.0

    def build(self, name: str, T_tcp_sensor: Mapping[str, Any]) -> Bright:
        return Bright(self.limit, name, self.level)


class ProvableConfig(BrightConfig):
    """The same, that takes part in the proof."""

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        level = just_beyond(self.limit, 255.0)
        for role in facts.sensors:
            yield Fault(role, "glare", "200", partial(_glare, role, level), key="limit")


def _glare(role: str, level: float, view: CellView, t_s: float) -> CellView:
    return with_sensor(view, role, brightness=level)


def proven(settings: InterlockSettings, interlock: Any = None, facts: CellFacts = FACTS) -> Proof:
    (proof,) = prove("it", settings, interlock or settings.build("it", {}), facts)
    return proof


def test_an_interlock_of_another_package_takes_part_by_one_method() -> None:
    assert isinstance(ProvableConfig(), Provable)
    proof = proven(ProvableConfig())
    assert (proof.tripped_s, proof.problem, proof.covers, proof.subject) == (0.0, "", ("sensor",), "sensor")


def test_one_that_describes_no_faults_is_reported_as_not_proven_and_not_refused() -> None:
    proof = proven(BrightConfig())
    assert proof.tripped_s is None
    assert "not proven" in proof.problem
    assert not proof.fatal


def test_a_limit_beyond_what_can_be_shown_is_refused_with_its_key() -> None:
    proof = proven(ProvableConfig(limit=255.0))
    assert (proof.tripped_s, proof.key, proof.fatal) == (None, "limit", True)
    assert "glare: does not trip within 2 s in settle" in proof.problem


def test_it_has_to_trip_in_every_state_of_the_task() -> None:
    proof = proven(ProvableConfig(), Bright(200.0, states=("settle",)))
    assert proof.tripped_s is None
    assert "in run" in proof.problem
    interlock = Bright(200.0, states=("settle", "run"))
    proven(ProvableConfig(), interlock)
    assert {view.task_state for view in interlock.seen} == {"settle", "run"}


def test_one_that_never_asks_for_the_state_is_shown_one() -> None:
    interlock = Bright(200.0)
    assert proven(ProvableConfig(), interlock).problem == ""
    assert {view.task_state for view in interlock.seen} == {"settle"}


@pytest.mark.parametrize(
    "derive", [lambda view: replace(view, at_work=True), lambda view: with_sensor(view, "sensor", markers=1.0)]
)
def test_one_that_asks_a_snapshot_derived_from_its_own_is_shown_every_state(
    derive: Callable[[CellView], CellView],
) -> None:
    def judge(view: CellView) -> Violation | None:
        derived = derive(view)
        bright = derived.sensors["sensor"].brightness is not None
        trips = bright and derived.task_state == "settle"
        return Violation("it", Severity.TRIP, "sensor", "too bright", view.now_ns) if trips else None

    assert "does not trip within 2 s in run" in proven(ProvableConfig(), Bright(200.0, judge=judge)).problem


def test_a_fault_that_names_its_states_is_shown_in_each_of_them() -> None:
    class Glare(BrightConfig):
        def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
            yield Fault("sensor", "glare", "200", partial(_glare, "sensor", 210.0), states=("settle", "run"))

    interlock = Bright(200.0)
    assert proven(Glare(), interlock).problem == ""
    assert {view.task_state for view in interlock.seen} == {"settle", "run"}


def test_a_task_that_names_no_states_is_shown_without_one() -> None:
    interlock = Bright(200.0)
    facts = CellFacts(0.01, (), FACTS.arms, FACTS.sensors)
    assert proven(ProvableConfig(), interlock, facts).tripped_s == 0.0
    assert {view.task_state for view in interlock.seen} == {""}


def test_one_that_trips_on_a_healthy_cell_is_refused() -> None:
    def always(view: CellView) -> Violation:
        return Violation("it", Severity.TRIP, "sensor", "I always do", view.now_ns)

    proof = proven(ProvableConfig(), Bright(200.0, judge=always))
    assert proof.tripped_s is None
    assert "trips without a fault in settle: it: I always do" in proof.problem


def test_one_that_raises_on_a_healthy_cell_is_refused() -> None:
    def broken(view: CellView) -> Violation:
        raise KeyError("no such arm")

    assert "trips without a fault" in proven(ProvableConfig(), Bright(200.0, judge=broken)).problem


def test_one_that_trips_under_another_name_is_refused() -> None:
    proof = proven(ProvableConfig(), Bright(200.0, name="other"))
    assert "something else trips in settle: other" in proof.problem


def test_one_that_only_limits_has_to_become_a_trip_in_time() -> None:
    proof = proven(ProvableConfig(severity="limit"))
    assert proof.tripped_s == pytest.approx(0.31)


def test_one_that_is_too_slow_is_refused_and_one_in_time_is_not() -> None:
    def after(delay_s: float) -> Callable[[CellView], Violation | None]:
        began: dict[str, int] = {}

        def judge(view: CellView) -> Violation | None:
            if view.sensors["sensor"].brightness is None:
                began.clear()
                return None
            first = began.setdefault("t", view.now_ns)
            late = view.now_ns - first >= round(1e9 * delay_s)
            return Violation("it", Severity.TRIP, "sensor", "at last", view.now_ns) if late else None

        return judge

    assert proven(ProvableConfig(), Bright(200.0, judge=after(1.9))).tripped_s == pytest.approx(1.9)
    assert proven(ProvableConfig(), Bright(200.0, judge=after(3.0))).tripped_s is None


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ([], "guards nothing"),
        ([CannotTrip("sensor", "it is blind", "kind")], "it is blind"),
        (None, "cannot be described"),
        ([Fault("sensor", "a hole", "-", lambda view, t_s: view.sensors["none"])], "cannot be shown"),  # type: ignore[list-item,return-value]
        ([Fault("sensor", "not finite", "-", lambda v, t: with_sensor(v, "sensor", depth_m=np.nan))], "something else"),
    ],
)
def test_what_it_says_of_itself_is_not_believed(found: Any, words: str) -> None:
    class Said(BrightConfig):
        def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
            if found is None:
                raise RuntimeError("no")
            return found  # type: ignore[no-any-return]

    proof = proven(Said())
    assert words in proof.problem
    assert proof.tripped_s is None
    assert proof.fatal


def test_the_healthy_cell_is_fresh_at_rest_and_without_contact() -> None:
    view = FACTS.healthy(5 * 10**9, "run")
    assert view.arms["arm"].state.t_ns == view.sensors["sensor"].t_frame_ns == view.now_ns == 5 * 10**9
    assert not view.arms["arm"].state.value.twist.any()
    assert not view.sensors["sensor"].in_contact
    assert view.sensors["sensor"].arm == "arm"


def test_a_proof_logs_no_trips(caplog: pytest.LogCaptureFixture) -> None:
    proven(ProvableConfig())
    assert caplog.records == []


@pytest.mark.parametrize("by_error", [False, True])
def test_one_that_raises_in_place_of_comparing_its_limit_is_refused_unless_a_measurement_is_missing(
    by_error: bool,
) -> None:
    class Glare(BrightConfig):
        def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
            yield Fault("sensor", "glare", "200", partial(_glare, "sensor", 210.0), by_error=by_error)

    def broken(view: CellView) -> None:
        if view.sensors["sensor"].brightness is not None:
            raise KeyError("no such arm")

    proof = proven(Glare(), Bright(200.0, judge=broken))
    assert (proof.problem == "") == by_error
    assert by_error or "no such arm" in proof.problem
