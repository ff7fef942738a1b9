"""Limits to the last digit: what passes at its limit, what a hair more does, from where it counts as over again.

And the message of each, word for word, as its numbers have units.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.always_on import Missing
from touchcell.control.interlocks.boundary import PROGRESS_NS, point_velocity
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.coverage import ArmFacts, CellFacts, SensorFacts
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState, Reading, Sustained
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.proof import prove
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.enabling import EnablingPosition
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.errors import ConfigError
from touchcell.geometry import se3

CYCLE_NS = 10_000_000
# Far from zero: a time is the difference of two stamps, and never their sum.
START_NS = 10**12
ARMS = {"arm": ArmFacts(TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0), 1.0, wrench=True, torque_joints=2)}
SENSORS = {
    "sensor": SensorFacts(
        "network", "arm", np.eye(4), 7e-3, 6e-3, 0.1, sigma_m=1e-3, innovations=True, images=True, markers=True
    )
}
FACTS = CellFacts(0.01, ("press", "run"), ARMS, SENSORS, enabling_device=True)


class Run:
    """One interlock, cycle after cycle of 10 ms."""

    def __init__(self, **entry: Any) -> None:
        mounts = {"sensor": np.eye(4), "other": np.eye(4)}
        (self.rule,) = build_interlocks(parse_interlocks({"it": entry}), mounts)
        self.past: InterlockState = {}
        self.k = 0

    @property
    def now_ns(self) -> int:
        return START_NS + self.k * CYCLE_NS

    def see(self, view: CellView) -> Violation | None:
        if hasattr(self.rule, "check"):
            found: Violation | None = self.rule.check(view)
            return found
        found, self.past = self.rule.evaluate(view, self.past)
        return found

    def sensor(self, *, task_state: str = "run", **seen: Any) -> Violation | None:
        self.k += 1
        sensor = replace(SensorView(self.now_ns, self.k, True, 0.003, arm="arm"), **seen)
        return self.see(CellView(self.now_ns, {}, {"sensor": sensor}, task_state))

    def arm(
        self,
        pose_mm_deg: Any = (0,) * 6,
        twist: Any = (0,) * 6,
        *,
        command: Any = None,
        sent: Any = None,
        wrench: Any = None,
        enabling: EnablingPosition | None = None,
        after_ms: int = 10,
    ) -> Violation | None:
        self.k += after_ms // 10
        now_ns = self.now_ns
        T = se3.from_euler_mm_deg(np.array(pose_mm_deg, dtype=float))
        arm = ArmView(
            Stamped(TcpState(T, np.array(twist, dtype=float)), now_ns, self.k),
            None if command is None else _command(command, now_ns),
            sent=None if sent is None else Sent(_command(sent, now_ns), now_ns),
            wrench=None if wrench is None else Stamped(np.array(wrench, dtype=float), now_ns, self.k),
        )
        device = None if enabling is None else Stamped(enabling, now_ns, self.k)
        return self.see(CellView(now_ns, {"arm": arm}, {}, "run", enabling=device))


def _command(twist: Any, now_ns: int) -> TwistCommand:
    return TwistCommand(np.array(twist, dtype=float), TwistFrame.BASE, now_ns, 0.03)


def reason(found: Violation | None) -> str:
    assert found is not None
    return found.reason


# --- any value with a limit to enter, one to leave, a time and a number of frames


def sustained(**settings: Any) -> Sustained:
    whole: dict[str, Any] = {"limit": 10.0, "leave": 8.0, "unit": "mm", **settings}
    return Sustained("it", Severity.TRIP, lambda view: (), "pressed by", **whole)


def sustain(rule: Sustained, values: list[float], seqs: list[int | None] | None = None) -> list[Violation | None]:
    past: InterlockState = {}
    found = []
    for k, value in enumerate(values):
        view = CellView(START_NS + k * CYCLE_NS, {}, {}, "run")
        violation, past = rule.over(view, [Reading("arm", value, seqs[k] if seqs else None)], past)
        found.append(violation)
    return found


def test_a_value_at_its_limit_passes_and_one_at_the_leave_limit_is_over_no_longer() -> None:
    found = sustain(sustained(), [10.0, 10.001, 8.001, 8.0, 8.001, 10.0])
    assert [violation is not None for violation in found] == [False, True, True, False, False, False]


def test_it_counts_from_the_cycle_in_which_its_time_is_full() -> None:
    found = sustain(sustained(hold_s=0.03), [11.0] * 5)
    assert [violation is not None for violation in found] == [False, False, False, True, True]
    assert found[3] is not None
    assert found[3].reason == "pressed by 11 mm, limit 10 mm, for 30 ms"
    assert (found[3].value, found[3].limit, found[3].unit, found[3].frame_seq) == (11.0, 10.0, "mm", None)


def test_frames_count_once_each_and_the_message_has_no_time_where_none_has_passed() -> None:
    found = sustain(sustained(frames=3, unit=""), [11.0] * 5, [7, 7, 8, 8, 9])
    assert [violation is not None for violation in found] == [False, False, False, False, True]
    assert reason(found[4]) == "pressed by 11, limit 10, for 40 ms"
    assert reason(sustain(sustained(), [11.0])[0]) == "pressed by 11 mm, limit 10 mm"


@pytest.mark.parametrize(
    ("entry", "key", "limit", "text"),
    [
        ({"kind": "shear", "limit_mm": 2}, "shear_m", 2e-3, "sheared by 2.002 mm, limit 2 mm"),
        ({"kind": "torsion", "limit_deg": 45}, "torsion_rad", math.pi / 4, "twisted by 45.04 deg, limit 45 deg"),
        (
            {"kind": "uncertain", "limit_mm": 0.5},
            "sigma_depth_m",
            5e-4,
            "standard deviation of the depth 0.5005 mm, limit 0.5 mm",
        ),
    ],
)
def test_readings_are_in_the_units_of_their_limits_and_leave_at_four_fifths(
    entry: dict[str, Any], key: str, limit: float, text: str
) -> None:
    run = Run(**entry, hold_ms=0)
    assert run.sensor(**{key: limit}) is None
    assert reason(run.sensor(**{key: 1.001 * limit})) == text
    assert run.sensor(**{key: 0.801 * limit}) is not None
    assert run.sensor(**{key: 0.799 * limit}) is None
    assert run.sensor(**{key: 0.999 * limit}) is None


def test_shear_per_depth_counts_from_the_least_depth_on_in_its_states_and_leaves_at_four_fifths() -> None:
    entry: dict[str, Any] = {
        "kind": "slip",
        "limit_ratio": 0.5,
        "min_depth_mm": 1.0,
        "hold_ms": 0,
        "states": ["press"],
    }
    run = Run(**entry)
    sheared = {"depth_m": 1e-3, "shear_m": 1e-3}
    assert run.sensor(**sheared, task_state="approach") is None
    assert run.sensor(depth_m=0.999e-3, shear_m=1e-3, task_state="press") is None
    assert reason(run.sensor(**sheared, task_state="press")) == "shear per depth 1, limit 0.5"
    assert run.sensor(depth_m=1e-3, shear_m=0.41e-3, task_state="press") is not None
    assert run.sensor(depth_m=1e-3, shear_m=0.39e-3, task_state="press") is None
    assert run.sensor(depth_m=1e-3, shear_m=0.5e-3, task_state="press") is None


# --- age, speed, depth


def test_ages_to_the_nanosecond() -> None:
    run = Run(kind="frame_age", limit_ms=50)
    run.k = 100
    view = CellView(run.now_ns, {}, {}, "run")

    def aged(*ages_ns: int) -> Violation | None:
        sensors = {
            role: SensorView(run.now_ns - age, 5, True) for role, age in zip(("sensor", "other"), ages_ns, strict=True)
        }
        return run.see(replace(view, sensors=sensors))

    assert aged(50_000_000, 0) is None
    assert reason(aged(50_000_001, 0)) == "newest frame is 50.0 ms old, limit 50 ms"
    assert reason(aged(0, -1)) == "newest frame is -0.0 ms old, limit 50 ms"
    found = aged(60_000_000, 80_000_000)
    assert found is not None
    assert (found.subject, found.value, found.frame_seq) == ("other", pytest.approx(0.08), 5)


def test_a_missing_sensor_is_named_with_the_limit_that_it_breaks() -> None:
    run = Run(kind="frame_age", limit_ms=50)
    found = run.see(CellView(run.now_ns, {}, {"sensor": SensorView(run.now_ns, 0, False)}, "run"))
    assert found is not None
    assert (found.subject, found.limit, found.unit) == ("other", 0.05, "s")


@pytest.mark.parametrize("first", [0, 3])
def test_the_speed_of_the_worst_arm_counts_measured_or_commanded_by_its_share_of_the_limit(first: int) -> None:
    run = Run(kind="tcp_speed", limit_m_s=0.25, limit_rad_s=0.25)
    at, above, leaving, left = (np.eye(6)[first] * value for value in (0.25, 0.2501, 0.2001, 0.2))
    assert run.arm(twist=at, command=at) is None
    unit = "m/s" if first == 0 else "rad/s"
    assert reason(run.arm(twist=above)) == f"measured speed is 0.2501 {unit}, limit 0.25 {unit}"
    assert reason(run.arm(command=leaving)) == f"commanded speed is 0.2001 {unit}, limit 0.2 {unit}"
    assert run.arm(twist=left, command=left) is None
    assert run.arm(twist=leaving) is None


def test_of_several_speeds_above_their_limits_the_worst_is_reported() -> None:
    run = Run(kind="tcp_speed", limit_m_s=0.1, limit_rad_s=1.0)
    assert "measured speed is 0.2 m/s" in reason(
        run.arm(twist=(0.12, 0.16, 0, 1.5, 0, 0), command=(0.15, 0, 0, 0, 0, 0))
    )
    assert "commanded speed is 3 rad/s" in reason(run.arm(twist=(0.2, 0, 0, 0, 0, 0), command=(0, 0, 0, 0, 3.0, 0)))


def test_the_deepest_sensor_is_reported_and_each_leaves_at_four_fifths() -> None:
    run = Run(kind="depth", limit_mm=4)

    def pressed(sensor_mm: float, other_mm: float) -> Violation | None:
        run.k += 1
        sensors = {
            role: SensorView(run.now_ns, run.k, True, 1e-3 * depth)
            for role, depth in (("sensor", sensor_mm), ("other", other_mm))
        }
        return run.see(CellView(run.now_ns, {}, sensors, "run"))

    assert pressed(4.0, 0.0) is None
    found = pressed(4.5, 5.0)
    assert found is not None
    assert (found.subject, found.reason) == ("other", "pressed in by 5.00 mm, limit 4 mm")
    found = pressed(5.0, 4.5)
    assert found is not None
    assert (found.subject, found.frame_seq) == ("sensor", run.k)
    assert reason(pressed(3.21, 3.19)) == "pressed in by 3.21 mm, limit 3.2 mm"
    assert pressed(3.2, 3.21) is None


# --- images


def test_brightness_at_its_limit_passes_and_frames_count_once_for_the_baseline() -> None:
    run = Run(kind="exposure", limit_percent=50)
    for _ in range(5):
        # A frame that is seen in three cycles is one frame.
        for _ in range(3):
            run.sensor(seq=run.k // 3, brightness=50.0)
    for k in range(5):
        assert run.sensor(seq=100 + k, brightness=150.0) is None
    # Five of 50 and five of 150.
    assert run.sensor(brightness=150.0) is None
    assert reason(run.sensor(brightness=150.1)) == "brightness 150.1 is 50.1 % off the first frames' 100.0, limit 50 %"
    assert run.sensor(brightness=50.0) is None


def test_light_after_a_dark_start_is_a_change() -> None:
    run = Run(kind="exposure", limit_percent=85)
    for _ in range(10):
        assert run.sensor(brightness=0.0) is None
    assert run.sensor(brightness=1.9e-6) is not None


# --- motion


def test_a_stopped_arm_may_settle_for_its_time_and_the_reference_begins_anew_after_a_violation() -> None:
    run = Run(kind="standstill", limit_mm=1, settle_ms=50)
    # 40 ms of settling, with 4 mm of way.
    assert [run.arm((k, 0, 0, 0, 0, 0)) for k in range(5)] == [None] * 5
    assert run.arm((10, 0, 0, 0, 0, 0)) is None
    assert run.arm((11, 0, 0, 0, 0, 0)) is None
    assert reason(run.arm((11.01, 0, 0, 0, 0, 0))) == "drifted by 1.01 mm while commanded to stop, limit 1 mm"
    assert run.arm((11.01, 0, 0, 0, 0, 0)) is None
    assert [run.arm((20 + k, 0, 0, 0, 0, 0)) for k in range(4)] == [None] * 4, "it settles once more"


def test_a_stopped_arm_drifts_by_position_and_not_by_turning() -> None:
    run = Run(kind="standstill", limit_mm=1, settle_ms=0)
    assert run.arm((0, 0, 0, 0, 0, 0)) is None
    assert run.arm((0, 0, 0, 90, 0, 0)) is None


def test_tracking_leaves_at_four_fifths_and_is_in_millimetres_per_second() -> None:
    run = Run(kind="tracking", limit_mm_s=10, hold_ms=0)
    assert run.arm(sent=(0.03, 0.04, 0, 0, 0, 0), twist=(0.03, 0.031, 0, 1.0, 0, 0)) is None
    assert reason(run.arm(sent=(0.0101, 0, 0, 0, 0, 0))) == "off what was sent by 10.1 mm/s, limit 10 mm/s"
    assert run.arm(sent=(0.0081, 0, 0, 0, 0, 0)) is not None
    assert run.arm(sent=(0.0079, 0, 0, 0, 0, 0)) is None


def test_what_limits_an_arm_is_named_with_how_long_it_did() -> None:
    run = Run(kind="limited", limit_ms=30)
    found = None
    for _ in range(5):
        run.k += 1
        sent = Sent(_command((0.1, 0, 0, 0, 0, 0), run.now_ns), run.now_ns, (Adjustment("tcp linear speed", 0.2, 0.1),))
        arm = ArmView(Stamped(TcpState(np.eye(4), np.zeros(6)), run.now_ns, run.k), sent=sent)
        found = run.see(CellView(run.now_ns, {"arm": arm}, {}, "run"))
        assert (found is None) == (run.k < 5)
    assert reason(found).startswith("limited by its gate (tcp linear speed) for 40 ms, limit 30 ms")


@pytest.mark.parametrize(
    ("twist", "moves"),
    [
        ((1e-3, 0, 0, 0, 0, 0), False),
        ((1.001e-3, 0, 0, 0, 0, 0), True),
        ((0, 0, 0, 0, 1e-2, 0), False),
        ((0, 0, 0, 0, 1.001e-2, 0), True),
        # Millimetres per second and radians per second do not add up.
        ((0.9e-3, 0, 0, 0.9e-2, 0, 0), False),
    ],
)
def test_an_arm_at_rest_needs_no_enabling_device_held(twist: Any, moves: bool) -> None:
    found = Run(kind="hold_to_run", limit_ms=100).arm(twist=twist, enabling=EnablingPosition.RELEASED)
    assert (found is not None) == moves


# --- force


def test_of_several_body_regions_the_least_force_and_the_least_pressure_count() -> None:
    # ISO/TS 15066:2016, Table A.2, quasi-static: palm 140 N and 260 N/cm2 (D hand), thigh 220 N and 250 N/cm2.
    for regions in (["palm_other", "thigh_muscle"], ["thigh_muscle", "palm_other"]):
        (settings,) = parse_interlocks(
            {"it": {"kind": "pressure", "arm": "arm", "regions": regions, "contact_area_mm2": 100}}
        ).values()
        transient, quasi_static = settings.limits()  # type: ignore[attr-defined]
        each = [
            parse_interlocks({"it": {"kind": "pressure", "arm": "arm", "regions": [name], "contact_area_mm2": 100}})[
                "it"
            ]
            for name in regions
        ]
        for found, index in ((transient, 0), (quasi_static, 1)):
            limits = [one.limits()[index] for one in each]  # type: ignore[attr-defined]
            assert found == (min(force for force, _ in limits), min(pressure for _, pressure in limits))
            assert limits[0] != limits[1]


def test_contact_force_is_a_force_and_no_torque_and_leaves_at_four_fifths() -> None:
    entry = {"kind": "pressure", "arm": "arm", "regions": ["palm_other"], "contact_area_mm2": 1e6}
    run = Run(**entry)
    assert run.arm(wrench=(0, 0, 0, 900, 0, 0)) is None
    transient_n = 2 * 140.0
    assert reason(run.arm(wrench=(0, 0, 1.01 * transient_n, 0, 0, 0))).startswith("contact force 282.8 N, limit 280 N")
    assert run.arm(wrench=(0, 0, 0.81 * transient_n, 0, 0, 0)) is not None
    assert run.arm(wrench=(0, 0, 0.79 * transient_n, 0, 0, 0)) is None


@pytest.mark.parametrize(
    "entry",
    [
        {"kind": "wrench", "arm": "arm", "limit_n": 5, "limit_nm": 1},
        {"kind": "pressure", "arm": "arm", "regions": ["palm_other"], "contact_area_mm2": 100},
    ],
)
def test_a_fault_of_a_force_is_a_wrench_of_six_numbers_after_none(entry: dict[str, Any]) -> None:
    faults = list(parse_interlocks({"it": entry})["it"].faults(FACTS))  # type: ignore[attr-defined]
    assert len(faults) > 1
    for fault in faults:
        healthy = FACTS.healthy(START_NS, "run")
        before = fault.before(healthy, -0.1).arms["arm"].wrench
        assert before is not None
        assert before.value.shape == (6,)
        assert not before.value.any()
        pushed = fault.change(healthy, 0.0).arms["arm"].wrench
        assert pushed is None or pushed.value.shape == (6,)


# --- boxes and cones

BOX = {"kind": "workspace", "arm": "arm", "min_mm": [-100, -100, 0], "max_mm": [100, 100, 300], "margin_mm": 10}
CONE = {"kind": "tilt", "arm": "arm", "direction": [0, 0, 1], "limit_deg": 20}


@given(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_a_point_on_a_lever_moves_as_a_rigid_body_has_it(numbers: list[float]) -> None:
    twist, lever = np.array(numbers[:6]), np.array(numbers[6:])
    R = se3.from_euler_mm_deg(np.array([0, 0, 0, 10.0, -50.0, 70.0]))[:3, :3]
    np.testing.assert_allclose(
        point_velocity(twist, R, lever), twist[:3] + np.cross(twist[3:], R @ lever), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ((101, 0, 100), "x = 101.0 mm is outside the box, limit 100 mm"),
        ((-101, 0, 100), "x = -101.0 mm is outside the box, limit -100 mm"),
        ((0, -102.5, 100), "y = -102.5 mm is outside the box, limit -100 mm"),
        ((0, 0, -1), "z = -1.0 mm is outside the box, limit 0 mm"),
        ((101, -102, 100), "y = -102.0 mm is outside the box, limit -100 mm"),
    ],
)
def test_the_wall_that_is_passed_furthest_is_named_on_either_side(place: Any, text: str) -> None:
    assert reason(Run(**BOX).arm((*place, 0, 0, 0))) == text


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_on_either_side_it_counts_as_inside_a_fifth_of_the_margin_from_the_wall(side: float) -> None:
    run = Run(**BOX)
    assert run.arm((0, 0, 0, 0, 0, 0)) is None, "a wall belongs to the inside"
    assert run.arm((side * 101, 0, 100, 0, 0, 0)) is not None
    text = f"x = {side * 98.1:.1f} mm is not yet 2 mm inside {side * 100:g} mm"
    assert reason(run.arm((side * 98.1, 0, 100, 0, 0, 0))) == text
    assert run.arm((side * 97.9, 0, 100, 0, 0, 0)) is None
    assert run.arm((side * 98.1, 0, 100, 0, 0, 0)) is None


def test_at_its_wall_what_was_outside_is_not_yet_inside() -> None:
    run = Run(**BOX)
    assert run.arm((101, 0, 100, 0, 0, 0)) is not None
    assert reason(run.arm((100, 0, 100, 0, 0, 0))) == "x = 100.0 mm is not yet 2 mm inside 100 mm"


def test_a_box_without_an_inside_is_refused() -> None:
    with pytest.raises(ConfigError):
        Run(**{**BOX, "min_mm": [-100, 0, 0], "max_mm": [100, 0, 300]})


@pytest.mark.parametrize("kind", ["workspace", "tilt"])
def test_of_an_arm_that_is_not_there_the_others_are_named(kind: str) -> None:
    entry: dict[str, Any] = {**(BOX if kind == "workspace" else CONE), "arm": "amr"}
    settings = parse_interlocks({"it": entry})
    (interlock,) = build_interlocks(settings, {})
    (found,) = prove("it", settings["it"], interlock, CellFacts(0.01, ("run",), ARMS, {}))
    assert found.problem == "the task has no arm 'amr'"
    assert found.hint == "did you mean 'arm'?"


@pytest.mark.parametrize("sensor", [None, "sensor"])
def test_what_a_fault_of_a_boundary_puts_into_the_view_are_poses(sensor: str | None) -> None:
    facts = FACTS if sensor is not None else CellFacts(0.01, ("run",), ARMS, {})
    for entry in (BOX, {**CONE, "direction": [1, 2, -3]}):
        settings = parse_interlocks({"it": {**entry, **({} if sensor is None else {"sensor": sensor})}})
        (interlock,) = build_interlocks(settings, {"sensor": np.eye(4)})
        assert getattr(interlock, "T_tcp_point", np.eye(4)).shape == (4, 4)
        faults = list(settings["it"].faults(facts))  # type: ignore[attr-defined]
        assert faults
        for fault in faults:
            T = fault.change(facts.healthy(START_NS, "run"), 0.0).arms["arm"].state.value.T_base_tcp
            np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
            np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_a_box_that_is_thin_is_entered_a_quarter_of_its_width_inside_its_walls() -> None:
    run = Run(**{**BOX, "min_mm": [-1, -100, 0], "max_mm": [1, 100, 300]})
    assert run.arm((1.1, 0, 100, 0, 0, 0)) is not None
    assert run.arm((0.6, 0, 100, 0, 0, 0)) is not None
    assert run.arm((0.4, 0, 100, 0, 0, 0)) is None


def test_beyond_two_walls_the_command_has_to_lead_back_along_each() -> None:
    corner = (105, -105, 100, 0, 0, 0)
    assert Run(**BOX).arm(corner, command=(-0.02, 0.02, 0, 0, 0, 0)) is None
    assert Run(**BOX).arm(corner, command=(-0.02, 0, 0, 0, 0, 0)) is not None
    assert Run(**BOX).arm(corner, command=(-0.02, -0.02, 0, 0, 0, 0)) is not None
    assert Run(**BOX).arm(corner, command=(0, 0.02, 0, 0, 0, 0)) is not None


@pytest.mark.parametrize(("inward", "passes"), [(0.034, True), (0.03, False), (0.017, False)])
def test_a_third_of_the_commanded_speed_has_to_lead_back(inward: float, passes: bool) -> None:
    found = Run(**BOX).arm((0, 0, 305, 0, 0, 0), command=(math.sqrt(0.01 - inward**2), 0, -inward, 0, 0, 0))
    assert (found is None) == passes


@pytest.mark.parametrize(("outward", "passes"), [(1.99e-3, True), (2.01e-3, False), (3.9e-3, False)])
def test_an_arm_commanded_back_may_be_measured_outwards_within_noise_only(outward: float, passes: bool) -> None:
    found = Run(**BOX).arm((0, 0, 305, 0, 0, 0), (0, 0, outward, 0, 0, 0), command=(0, 0, -0.02, 0, 0, 0))
    assert (found is None) == passes


@pytest.mark.parametrize(("inward", "passes"), [(0.51e-3, True), (0.49e-3, False)])
def test_after_its_time_half_a_millimetre_per_second_back_is_progress(inward: float, passes: bool) -> None:
    run = Run(**BOX)
    found = [
        run.arm((0, 0, 305, 0, 0, 0), (0, 0, -inward, 0, 0, 0), command=(0, 0, -0.02, 0, 0, 0)) is None
        for _ in range(PROGRESS_NS // CYCLE_NS + 2)
    ]
    assert found == [True] * (PROGRESS_NS // CYCLE_NS) + [passes] * 2


@pytest.mark.parametrize(("rate", "passes"), [(0.011, True), (0.009, False), (0.015, True)])
def test_an_axis_turns_back_at_a_hundredth_of_a_radian_per_second(rate: float, passes: bool) -> None:
    found = Run(**CONE).arm((0, 0, 0, 25, 0, 0), command=(0, 0, 0, -rate, 0, 0))
    assert (found is None) == passes


@pytest.mark.parametrize(("rate", "passes"), [(0.019, True), (0.021, False)])
def test_an_axis_commanded_back_may_be_measured_outwards_within_noise_only(rate: float, passes: bool) -> None:
    found = Run(**CONE).arm((0, 0, 0, 25, 0, 0), (0, 0, 0, rate, 0, 0), command=(0, 0, 0, -0.1, 0, 0))
    assert (found is None) == passes


def test_a_cone_has_its_limit_in_degrees_and_is_entered_at_four_fifths() -> None:
    run = Run(**CONE)
    assert run.arm((0, 0, 0, 19.99, 0, 0)) is None
    assert reason(run.arm((0, 0, 0, 20.5, 0, 0))) == "tilted by 20.5 deg, limit 20 deg"
    assert reason(run.arm((0, 0, 0, 16.1, 0, 0))) == "tilted by 16.1 deg, limit 16 deg"
    assert run.arm((0, 0, 0, 15.9, 0, 0)) is None
    upright = Run(**{**CONE, "limit_deg": 180})
    assert upright.arm((0, 0, 0, 180, 0, 0)) is None, "the limit itself is inside"


# --- missing


def test_a_sensor_has_its_second_wherever_the_clock_stands() -> None:
    rule = Missing("missing", Severity.FAULT, frozenset(), frozenset({"sensor"}))
    past: InterlockState = {}
    for k in range(101):
        found, past = rule.evaluate(CellView(START_NS + k * CYCLE_NS, {}, {}, "run"), past)
        assert found is None
    found, _ = rule.evaluate(CellView(START_NS + 101 * CYCLE_NS, {}, {}, "run"), past)
    assert found is not None


def test_an_overrun_is_in_milliseconds() -> None:
    run = Run(kind="overrun", limit_ms=50)
    assert run.arm() is None
    assert run.arm(after_ms=50) is None
    assert reason(run.arm(after_ms=60)) == "no control cycle for 60 ms, limit 50 ms"


# --- what armed coverage asks of a limit: the largest that is proven, and one that is refused


@pytest.mark.parametrize(
    ("entry", "key", "proven", "refused"),
    [
        ({"kind": "limited"}, "limit_ms", 9900, 15_000),
        ({"kind": "overrun"}, "limit_ms", 980, 1100),
        ({"kind": "inconsistent", "frames": 5}, "limit_nis", 970, 1010),
        ({"kind": "wrench", "arm": "arm", "limit_nm": 5}, "limit_n", 970, 1010),
        ({"kind": "wrench", "arm": "arm", "limit_n": 5}, "limit_nm", 290, 305),
        ({"kind": "external_torque", "arm": "arm"}, "limit_nm", 290, 305),
        ({"kind": "standstill", "settle_ms": 900}, "limit_mm", 180, 300),
        ({"kind": "standstill", "limit_mm": 1}, "settle_ms", 1900, 5000),
        ({"kind": "tracking", "hold_ms": 100}, "limit_mm_s", 97, 103),
        ({"kind": "tracking", "limit_mm_s": 50}, "hold_ms", 1900, 3000),
        ({"kind": "tcp_speed", "limit_rad_s": 1}, "limit_m_s", 0.29, 0.31),
        ({"kind": "tcp_speed", "limit_m_s": 0.2}, "limit_rad_s", 1.46, 1.51),
        ({"kind": "depth"}, "limit_mm", 6.8, 7.1),
        ({"kind": "shear", "hold_ms": 100}, "limit_mm", 5.8, 6.1),
        ({"kind": "torsion", "hold_ms": 100}, "limit_deg", 5.6, 5.8),
        ({"kind": "uncertain", "hold_ms": 100}, "limit_mm", 0.97, 1.01),
        ({"kind": "frame_age"}, "limit_ms", 980, 1500),
        ({"kind": "frame_frozen"}, "limit_ms", 1900, 3000),
        ({"kind": "contact_lost"}, "limit_ms", 1900, 3000),
        ({"kind": "exposure"}, "limit_percent", 97, 101),
        ({"kind": "hold_to_run"}, "limit_ms", 980, 1500),
        ({"kind": "tilt", "arm": "arm", "sensor": "sensor", "direction": [1, 2, -3]}, "limit_deg", 179, 180),
    ],
)
def test_the_largest_limit_that_is_proven(entry: dict[str, Any], key: str, proven: float, refused: float) -> None:
    for value, armed in ((proven, True), (refused, False)):
        settings = parse_interlocks({"it": {**entry, key: value}})
        (interlock,) = build_interlocks(settings, {"sensor": np.eye(4)})
        found = prove("it", settings["it"], interlock, FACTS)
        assert all(proof.problem == "" for proof in found) == armed, (value, found)


# --- what a fault puts into the snapshot


def test_the_faults_of_tcp_speed_are_measured_and_commanded_ones() -> None:
    settings = parse_interlocks({"it": {"kind": "tcp_speed", "limit_m_s": 0.2, "limit_rad_s": 1.0}})["it"]
    shown = []
    for fault in settings.faults(FACTS):  # type: ignore[attr-defined]
        arm = fault.change(FACTS.healthy(START_NS, "run"), 0.0).arms["arm"]
        shown.append((arm.state.value.twist.any(), arm.command is not None, fault.what.partition(" ")[0]))
    assert shown == [(True, False, "measured"), (False, True, "commanded")] * 2


@pytest.mark.parametrize("sensor", [None, "sensor"])
def test_a_box_for_the_tool_of_an_arm_that_carries_a_sensor_is_refused(sensor: str | None) -> None:
    entry: dict[str, Any] = {**BOX, "min_mm": [-100, -100, 0], "sensor": sensor}
    if sensor is None:
        del entry["sensor"]
    settings = parse_interlocks({"it": entry})["it"]
    (interlock,) = build_interlocks({"it": settings}, {"sensor": np.eye(4)})
    found = prove("it", settings, interlock, FACTS)
    assert all(proof.problem == "" for proof in found) == (sensor is not None), found
    bare = CellFacts(0.01, ("run",), ARMS, {})
    without = prove("it", settings, interlock, bare)
    assert all(proof.problem == "" for proof in without) == (sensor is None), without
    unknown = parse_interlocks({"it": {**entry, "arm": "amr"}})["it"]
    assert any(proof.problem for proof in prove("it", unknown, interlock, FACTS))
