"""The fixture ``cell``: what a test of one's own cell can do and see."""

from __future__ import annotations

from dataclasses import replace

import pytest

from touchcell.errors import ConfigError
from touchcell.simulation.faults import ArmFaults
from touchcell.testing.cell_plugin import CellFactory
from touchcell.testing.cell_under_test import CellUnderTest

FOLLOW = "surface_follow_sim.yaml"
TRUE_CONTACT = {"sensors.sensor.estimator": {"kind": "true_contact"}, "task.distance_mm": 20}


@pytest.fixture
def following(cell: CellFactory) -> CellUnderTest:
    return cell(FOLLOW, set=TRUE_CONTACT)


def test_a_cell_runs_to_its_end(following: CellUnderTest) -> None:
    assert following.finish().outcome.value == "done"
    assert following.state == "done"
    assert max(following.values("/sensors/sensor/contact", "depth_mm"), default=3.0) < 4.0
    assert following.at_rest


def test_a_cell_is_stepped_cycle_by_cycle(following: CellUnderTest) -> None:
    following.step(10)
    assert following.t_s == pytest.approx(10 / following.cell.rate_hz, abs=0.02)
    following.run_until("run")
    before_s = following.t_s
    following.run_for(0.2)
    assert following.t_s - before_s == pytest.approx(0.2, abs=0.011)
    assert len(following.commands(before_s)) == pytest.approx(20, abs=2)


@pytest.mark.parametrize(
    ("device", "fault", "kind"),
    [("arm", {"stale": True}, "arm_state_age"), ("arm", {"nan_state": True}, "finite")],
)
def test_a_fault_trips_the_interlock_that_watches_for_it(
    following: CellUnderTest, device: str, fault: dict[str, bool], kind: str
) -> None:
    following.run_until("run")
    following.inject(device, **fault)
    following.run_until_trip(limit_s=1.0)
    following.assert_tripped_by(kind)
    following.assert_nothing_sent_since_trip()


def test_a_stop_is_within_what_is_declared(following: CellUnderTest) -> None:
    following.run_until("run")
    following.inject("arm", stale=True)
    following.run_until_trip()
    following.assert_stopped_as_declared()
    report = following.stops["arm"]
    assert report.time_s is not None
    assert report.time_s <= report.declared_s


def test_after_a_trip_the_cell_is_reset_and_resumed(following: CellUnderTest) -> None:
    following.run_until("run")
    following.inject("arm", stale=True)
    following.run_until_trip()
    following.clear("arm")
    moved_before = len(following.commands())
    following.reset()
    following.step(5)
    assert len(following.commands()) == moved_before, "a reset moves nothing"
    following.resume()
    assert following.finish().outcome.value == "done"


def test_a_weakened_interlock_is_noticed(cell: CellFactory) -> None:
    blind = cell(FOLLOW, set=TRUE_CONTACT | {"interlocks.stale_arm.limit_ms": 1000, "task.max_state_age_ms": 5000})
    blind.run_until("run")
    blind.inject("arm", stale=True)
    with pytest.raises(AssertionError, match="nothing tripped"):
        blind.run_until_trip(limit_s=0.1)
    blind.run_until_trip()
    with pytest.raises(AssertionError, match="expected arm_state_age"):
        blind.assert_tripped_by("arm_state_age")


def test_faults_may_be_there_from_the_start(cell: CellFactory) -> None:
    tripping = cell(FOLLOW, set=TRUE_CONTACT, faults={"arm": {"nan_state": True}})
    tripping.run_until_trip(limit_s=1.0)
    tripping.assert_tripped_by("finite")


def test_stop_ends_the_run_in_order(following: CellUnderTest) -> None:
    following.run_until("run")
    following.stop()
    assert following.finish().outcome.value == "stopped"
    assert "retract" in following.values("/task", "state")


def test_mistakes_are_named(cell: CellFactory, following: CellUnderTest) -> None:
    with pytest.raises(ConfigError, match="no device") as caught:
        following.inject("amr", stale=True)
    assert "arm" in caught.value.hint
    with pytest.raises(ConfigError, match="unknown fault") as caught:
        following.inject("arm", stale_=True)
    assert "stale" in caught.value.hint
    with pytest.raises(ConfigError, match="real time"):
        cell("dual_push_emulated.yaml")
    with pytest.raises(AssertionError, match="does not wait"):
        following.reset()
    with pytest.raises(AssertionError, match=r"still in|ended in"):
        following.run_until("nowhere", limit_s=0.1)
    assert replace(ArmFaults(), stale=True) != ArmFaults()


PRESS_BY_FORCE = {
    "task.steps": [{"move": {"by_mm_deg": [0, 0, 30], "speed_mm_s": 5, "until": {"force_n": 3}}}],
    "interlocks.contact_lost.states": ["move_1"],
}


def test_a_step_waits_for_the_force_that_the_arm_measures(cell: CellFactory) -> None:
    pressing = cell("steps_bench.yaml", on="sim", set=PRESS_BY_FORCE)
    assert pressing.finish().outcome.value == "done"
    # The simulated skin has 1.5 N/mm, so 3 N are 2 mm.
    assert pressing.values("/task", "depth_mm")[-1] == pytest.approx(2.0, abs=0.5)


def test_an_arm_that_measures_no_force_is_refused_for_such_a_step(cell: CellFactory) -> None:
    steps = [{"move": {"by_mm_deg": [0, 0, 30], "until": {"force_n": 3}}}]
    with pytest.raises(ConfigError, match=r"until\.force_n, but sim_arm measures no force"):
        cell("steps_sim.yaml", set={"task.steps": steps})


def test_states_that_are_not_finite_fault_a_stand_in_as_its_driver_does(cell: CellFactory) -> None:
    following = cell("surface_follow_bench.yaml", on="sim", set={"task.distance_mm": 20})
    following.run_until("run")
    following.inject("arm", nan_state=True)
    following.run_until_trip(limit_s=1.0)
    assert following.first_cause is not None
    assert following.first_cause.interlock == "device"


def test_the_ground_truth_tells_how_long_an_arm_moved_that_its_driver_cannot_see(cell: CellFactory) -> None:
    following = cell("surface_follow_bench.yaml", on="sim", set={"task.distance_mm": 20})
    following.run_until("run")
    following.run_for(0.3)
    following.inject("arm", stale=True)
    following.run_until_trip(limit_s=1.0)
    with pytest.raises(AssertionError, match="declared"):
        following.assert_stopped_as_declared()
    following.assert_truly_stopped_as_declared()


def test_an_arm_that_the_test_has_broken_is_given_back_all_the_same(cell):
    with CellUnderTest("single_push_bench.yaml", on="sim") as pushing:
        pushing.run_for(0.5)
        pushing.inject("arm", stale=True)
        pushing.run_until_trip(limit_s=1.0)
    assert pushing.cell.arms["arm"].state.name != "FAULTED"
