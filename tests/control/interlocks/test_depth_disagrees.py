"""The second depth channel along any axis: travel, slide, force, and how long a contact is the same one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.coverage import ArmFacts, CellFacts, Fault, SensorFacts
from touchcell.control.interlocks.depth_disagrees import DepthDisagreesConfig
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState
from touchcell.control.interlocks.violation import Violation
from touchcell.control.proof import prove
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.types import Array

CYCLE_NS = 10_000_000
START_NS = 10**12
MOUNT = se3.from_euler_mm_deg(np.array([0, 0, 60.0, 0, 0, 0]))
# The axis points along no axis of the base, and the sensor is far from its origin.
FIRST_TOUCH = se3.from_euler_mm_deg(np.array([310.0, -120.0, 75.0, 150.0, 25.0, -40.0]))
ENTRY: dict[str, Any] = {"kind": "depth_disagrees", "limit_mm": 3, "slide_mm": 5, "states": ["press"]}


class Press:
    """A sensor on an arm's tool at a place in the frame of its first touch, mm."""

    def __init__(self, **changes: Any) -> None:
        (self.rule,) = build_interlocks(parse_interlocks({"it": {**ENTRY, **changes}}), {"sensor": MOUNT})
        self.past: InterlockState = {}
        self.now_ns = START_NS

    def __call__(
        self,
        along_mm: float,
        depth_mm: float | None,
        *,
        x_mm: float = 0.0,
        y_mm: float = 0.0,
        force_n: float | None = None,
        wrench_age_ns: int = 0,
        after_ms: int = 10,
        arm: str | None = "arm",
        state: str = "press",
        contact: bool = False,
    ) -> Violation | None:
        self.now_ns += 1_000_000 * after_ms
        T_base_sensor = FIRST_TOUCH @ se3.from_euler_mm_deg(np.array([x_mm, y_mm, along_mm, 0, 0, 0]))
        wrench = None
        if force_n is not None:
            pushed = np.concatenate([-force_n * T_base_sensor[:3, 2], [50.0, 60.0, 70.0]])
            wrench = Stamped(pushed, self.now_ns - wrench_age_ns, 0)
        pose = Stamped(TcpState(T_base_sensor @ se3.inverse(MOUNT), np.zeros(6)), self.now_ns, 0)
        depth_m = None if depth_mm is None else 1e-3 * depth_mm
        sensor = SensorView(self.now_ns, 0, contact or depth_mm is not None, depth_m, arm=arm)
        view = CellView(self.now_ns, {"arm": ArmView(pose, wrench=wrench)}, {"sensor": sensor}, state)
        assert not hasattr(self.rule, "check")
        found, self.past = self.rule.evaluate(view, self.past)
        return found

    def touch(self) -> None:
        assert self(0.0, None) is None
        assert self(0.0, 0.0) is None


@pytest.mark.parametrize(("deep_mm", "found"), [(2.99, False), (3.01, True), (-3.01, True), (-2.99, False)])
def test_travel_counts_along_the_axis_of_the_first_touch_in_either_direction(deep_mm: float, found: bool) -> None:
    press = Press()
    press.touch()
    assert (press(deep_mm, 0.0) is not None) == found


def test_the_message_names_both_channels_in_millimetres_and_it_leaves_at_four_fifths() -> None:
    press = Press()
    press.touch()
    violation = press(6.5, 2.5)
    assert violation is not None
    assert violation.reason == "estimated depth is off the arm's travel by 4 mm, limit 3 mm"
    assert press(6.5, 4.05) is not None
    assert press(6.5, 4.15) is None


@pytest.mark.parametrize(("x_mm", "y_mm"), [(3.5, 3.5), (-3.5, 3.5), (0.0, 4.99), (4.99, 0.0)])
def test_a_slide_within_its_limit_keeps_the_reference(x_mm: float, y_mm: float) -> None:
    press = Press()
    press.touch()
    assert press(2.0, 2.0) is None
    assert press(5.5, 2.0, x_mm=x_mm, y_mm=y_mm) is not None


