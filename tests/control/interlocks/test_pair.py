"""Slip, markers, and the object between two sensors: each interlock on synthetic contacts with known truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.coverage import ArmFacts, CannotTrip, CellFacts, SensorFacts
from touchcell.control.interlocks.pair import Carried
from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState, TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.proof import Proof, prove
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

DT_S = 0.01
DEFAULTS: dict[str, dict[str, Any]] = {
    "out_of_step": {"limit_mm_s": 5, "limit_mm": 2, "hold_ms": 50},
    "object_lost": {"limit_ms": 100},
    "toppling": {"limit_deg": 5, "limit_deg_s": 8, "limit_mm": 2, "hold_ms": 50},
    "slip": {"limit_ratio": 1.0, "hold_ms": 50},
    "markers_lost": {"limit_percent": 10, "frames": 3},
}
MOUNTS = {
    "leader_sensor": se3.from_euler_mm_deg(np.array([0, 0, 50.0, 0, 0, 0])),
    "follower_sensor": se3.from_euler_mm_deg(np.array([0, 0, 60.0, 0, 0, 30.0])),
}
# Bases rotated relative to each other, so that nothing holds by accident.
BASES = {
    "leader": se3.from_euler_mm_deg(np.array([-500.0, 0, 0, 0, 0, 20.0])),
    "follower": se3.from_euler_mm_deg(np.array([600.0, 100, 0, 0, 0, -150.0])),
}
ALONG_X = se3.from_euler_mm_deg(np.array([0, 0, 0, 0, 90.0, 0]))
AGAINST_X = se3.from_euler_mm_deg(np.array([0, 0, 0, 0, -90.0, 0]))


class HeldBox:
    """A box of 80 mm between two sensors, which may move, lean and be squeezed. The sensors stick to it.

    Attributes:
        T_world_box: (4, 4) pose of the box.
        offset_mm_deg: of each sensor from its first contact, in the surface's frame: [x y z alpha beta gamma].
    """

    def __init__(self) -> None:
        self.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, 0, 0]))
        self.offset_mm_deg = {"leader": np.array([0, 0, 3.0, 0, 0, 0]), "follower": np.array([0, 0, 3.0, 0, 0, 0])}
        self.touching = {"leader": True, "follower": True}
        self.now_ns = 10**9
        self.state = "push"
        self._before: dict[str, Array] = {}

    def view(self) -> CellView:
        self.now_ns += round(DT_S * 1e9)
        arms, sensors = {}, {}
        faces = {"leader": (-0.04, ALONG_X), "follower": (0.04, AGAINST_X)}
        for arm, (x_m, turn) in faces.items():
            T_box_f = turn.copy()
            T_box_f[0, 3] = x_m
            T_f_s = se3.from_euler_mm_deg(self.offset_mm_deg[arm])
            T_world_s = self.T_world_box @ T_box_f @ T_f_s
            T = se3.inverse(BASES[arm]) @ T_world_s @ se3.inverse(MOUNTS[f"{arm}_sensor"])
            twist = se3.log(T @ se3.inverse(self._before.get(arm, T))) / DT_S
            linear = (T[:3, 3] - self._before.get(arm, T)[:3, 3]) / DT_S
            self._before[arm] = T
            arms[arm] = ArmView(Stamped(TcpState(T, np.concatenate([linear, twist[3:]])), self.now_ns, 1))
            seen = SensorView(self.now_ns, self.now_ns, self.touching[arm], arm=arm)
            if self.touching[arm]:
                x, y, z = T_f_s[:3, 3]
                seen = replace(seen, depth_m=z, shear_m=float(np.hypot(x, y)), T_s_f=se3.inverse(T_f_s))
            sensors[f"{arm}_sensor"] = seen
        return CellView(self.now_ns, arms, sensors, self.state)


def rule(kind: str, **changes: Any) -> TimedInterlock:
    entry = {"kind": kind, **DEFAULTS[kind], **changes}
    (built,) = build_interlocks(parse_interlocks({kind: entry}), MOUNTS, PlanningScene(BASES))
    assert isinstance(built, TimedInterlock)
    return built


def watch(
    evaluate: TimedInterlock, held: HeldBox, seconds: float, move: Callable[[float], None] = lambda t: None
) -> Iterator[Violation | None]:
    past: InterlockState = {}
    for k in range(round(seconds / DT_S)):
        move(k * DT_S)
        found, past = evaluate.evaluate(held.view(), past)
        yield found


def first(*args: Any) -> tuple[float, Violation]:
    for k, found in enumerate(watch(*args)):
        if found is not None:
            return k * DT_S, found
    raise AssertionError("nothing was found")


def pushed_along(held: HeldBox) -> Callable[[float], None]:
    """Push the box and turn it about the vertical, as a rigid body."""

    def move(t_s: float) -> None:
        held.T_world_box = se3.from_euler_mm_deg(np.array([30 * t_s, 10 * t_s, 150.0, 0, 0, 20 * t_s]))

    return move


@pytest.mark.parametrize("kind", ["out_of_step", "object_lost", "toppling", "slip", "markers_lost"])
def test_a_box_that_is_pushed_and_turned_has_no_violation(kind: str) -> None:
    held = HeldBox()
    assert not any(watch(rule(kind), held, 1.0, pushed_along(held)))


def test_a_follower_that_falls_behind_is_out_of_step_by_the_speed_of_the_gap() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        pushed_along(held)(t_s)
        held.offset_mm_deg["follower"][2] = 3.0 - 10.0 * min(t_s, 0.15)

    at_s, found = first(rule("out_of_step"), held, 0.15, move)
    assert (found.unit, found.subject, found.limit) == ("mm/s", "follower_sensor", 5)
    # Along the line between slightly offset tips, and with the chord of the rotation.
    assert found.value == pytest.approx(10.0, abs=0.5)
    assert at_s == pytest.approx(0.06, abs=0.011)


def test_a_load_that_only_one_carries_is_out_of_step_by_depth() -> None:
    held = HeldBox()
    held.offset_mm_deg["leader"][2] = 5.5
    _, found = first(rule("out_of_step"), held, 0.2)
    assert (found.unit, found.value) == ("mm", pytest.approx(2.5))
    held.state = "retract"
    assert not any(watch(rule("out_of_step", states=["push"]), held, 0.2))


@pytest.mark.parametrize(
    ("gone", "subject", "words"),
    [
        ({"follower"}, "follower_sensor", "leader_sensor still pushes"),
        ({"leader"}, "leader_sensor", "follower_sensor still pushes"),
        ({"leader", "follower"}, "leader_sensor", "neither sensor has contact"),
    ],
)
def test_an_object_that_was_held_and_is_gone(gone: set[str], subject: str, words: str) -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        if t_s >= 0.2:
            held.touching.update(dict.fromkeys(gone, False))

    at_s, found = first(rule("object_lost"), held, 1.0, move)
    assert at_s == pytest.approx(0.30, abs=0.011)
    assert found.subject == subject
    assert words in found.reason


def test_an_object_that_was_never_held_cannot_be_lost() -> None:
    held = HeldBox()
    held.touching["follower"] = False
    assert not any(watch(rule("object_lost"), held, 0.5))


def test_a_short_loss_of_one_contact_is_tolerated() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        held.touching["follower"] = not 0.2 <= t_s < 0.26

    assert not any(watch(rule("object_lost"), held, 0.6, move))


def lean(held: HeldBox, deg_s: float) -> Callable[[float], None]:
    def move(t_s: float) -> None:
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, deg_s * max(t_s - 0.2, 0.0), 0]))

    return move


def test_leaning_slowly_trips_by_the_angle() -> None:
    held = HeldBox()
    at_s, found = first(rule("toppling"), held, 3.0, lean(held, 4.0))
    assert (found.unit, found.limit, found.subject) == ("deg", 5, "leader_sensor")
    assert found.value == pytest.approx(5.2, abs=0.1)
    assert at_s == pytest.approx(0.2 + 5.0 / 4.0 + 0.05, abs=0.03)


def test_toppling_trips_by_the_rate_long_before_the_angle() -> None:
    held = HeldBox()
    at_s, found = first(rule("toppling", limit_deg=20), held, 1.0, lean(held, 30.0))
    assert found.unit == "deg/s"
    assert 8.0 < found.value < 30.0
    assert at_s < 0.2 + 0.15


@pytest.mark.parametrize("sensors", [["leader_sensor"], ["follower_sensor", "leader_sensor"]])
def test_toppling_is_detected_with_one_sensor_and_in_either_order(sensors: list[str]) -> None:
    held = HeldBox()
    evaluate = rule("toppling", sensors=sensors, arms=[sensor.removesuffix("_sensor") for sensor in sensors])
    _, found = first(evaluate, held, 3.0, lean(held, 4.0))
    assert (found.unit, found.value) == ("deg", pytest.approx(5.2, abs=0.1))


def test_sensors_that_tilt_on_a_static_face_measure_no_leaning() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        for arm in ("leader", "follower"):
            held.offset_mm_deg[arm][3:5] = [20 * t_s, -15 * t_s]

    assert not any(watch(rule("toppling"), held, 0.8, move))


def test_a_face_that_rises_along_the_sensor_trips_before_it_leans() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        # Of the leader's frame, x points down.
        held.offset_mm_deg["leader"][0] = 10 * t_s

    at_s, found = first(rule("toppling"), held, 1.0, move)
    assert (found.unit, found.subject) == ("mm", "leader_sensor")
    assert at_s == pytest.approx(0.25, abs=0.02)
    sideways = HeldBox()

    def aside(t_s: float) -> None:
        sideways.offset_mm_deg["leader"][1] = 10 * t_s

    assert not any(watch(rule("toppling"), sideways, 0.5, aside))


def test_a_contact_made_anew_is_a_new_reference() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        lean(held, 4.0)(t_s)
        away = 0.9 <= t_s < 1.0
        held.touching = {"leader": not away, "follower": not away}

    assert not any(watch(rule("toppling"), held, 1.9, move))


def test_too_much_shear_per_depth_is_slip() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        held.offset_mm_deg["follower"][1] = 20.0 * t_s

    at_s, found = first(rule("slip", severity="limit"), held, 1.0, move)
    assert (found.subject, found.severity) == ("follower_sensor", Severity.LIMIT)
    assert found.value == pytest.approx(1.0 + 0.05 * 20 / 3, abs=0.1)
    assert at_s == pytest.approx(3.0 / 20.0 + 0.05, abs=0.02)


def test_a_too_shallow_contact_is_not_checked_for_slip() -> None:
    held = HeldBox()
    held.offset_mm_deg["leader"][:3] = [0.0, 2.0, 0.9]
    assert not any(watch(rule("slip"), held, 0.3))
    assert any(watch(rule("slip", min_depth_mm=0.5), held, 0.3))


def test_markers_missing_in_several_consecutive_frames_trip() -> None:
    view = HeldBox().view()
    evaluate = rule("markers_lost")
    past: InterlockState = {}
    found = []
    for k, share in enumerate([1.0, 0.85, 0.95, 0.85, 0.85, 0.85]):
        sensor = replace(view.sensors["leader_sensor"], seq=k, markers=share)
        violation, past = evaluate.evaluate(replace(view, sensors={"leader_sensor": sensor}), past)
        found.append(violation)
    assert [violation is not None for violation in found] == [False] * 5 + [True]
    assert (found[-1].value, found[-1].unit) == (pytest.approx(15.0), "%")


@pytest.mark.parametrize("kind", ["out_of_step", "object_lost", "toppling"])
def test_a_missing_sensor_is_a_config_error(kind: str) -> None:
    key = "sensors" if kind == "toppling" else "follower_sensor"
    changes = {"sensors": ["left"]} if kind == "toppling" else {"follower_sensor": "left"}
    with pytest.raises(ConfigError) as caught:
        rule(kind, **changes)
    assert caught.value.key == f"interlocks.{kind}.{key}"


def pushed_apart(held: HeldBox, mm_s: float) -> Callable[[float], None]:
    def move(t_s: float) -> None:
        pushed_along(held)(t_s)
        # Along the surface's normal, which points out of the box.
        held.offset_mm_deg["follower"] = np.array([0, 0, 3.0 - mm_s * t_s, 0, 0, 0])

    return move


def held_by(**changes: Any) -> TimedInterlock:
    return rule("out_of_step", **{"hold_ms": 0, **changes})


def test_the_rate_of_the_gap_is_in_millimetres_per_second_while_the_pair_turns_and_leaves_at_four_fifths() -> None:
    held = HeldBox()
    tight = list(watch(held_by(limit_mm_s=1.95, limit_mm=50), held, 0.2, pushed_apart(held, 2.0)))
    assert tight[1] is not None
    assert tight[1].value == pytest.approx(2.0, abs=0.15)
    assert tight[1].reason.startswith("tips close or part at 2")
    assert tight[1].unit == "mm/s"
    assert not any(watch(held_by(limit_mm_s=2.05, limit_mm=50), HeldBox(), 0.2, lambda t_s: None))
    held = HeldBox()

    def slower(t_s: float) -> None:
        pushed_apart(held, 2.0)(t_s) if t_s < 0.1 else None
        if t_s >= 0.1:
            held.offset_mm_deg["follower"] = held.offset_mm_deg["follower"] - np.array([0, 0, 1.7 * DT_S, 0, 0, 0])

    assert list(watch(held_by(limit_mm_s=1.95, limit_mm=50), held, 0.3, slower))[-1] is not None, "1.7 is above 1.56"


def test_depths_that_differ_count_in_millimetres_and_leave_at_four_fifths() -> None:
    held = HeldBox()
    depths = iter([5.0, 5.1, 4.7, 4.5, 5.0])

    def move(t_s: float) -> None:
        held.offset_mm_deg["leader"] = np.array([0, 0, next(depths), 0, 0, 0])

    found = [each is not None for each in watch(held_by(limit_mm_s=1e6, limit_mm=2.05), held, 0.05, move)]
    assert found == [False, True, True, False, False]


@pytest.mark.parametrize("missing", ["leader", "follower"])
def test_one_contact_alone_is_no_pair(missing: str) -> None:
    held = HeldBox()
    held.touching[missing] = False
    assert not any(watch(held_by(limit_mm_s=1e-3, limit_mm=1e-3), held, 0.1, pushed_apart(held, 20.0)))


@pytest.mark.parametrize("kind", ["out_of_step", "object_lost", "toppling"])
def test_in_other_states_of_the_task_nothing_is_judged(kind: str) -> None:
    held = HeldBox()
    elsewhere = rule(kind, states=["lift"])

    def move(t_s: float) -> None:
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, 200 * t_s, 0]))
        held.offset_mm_deg["follower"] = np.array([0, 0, 3.0 - 20 * t_s, 0, 0, 0])
        held.touching["leader"] = t_s < 0.2

    assert not any(watch(elsewhere, held, 0.6, move))
    held = HeldBox()
    held.state = "lift"
    assert any(watch(elsewhere, held, 0.6, move))


def test_a_contact_that_is_too_shallow_is_no_reference_for_leaning() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        depth_mm = 0.99 if t_s < 0.1 else 1.01
        held.offset_mm_deg = {arm: np.array([0, 0, depth_mm, 0, 0, 0]) for arm in held.offset_mm_deg}
        lean_deg = 20.0 if t_s < 0.1 else 0.0
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, lean_deg, 0]))

    assert not any(watch(rule("toppling", hold_ms=0, limit_deg_s=1e6, limit_mm=50), held, 0.3, move))


@pytest.mark.parametrize(("lean_deg", "found"), [(4.9, False), (5.1, True), (-5.1, True)])
def test_leaning_is_in_degrees_from_the_first_contact(lean_deg: float, found: bool) -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        turned = lean_deg if t_s > 0.0 else 0.0
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, turned, 0]))

    violations = list(watch(rule("toppling", hold_ms=0, limit_deg_s=1e6, limit_mm=50), held, 0.05, move))
    assert (violations[-1] is not None) == found
    if violations[-1] is not None:
        assert violations[-1].reason.startswith("leans by 5.1 deg, limit 5 deg")


def test_sliding_up_counts_by_the_vertical_part_of_the_shear_in_millimetres() -> None:
    held = HeldBox()
    # In the leader's frame, whose x axis points down.
    for x_mm, y_mm, expected in ((1.9, 5.0, False), (2.1, 0.0, True), (-2.1, 0.0, True), (0.0, 9.0, False)):
        held.offset_mm_deg = {arm: np.array([x_mm, y_mm, 3.0, 0, 0, 0]) for arm in held.offset_mm_deg}
        (violation,) = watch(rule("toppling", hold_ms=0, limit_deg=80, limit_deg_s=1e6), held, DT_S)
        assert (violation is not None) == expected, (x_mm, y_mm)
        if violation is not None:
            assert violation.reason == "slides up or down by 2.1 mm, limit 2 mm"


def test_fewer_arms_than_sensors_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="fewer arms than sensors"):
        rule("toppling", sensors=["leader_sensor", "follower_sensor"], arms=["leader"])


def test_what_a_loss_says_of_the_other_sensor() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        held.touching["follower"] = t_s < 0.05

    found = list(watch(rule("object_lost"), held, 0.3, move))[-1]
    assert found is not None
    assert found.subject == "follower_sensor"
    assert found.reason.startswith("no contact, and leader_sensor still pushes for ")


@given(st.integers(0, 10_000))
def test_the_velocity_of_a_tip_is_that_of_its_point_on_the_tool(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_world_base, T_base_tcp, T_tcp_sensor = (se3.exp(rng.normal(0.0, 0.5, 6)) for _ in range(3))
    twist, dt_s = rng.normal(0.0, 0.3, 6), 1e-6
    carried = Carried("sensor", T_world_base, T_tcp_sensor)
    sensor = SensorView(0, 0, True, T_s_f=np.eye(4), arm="arm")

    def view_of(T: Array) -> CellView:
        return CellView(0, {"arm": ArmView(Stamped(TcpState(T, twist), 0, 0))}, {"sensor": sensor}, "run")

    turned = se3.exp(np.concatenate([np.zeros(3), twist[3:] * dt_s]))
    later = T_base_tcp.copy()
    later[:3, :3] = turned[:3, :3] @ T_base_tcp[:3, :3]
    later[:3, 3] += twist[:3] * dt_s
    moved = carried.pose(view_of(later), sensor)[:3, 3] - carried.pose(view_of(T_base_tcp), sensor)[:3, 3]
    assert carried.velocity(view_of(T_base_tcp), sensor) == pytest.approx(moved / dt_s, abs=1e-5)


def test_tips_at_one_place_neither_close_nor_part_and_a_depth_that_is_not_known_is_not_compared() -> None:
    held = HeldBox()
    view = held.view()
    both = {role: view.arms[role.partition("_")[0]] for role in view.sensors}
    at_one_place = {
        arm: replace(both[f"{arm}_sensor"], state=Stamped(TcpState(T, np.full(6, 0.1)), view.now_ns, 1))
        for arm, T in (
            (arm, se3.inverse(BASES[arm]) @ se3.inverse(MOUNTS[f"{arm}_sensor"])) for arm in ("leader", "follower")
        )
    }
    for depths in ((0.003, 0.003), (None, 0.003), (0.003, None)):
        sensors = {
            role: replace(view.sensors[role], depth_m=depth)
            for role, depth in zip(("leader_sensor", "follower_sensor"), depths, strict=True)
        }
        for arms in (view.arms, at_one_place):
            found, _ = held_by(limit_mm_s=1e6, limit_mm=1e-3).evaluate(replace(view, arms=arms, sensors=sensors), {})
            assert found is None


def test_a_contact_just_deep_enough_is_a_reference_for_leaning() -> None:
    held = HeldBox()

    def move(t_s: float) -> None:
        held.offset_mm_deg = {arm: np.array([0, 0, 1.0, 0, 0, 0]) for arm in held.offset_mm_deg}
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, 20.0 if t_s > 0.1 else 0.0, 0]))

    assert any(watch(rule("toppling", hold_ms=0, limit_deg_s=1e6, limit_mm=50), held, 0.3, move))


def test_leaning_counts_as_over_down_to_four_fifths() -> None:
    held = HeldBox()
    leans = iter([0.0, 5.1, 4.9, 4.1, 3.9, 4.9])

    def move(t_s: float) -> None:
        held.T_world_box = se3.from_euler_mm_deg(np.array([0, 0, 150.0, 0, next(leans), 0]))

    found = [
        each is not None for each in watch(rule("toppling", hold_ms=0, limit_deg_s=1e6, limit_mm=50), held, 0.06, move)
    ]
    assert found == [False, True, True, True, False, False]


def test_an_arm_without_a_place_of_its_own_stands_at_the_origin() -> None:
    settings = parse_interlocks({"it": {"kind": "toppling", **DEFAULTS["toppling"]}})
    (built,) = build_interlocks(settings, MOUNTS, PlanningScene())
    for carried in built.sensors:  # type: ignore[union-attr]
        np.testing.assert_array_equal(carried.T_world_base, np.eye(4))


# --- what armed coverage shows these rules

LIMITS = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)
FACTS = CellFacts(
    DT_S,
    ("push",),
    {arm: ArmFacts(LIMITS, 1.0) for arm in BASES},
    {role: SensorFacts("network", role.partition("_")[0], T, 7e-3, 6e-3, 0.1) for role, T in MOUNTS.items()},
    PlanningScene(BASES),
)


def proofs(kind: str, **changes: Any) -> tuple[Proof, ...]:
    settings = parse_interlocks({"it": {"kind": kind, **DEFAULTS[kind], **changes}})
    (built,) = build_interlocks(settings, MOUNTS, PlanningScene(BASES))
    return prove("it", settings["it"], built, FACTS)


@pytest.mark.parametrize(
    ("kind", "key", "proven", "refused"),
    [
        ("toppling", "limit_deg", 44.0, 45.0),
        ("toppling", "limit_deg_s", 89.0, 90.0),
        ("toppling", "limit_mm", 5.8, 6.1),
        ("out_of_step", "limit_mm_s", 190.0, 205.0),
        ("out_of_step", "limit_mm", 6.7, 7.1),
        ("out_of_step", "hold_ms", 1900.0, 5000.0),
        ("object_lost", "limit_ms", 1900.0, 5000.0),
    ],
)
def test_the_largest_limit_that_is_proven(kind: str, key: str, proven: float, refused: float) -> None:
    for value, armed in ((proven, True), (refused, False)):
        found = proofs(kind, **{key: value})
        assert all(each.problem == "" for each in found) == armed, (value, found)


@pytest.mark.parametrize("kind", ["out_of_step", "object_lost"])
def test_a_pair_of_one_sensor_is_none(kind: str) -> None:
    found = proofs(kind, follower_sensor="leader_sensor", **({"follower": "leader"} if kind == "out_of_step" else {}))
    assert [each.problem for each in found] == ["leader and follower are one sensor, 'leader_sensor'"]
    assert not any(each.problem for each in proofs(kind))


def test_toppling_takes_one_or_two_sensors_each_once() -> None:
    (found,) = proofs("toppling", sensors=["leader_sensor", "leader_sensor"], arms=["leader", "leader"])
    assert found.problem == "names one sensor twice"
    assert not any(each.problem for each in proofs("toppling", sensors=["follower_sensor"], arms=["follower"]))
    with pytest.raises(ConfigError):
        proofs("toppling", sensors=["leader_sensor", "follower_sensor", "third"], arms=["leader", "follower", "x"])
    with pytest.raises(ConfigError):
        proofs("toppling", arms=["leader", "follower", "third"])


@pytest.mark.parametrize("kind", ["out_of_step", "object_lost", "toppling"])
def test_what_a_fault_puts_into_the_view_are_poses(kind: str) -> None:
    settings = parse_interlocks({"it": {"kind": kind, **DEFAULTS[kind]}})["it"]
    for fault in settings.faults(FACTS):  # type: ignore[attr-defined]
        assert not isinstance(fault, CannotTrip)
        for t_s in (0.0, 1.0):
            view = fault.change(FACTS.healthy(10**9, "push"), t_s)
            poses = [arm.state.value.T_base_tcp for arm in view.arms.values()]
            poses += [each.T_s_f for each in view.sensors.values() if each.T_s_f is not None]
            for T in poses:
                np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
                np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
