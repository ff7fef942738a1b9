"""Each interlock at, just inside and just outside its limit; invalid settings of each."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.basic import Finite
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Severity
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import ConfigError
from touchcell.geometry import se3

NOW = 1_000_000_000
SENSOR_MOUNT = {"sensor": se3.from_euler_mm_deg(np.array([0, 0, 100.0, 0, 0, 0]))}
PAIR = {"leader_sensor": "sensor", "follower_sensor": "sensor"}
ONE = {"sensors": ["sensor"], "arms": ["arm"]}
GOOD = {
    "box": {
        "kind": "workspace",
        "arm": "arm",
        "sensor": "sensor",
        "min_mm": [-100, -100, 0],
        "max_mm": [100, 100, 300],
        "margin_mm": 10,
    },
    "speed": {"kind": "tcp_speed", "limit_m_s": 0.1, "limit_rad_s": 1.0},
    "depth": {"kind": "depth", "limit_mm": 6.0},
    "frames": {"kind": "frame_age", "limit_ms": 100},
    "states": {"kind": "arm_state_age", "limit_ms": 50, "severity": "fault"},
    "readings": {"kind": "reading_age", "limit_ms": 50},
    "tilt": {"kind": "tilt", "arm": "arm", "sensor": "sensor", "direction": [0, 0, 2], "limit_deg": 20},
    "frozen": {"kind": "frame_frozen", "limit_ms": 200},
    "exposure": {"kind": "exposure", "limit_percent": 20},
    "uncertain": {"kind": "uncertain", "limit_mm": 1},
    "range": {"kind": "out_of_range", "limit_ms": 200},
    "nis": {"kind": "inconsistent", "limit_nis": 22.5, "frames": 5},
    "lost": {"kind": "contact_lost", "limit_ms": 500},
    "shear": {"kind": "shear", "limit_mm": 5},
    "torsion": {"kind": "torsion", "limit_deg": 8},
    "tracking": {"kind": "tracking", "limit_mm_s": 20, "hold_ms": 100},
    "stand": {"kind": "standstill", "limit_mm": 1, "settle_ms": 500},
    "limited": {"kind": "limited", "limit_ms": 300},
    "slip": {"kind": "slip", "limit_ratio": 1.0},
    "markers": {"kind": "markers_lost", "limit_percent": 10},
    "step": {"kind": "out_of_step", **PAIR, "limit_mm_s": 5, "limit_mm": 2, "hold_ms": 100},
    "object": {"kind": "object_lost", **PAIR, "limit_ms": 100},
    "topple": {"kind": "toppling", **ONE, "limit_deg": 5, "limit_deg_s": 10, "limit_mm": 3, "hold_ms": 100},
}


def view(pose_mm_deg=(0, 0, 100, 0, 0, 0), twist=(0,) * 6, command=None, state_ns=NOW, **sensor) -> CellView:
    state = TcpState(se3.from_euler_mm_deg(np.array(pose_mm_deg, dtype=float)), np.array(twist, dtype=float))
    wanted = None if command is None else TwistCommand(np.array(command, dtype=float), TwistFrame.TCP, NOW, 0.03)
    seen = SensorView(t_frame_ns=NOW, seq=17, in_contact=True, depth_m=0.003)
    return CellView(
        NOW,
        {"arm": ArmView(Stamped(state, state_ns, 5), wanted)},
        {"sensor": replace(seen, **sensor) if sensor else seen},
    )


def rule(name):
    return build_interlocks(parse_interlocks({name: GOOD[name]}), SENSOR_MOUNT)[0]


def judge(interlock, seen):
    """What a rule finds in a first cycle."""
    return interlock.evaluate(seen, {})[0] if isinstance(interlock, TimedInterlock) else interlock.check(seen)


@pytest.mark.parametrize("name", GOOD)
def test_a_cell_at_rest_has_no_violation(name):
    assert judge(rule(name), view()) is None


@pytest.mark.parametrize(
    ("name", "inside", "outside", "value", "limit", "unit"),
    [
        ("box", {"pose_mm_deg": (0, 0, 199, 0, 0, 0)}, {"pose_mm_deg": (0, 0, 201, 0, 0, 0)}, 0.301, 0.3, "m"),
        ("box", {"pose_mm_deg": (-100, 0, 9, 0, 0, 0)}, {"pose_mm_deg": (-101, 0, 9, 0, 0, 0)}, -0.101, -0.1, "m"),
        # Upside down, the sensor is 100 mm below the tool.
        ("box", {"pose_mm_deg": (0, 0, 101, 180, 0, 0)}, {"pose_mm_deg": (0, 0, 99, 180, 0, 0)}, -0.001, 0.0, "m"),
        ("speed", {"twist": (0.06, 0.08, 0, 0, 0, 0)}, {"twist": (0.06, 0.09, 0, 0, 0, 0)}, None, 0.1, "m/s"),
        ("speed", {"twist": (0, 0, 0, 0, 0, 1)}, {"twist": (0, 0, 0, 0, 0, -1.1)}, 1.1, 1.0, "rad/s"),
        ("speed", {"command": (0, 0, 0.1, 0, 0, 0)}, {"command": (0, 0, -0.11, 0, 0, 0)}, 0.11, 0.1, "m/s"),
        ("depth", {"depth_m": 0.006}, {"depth_m": 0.0061}, 0.0061, 0.006, "m"),
        ("frames", {"t_frame_ns": NOW - 100_000_000}, {"t_frame_ns": NOW - 101_000_000}, 0.101, 0.1, "s"),
        ("frames", {"t_frame_ns": NOW}, {"t_frame_ns": NOW + 1_000_000}, -0.001, 0.1, "s"),
        # The sensor's z axis is the tool's.
        (
            "tilt",
            {"pose_mm_deg": (0, 0, 100, 19, 0, 70)},
            {"pose_mm_deg": (0, 0, 100, 0, 21, 0)},
            math.radians(21),
            math.radians(20),
            "rad",
        ),
        ("states", {"state_ns": NOW - 50_000_000}, {"state_ns": NOW - 51_000_000}, 0.051, 0.05, "s"),
    ],
)
def test_limits(name, inside, outside, value, limit, unit):
    interlock = rule(name)
    assert judge(interlock, view(**inside)) is None
    found = judge(interlock, view(**outside))
    assert found is not None
    assert (found.interlock, found.severity, found.unit, found.t_ns) == (name, interlock.severity, unit, NOW)
    assert found.value == pytest.approx(math.hypot(0.06, 0.09) if value is None else value, abs=1e-12)
    assert found.limit == pytest.approx(limit)
    assert found.frame_seq == (17 if name in ("depth", "frames") else None)


@pytest.mark.parametrize(
    ("pose_mm_deg", "back", "away"),
    [
        ((0, 0, 201, 0, 0, 0), (0, 0, -0.01, 0, 0, 0), (0.01, 0, 0, 0, 0, 0)),
        ((0, 0, 201, 0, 0, 0), (0.02, 0, -0.01, 0, 0, 0), (0, 0, 0.01, 0, 0, 0)),
        # Below and beside the box: it has to come back along both axes.
        ((105, 0, -110, 0, 0, 0), (-0.01, 0, 0.01, 0, 0, 0), (-0.01, 0, 0, 0, 0, 0)),
        # The tool rotates, and the sensor at its end swings back or away.
        ((105, 0, 100, 0, 0, 0), (0, 0, 0, 0, -0.1, 0), (0, 0, 0, 0, 0.1, 0)),
        # Along its own axis, and turned over: the command is along tool axes.
        ((0, 0, 99, 180, 0, 0), (0, 0, -0.01, 0, 0, 0), (0, 0, 0.01, 0, 0, 0)),
    ],
)
def test_motion_back_into_the_workspace_is_allowed(pose_mm_deg, back, away):
    box = rule("box")
    assert judge(box, view(pose_mm_deg=pose_mm_deg, command=back)) is None
    assert judge(box, view(pose_mm_deg=pose_mm_deg, command=away)) is not None
    assert judge(box, view(pose_mm_deg=pose_mm_deg)) is not None


def test_turning_back_into_the_cone_is_allowed():
    tilt = rule("tilt")
    tilted = (0, 0, 100, 25, 0, 30)
    assert judge(tilt, view(pose_mm_deg=tilted, command=(0, 0, 0, -0.1, 0, 0))) is None
    assert judge(tilt, view(pose_mm_deg=tilted, command=(0, 0, 0, 0.1, 0, 0))) is not None
    assert judge(tilt, view(pose_mm_deg=tilted, command=(0, 0, 0.1, 0, 0, 0))) is not None


def test_the_worst_of_two_speeds_is_reported():
    found = judge(rule("speed"), view(twist=(0.12, 0, 0, 0, 0, 0), command=(0, 0, 0, 0, 0, 5.0)))
    assert (found.value, found.unit) == (5.0, "rad/s")


def test_no_contact_is_no_depth():
    assert judge(rule("depth"), view(in_contact=False, depth_m=None)) is None


def test_a_tool_without_sensor_is_guarded_at_its_centre_point():
    settings = {"box": {k: v for k, v in GOOD["box"].items() if k != "sensor"}}
    (box,) = build_interlocks(parse_interlocks(settings), {})
    assert judge(box, view(pose_mm_deg=(0, 0, 299, 0, 0, 0))) is None
    assert judge(box, view(pose_mm_deg=(0, 0, 301, 0, 0, 0))).subject == "arm"


def test_severity_comes_from_the_settings():
    assert rule("states").severity is Severity.FAULT
    assert rule("frames").severity is Severity.TRIP


bad_numbers = st.sampled_from([math.nan, math.inf, -math.inf])


@given(bad=bad_numbers, place=st.integers(0, 5))
def test_anything_not_finite_is_found(bad, place):
    twist = np.zeros(6)
    twist[place] = bad
    pose = np.eye(4)
    pose[place % 3, place % 4] = bad
    broken = [
        view(twist=twist),
        view(command=twist),
        view(depth_m=bad),
        view(nis=bad),
        view(sigma_depth_m=bad),
        view(shear_m=bad),
        view(torsion_rad=bad),
        view(brightness=bad),
        view(T_s_f=pose),
        view(markers=bad),
        CellView(NOW, {"arm": ArmView(Stamped(TcpState(pose, np.zeros(6)), NOW, 1))}),
        CellView(
            NOW,
            {
                "arm": ArmView(
                    Stamped(TcpState(np.eye(4), np.zeros(6)), NOW, 1),
                    TwistCommand(np.zeros(6), TwistFrame.TCP, NOW, bad),
                )
            },
        ),
    ]
    for case in broken:
        found = Finite().check(case)
        assert found is not None
        assert found.severity is Severity.FAULT
    assert Finite().check(view(command=(1,) * 6, nis=3.0, sigma_depth_m=1e-4)) is None


def test_infinities_that_cancel_are_found_and_finite_numbers_whose_sum_is_too_large_are_not():
    found = Finite().check(view(nis=math.inf, shear_m=-math.inf))
    assert found is not None
    assert found.reason == "innovation is not finite"
    assert Finite().check(view(nis=1.7e308, shear_m=1.7e308)) is None


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ({"kind": "depth"}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": None}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": 0}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": -1}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": math.nan}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": math.inf}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_m": 0.006}, "interlocks.x.limit_mm"),
        ({"kind": "depth", "limit_mm": 6, "limit_deg": 1}, "interlocks.x.limit_deg"),
        ({"kind": "tcp_speed", "limit_m_s": 0.1}, "interlocks.x.limit_rad_s"),
        ({"kind": "frame_age", "limit_ms": 10, "severity": "limit"}, "interlocks.x.severity"),
        ({"kind": "limited", "limit_ms": 300, "severity": "limit"}, "interlocks.x.severity"),
        ({"kind": "inconsistent", "limit_nis": 20}, "interlocks.x.frames"),
        ({"kind": "contact_lost", "limit_ms": 20, "states": []}, "interlocks.x.states"),
        ({**GOOD["tilt"], "direction": [0, 0, 0]}, "interlocks.x"),
        ({"kind": "finite"}, "interlocks.x"),
        ({"limit_mm": 6}, "interlocks.x"),
        ({**GOOD["box"], "min_mm": [200, -100, 0]}, "interlocks.x"),
        ({**GOOD["box"], "max_mm": [100, 100]}, "interlocks.x.max_mm.2"),
    ],
)
def test_wrong_settings_name_their_key(entry, key):
    with pytest.raises(ConfigError) as caught:
        parse_interlocks({"x": entry})
    assert caught.value.key == key


def test_an_unknown_sensor_is_a_config_error():
    with pytest.raises(ConfigError) as caught:
        build_interlocks(parse_interlocks({"box": GOOD["box"]}), {"left": np.eye(4)})
    assert caught.value.key == "interlocks.box.sensor"
    assert "left" in caught.value.hint


def test_every_kind_is_listed_with_one_line():
    # The others have test files of their own.
    elsewhere = {
        "clearance",
        "overrun",
        "depth_disagrees",
        "wrench",
        "external_torque",
        "pressure",
        "hold_to_run",
        "reading",
    }
    assert set(INTERLOCKS.names()) == elsewhere | {entry["kind"] for entry in GOOD.values()}
    for kind in INTERLOCKS.names():
        spec = INTERLOCKS.load(kind)
        assert spec.config.model_fields["kind"].annotation == Literal[kind]
        assert spec.summary
        assert "\n" not in spec.summary