@pytest.mark.parametrize(("x_mm", "y_mm"), [(3.6, 3.6), (-3.6, -3.6), (0.0, 5.01), (5.01, 0.0)])
def test_after_a_longer_slide_the_reference_is_taken_anew_at_the_estimate(x_mm: float, y_mm: float) -> None:
    press = Press()
    press.touch()
    assert press(2.0, 2.0) is None
    assert press(5.5, 2.0, x_mm=x_mm, y_mm=y_mm) is None
    assert press(8.4, 2.0, x_mm=x_mm, y_mm=y_mm) is None
    assert press(8.6, 2.0, x_mm=x_mm, y_mm=y_mm) is not None


def test_a_contact_whose_depth_is_not_estimated_counts_as_none_deep() -> None:
    press = Press()
    press.touch()
    assert press(2.9, None, contact=True) is None
    assert press(3.1, None, contact=True) is not None


def test_a_contact_that_is_seen_to_begin_begins_at_no_depth_whatever_is_estimated() -> None:
    press = Press()
    assert press(0.0, None) is None
    assert press(0.0, 1.0) is None
    assert press(2.5, 0.0) is None
    assert press(3.1, 0.0) is not None


def test_it_may_disagree_for_its_time() -> None:
    press = Press(hold_ms=20)
    press.touch()
    assert [press(3.5, 0.0) is None for _ in range(3)] == [True, True, False]


def test_going_in_is_no_slide() -> None:
    press = Press()
    press.touch()
    assert press(7.0, 7.0) is None
    assert press(7.0, 3.9) is not None


@pytest.mark.parametrize(("gap_ms", "is_the_same"), [(490, True), (491, False)])
def test_a_contact_that_is_missing_for_half_a_second_at_most_is_the_same(gap_ms: int, is_the_same: bool) -> None:
    press = Press()
    press.touch()
    assert press(2.0, 2.0) is None
    assert press(6.0, None, after_ms=10) is None
    # From its old reference the sensor is 6 mm in; from a new one it has just touched.
    assert (press(6.0, 0.0, after_ms=gap_ms) is not None) == is_the_same


def test_a_reference_survives_elsewhere_for_half_a_second_only() -> None:
    press = Press()
    press.touch()
    assert press(2.0, 2.0, state="run") is None
    assert press(9.0, 2.0) is None, "the reference was dropped: only changes count"
    assert press(11.9, 2.0) is None
    assert press(12.1, 2.0) is not None


@pytest.mark.parametrize("arm", [None, "other"])
def test_a_sensor_that_no_arm_of_the_cell_carries_has_no_travel(arm: str | None) -> None:
    press = Press()
    press(0.0, None, arm=arm)
    press(0.0, 0.0, arm=arm)
    assert press(20.0, 0.0, arm=arm) is None


def test_force_along_the_axis_counts_by_the_stiffness_and_torque_does_not() -> None:
    press = Press(stiffness_n_mm=2.0, states=["elsewhere"])
    assert press(0.0, 5.0, force_n=10.0) is None
    assert press(0.0, 5.0, force_n=15.9) is None
    violation = press(0.0, 5.0, force_n=16.1)
    assert violation is not None
    assert violation.reason == "estimated depth is off the arm's force by 3.05 mm, limit 3 mm"
    assert press(0.0, 5.0, force_n=3.9) is not None
    assert press(0.0, 0.0, force_n=0.0) is None
    assert press(0.0, None) is None, "without contact there is no force to compare"


@pytest.mark.parametrize(("age_ns", "fresh"), [(0, True), (500_000_000, True), (500_000_001, False), (-1, False)])
def test_a_wrench_that_is_old_or_from_the_future_is_an_error(age_ns: int, fresh: bool) -> None:
    press = Press(stiffness_n_mm=2.0)
    if fresh:
        assert press(0.0, 0.0, force_n=0.0, wrench_age_ns=age_ns) is None
    else:
        with pytest.raises(ValueError, match="no fresh wrench"):
            press(0.0, 0.0, force_n=0.0, wrench_age_ns=age_ns)


