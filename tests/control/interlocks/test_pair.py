"""Slip, markers, and the object between two sensors: each interlock on synthetic contacts with known truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState, TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

DT_S = 0.01
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
    defaults: dict[str, dict[str, Any]] = {
        "out_of_step": {"limit_mm_s": 5, "limit_mm": 2, "hold_ms": 50},
        "object_lost": {"limit_ms": 100},
        "toppling": {"limit_deg": 5, "limit_deg_s": 8, "limit_mm": 2, "hold_ms": 50},
        "slip": {"limit_ratio": 1.0, "hold_ms": 50},
        "markers_lost": {"limit_percent": 10, "frames": 3},
    }
    entry = {"kind": kind, **defaults[kind], **changes}
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
