"""All arms of a cell stop together, within what was declared, and one that does not is stopped by stronger means."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from touchcell.cell.runtime.stopping import STOP_MARGIN_S, Stopper, declared_stop
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import DeviceError, DeviceGone, TransportTimeout
from touchcell.drivers.core.protocols import StopCategory
from touchcell.simulation.devices.arm import SimArm, SimArmConfig
from touchcell.simulation.faults import ArmFaults

HOLD = StopCategory.STOP_AND_HOLD
POWER_OFF = StopCategory.STOP_THEN_REMOVE_POWER
SPEED = np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0])


class Pair:
    """Two simulated arms at 80 mm/s, with 0.5 m/s^2 to stop."""

    def __init__(self, categories: tuple[StopCategory, StopCategory] = (HOLD, HOLD)) -> None:
        self.clock = VirtualClock()
        config = SimArmConfig(start_pose_mm_deg=(0, 0, 0, 0, 0, 0))
        self.arms = {name: SimArm(name, config, self.clock) for name in ("left", "right")}
        self.stopper = Stopper(self.arms, dict(zip(self.arms, categories, strict=True)), self.clock, 0.01)
        self.states: list[tuple[str, float]] = []
        self.escalations: list[tuple[str, float]] = []
        leases = {}
        for name, arm in self.arms.items():
            arm.connect()
            arm.configure()
            arm.activate()
            leases[name] = arm.acquire("test")
        for _ in range(40):
            for name, arm in self.arms.items():
                arm.send_twist(TwistCommand(SPEED, TwistFrame.BASE, self.clock.now_ns(), 0.1), leases[name])
            self.clock.advance_s(0.01)

    def stop(self, **how: Any) -> Any:
        failed = self.stopper.stop(**{"tripped": True, **how})
        reports = self.stopper.watch(
            lambda role, state: self.states.append((role, float(np.linalg.norm(state.value.twist)))),
            lambda role, report, waited_s: self.escalations.append((role, waited_s)),
        )
        return failed, reports


def test_both_arms_stop_together_within_what_was_declared() -> None:
    pair = Pair()
    failed, reports = pair.stop()
    assert failed == {}
    for report in reports.values():
        assert report.kept
        assert not report.escalated
        assert report.speed_m_s == pytest.approx(0.08)
        # v/a = 0.16 s and v^2/2a = 6.4 mm, seen on a grid of 10 ms.
        assert report.time_s == pytest.approx(0.16, abs=0.0101)
        assert report.distance_m == pytest.approx(6.4e-3, abs=2e-4)
    assert reports["left"].time_s == reports["right"].time_s
    assert {role for role, _ in pair.states} == {"left", "right"}


def test_what_is_declared() -> None:
    time_s, distance_m = declared_stop(0.1, 0.5)
    assert time_s == pytest.approx(0.2 + STOP_MARGIN_S)
    assert distance_m == pytest.approx(0.01 + 0.1 * STOP_MARGIN_S)


def test_each_arm_stops_by_its_own_category() -> None:
    pair = Pair((HOLD, POWER_OFF))
    _, reports = pair.stop()
    assert {role: report.category for role, report in reports.items()} == {"left": HOLD, "right": POWER_OFF}
    assert pair.arms["left"].state is Lifecycle.ACTIVE
    assert pair.arms["right"].state is Lifecycle.READY


def test_an_arm_whose_work_is_done_keeps_its_power() -> None:
    pair = Pair((POWER_OFF, POWER_OFF))
    _, reports = pair.stop(tripped=False)
    assert {report.category for report in reports.values()} == {HOLD}
    assert pair.arms["left"].state is Lifecycle.ACTIVE


def test_an_arm_that_is_not_trusted_gets_the_strongest_stop_and_the_other_its_own() -> None:
    pair = Pair()
    _, reports = pair.stop(distrusted={"right"})
    assert {role: report.category for role, report in reports.items()} == {"left": HOLD, "right": POWER_OFF}


def test_an_arm_that_runs_on_is_stopped_by_stronger_means() -> None:
    pair = Pair()
    pair.arms["right"].faults = ArmFaults(ignores_expiry=True)
    _, reports = pair.stop()
    assert [role for role, _ in pair.escalations] == ["right"]
    assert pair.escalations[0][1] == pytest.approx(0.26, abs=0.0101)
    right = reports["right"]
    assert right.escalated
    assert not right.kept
    assert pair.arms["right"].at_rest()
    # It ran on for the declared 0.26 s, noticed within a cycle, and then took v/a.
    assert right.time_s == pytest.approx(0.26 + 0.16, abs=0.021)
    assert right.distance_m == pytest.approx(0.08 * 0.26 + 6.4e-3, abs=2e-3)
    assert reports["left"].kept


def test_an_arm_that_sinks_loses_its_power_to_the_brakes() -> None:
    pair = Pair()
    pair.arms["left"].faults = ArmFaults(drift_m_s=0.004)
    _, reports = pair.stop()
    assert reports["left"].escalated
    height = pair.arms["left"].tcp().value.T_base_tcp[2, 3]
    pair.clock.advance_s(1.0)
    assert pair.arms["left"].tcp().value.T_base_tcp[2, 3] == height


def test_an_arm_that_obeys_nothing_is_given_up_with_a_hint() -> None:
    pair = Pair()
    pair.arms["left"].faults = ArmFaults(ignores_stops=True, drift_m_s=0.004)
    _, reports = pair.stop()
    assert reports["left"].time_s is None
    assert "emergency stop" in reports["left"].problem
    assert reports["right"].kept


def test_a_deaf_arm_ends_with_its_last_command() -> None:
    pair = Pair()
    pair.arms["left"].faults = ArmFaults(ignores_stops=True)
    _, reports = pair.stop()
    assert pair.arms["left"].at_rest()
    left = reports["left"]
    # The command had 0.09 s to live.
    assert left.time_s == pytest.approx(0.09 + 0.16, abs=0.0101)
    assert left.distance_m == pytest.approx(0.08 * 0.09 + 6.4e-3, abs=5e-4)


def test_one_arm_that_cannot_be_told_does_not_keep_the_other_from_stopping(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = Pair()

    def gone(category: StopCategory) -> None:
        raise DeviceGone("left", "cable")

    monkeypatch.setattr(pair.arms["left"], "_begin_stop", gone)
    failed, reports = pair.stop()
    assert isinstance(failed["left"], DeviceError)
    assert reports["right"].kept


def test_an_arm_that_cannot_be_seen_is_not_taken_to_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = Pair()

    def unseen(max_age_s: float | None = None) -> None:
        raise TransportTimeout("left", "state", 0.1)

    monkeypatch.setattr(pair.arms["left"], "tcp", unseen)
    _, reports = pair.stop()
    left = reports["left"]
    assert left.escalated
    assert left.time_s is None
    assert "no state within" in left.problem
    assert pair.arms["left"].state is Lifecycle.READY
    assert reports["right"].kept


def test_all_arms_are_told_before_any_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = Pair()
    order: list[str] = []
    for name, arm in pair.arms.items():
        begin, tcp = arm._begin_stop, arm.tcp
        monkeypatch.setattr(arm, "_begin_stop", lambda c, n=name, f=begin: (order.append(f"{n} told"), f(c)))
        monkeypatch.setattr(arm, "tcp", lambda a=None, n=name, f=tcp: (order.append(f"{n} read"), f(a))[1])
    pair.stop()
    assert order[:2] == ["left told", "right told"]


def test_an_arm_that_tells_nonsense_is_still_stopped_and_given_the_time_of_its_fastest_motion() -> None:
    pair = Pair()
    pair.arms["left"].faults = ArmFaults(nan_state=True)
    _, reports = pair.stop()
    left = reports["left"]
    assert (left.speed_m_s, left.distance_m) == (None, None)
    assert left.declared_s == pytest.approx(0.1 / 0.5 + STOP_MARGIN_S)
    assert left.kept