def sideways(limits: TwistLimits | None) -> tuple[Array, CellFacts]:
    """Return the mount (4, 4) of a sensor that points sideways, and the facts of its cell."""
    mount = se3.from_euler_mm_deg(np.array([20.0, 30.0, 60.0, 70.0, 20.0, 0]))
    facts = CellFacts(
        0.01,
        ("press",),
        {"arm": ArmFacts(limits, 1.0, wrench=True)},
        {"sensor": SensorFacts("network", "arm", mount, 7e-3, 6e-3, 0.1)},
    )
    return mount, facts


@pytest.mark.parametrize("limits", [TwistLimits(0.02, 0.5, 0.5, 2.5, 50.0, 250.0), None])
@pytest.mark.parametrize("stiffness_n_mm", [None, 2.0])
def test_it_is_proven_on_a_mount_that_points_sideways(limits: TwistLimits | None, stiffness_n_mm: float | None) -> None:
    mount, facts = sideways(limits)
    # 25 mm in, while half of the 7 mm that the network can report are read.
    for limit_mm, armed in ((21.0, True), (22.0, False)):
        settings = parse_interlocks({"it": {**ENTRY, "limit_mm": limit_mm, "stiffness_n_mm": stiffness_n_mm}})
        (interlock,) = build_interlocks(settings, {"sensor": mount})
        found = prove("it", settings["it"], interlock, facts)
        assert all(proof.problem == "" for proof in found) == armed, found


def test_a_contact_that_began_elsewhere_is_as_deep_as_estimated() -> None:
    press = Press()
    for _ in range(2):
        assert press(4.0, 4.0, state="run") is None
    assert press(4.0, 4.0) is None
    assert press(6.9, 4.0) is None
    assert press(7.1, 4.0) is not None


def test_it_slides_five_millimetres_by_default() -> None:
    settings = parse_interlocks({"it": {each: ENTRY[each] for each in ("kind", "limit_mm", "states")}})["it"]
    assert isinstance(settings, DepthDisagreesConfig)
    assert settings.slide_mm == 5.0


@pytest.mark.parametrize(
    ("limits", "speed_mm_s"), [(TwistLimits(0.02, 0.5, 0.5, 2.5, 50.0, 250.0), 20.0), (None, 100.0)]
)
@pytest.mark.parametrize("stiffness_n_mm", [None, 2.0])
def test_the_faults_press_in_at_the_speed_of_the_gate_with_the_force_that_was_configured(
    limits: TwistLimits | None, speed_mm_s: float, stiffness_n_mm: float | None
) -> None:
    mount, facts = sideways(limits)
    settings = DepthDisagreesConfig.model_validate({**ENTRY, "stiffness_n_mm": stiffness_n_mm})
    cases = tuple(settings.faults(facts))
    healthy = facts.healthy(START_NS, "press")
    by_travel = cases[0]
    assert isinstance(by_travel, Fault)
    for t_s in (0.0, 0.05, 0.1, 10.0):
        travel_mm = min(speed_mm_s * t_s, 25.0)
        shown = by_travel.change(healthy, t_s)
        T_base_tcp = shown.arms["arm"].state.value.T_base_tcp
        np.testing.assert_allclose(1e3 * T_base_tcp[:3, 3], travel_mm * mount[:3, 2], atol=1e-9)
        wrench = shown.arms["arm"].wrench
        assert shown.sensors["sensor"].depth_m == pytest.approx(1e-3 * min(travel_mm, 3.5))
        assert (wrench is None) == (stiffness_n_mm is None)
        if wrench is not None and stiffness_n_mm is not None:
            force_n = 1e3 * min(1e-3 * travel_mm, 3.5e-3) * stiffness_n_mm
            np.testing.assert_allclose(wrench.value, [*(-force_n * mount[:3, 2]), 0.0, 0.0, 0.0], atol=1e-9)
    assert len(cases) == (1 if stiffness_n_mm is None else 2)
    for by_force in cases[1:]:
        assert isinstance(by_force, Fault)
        wrench = by_force.change(healthy, 0.0).arms["arm"].wrench
        assert wrench is not None
        np.testing.assert_allclose(wrench.value, [*(-50.0 * mount[:3, 2]), 0.0, 0.0, 0.0], atol=1e-9)
