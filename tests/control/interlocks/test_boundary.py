"""Boxes and cones: what is outside, what leads back, and what has to be well inside before it counts as inside."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.boundary import PROGRESS_NS
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState, TimedInterlock
from touchcell.control.interlocks.violation import Violation
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3

CYCLE_NS = 10_000_000
BOX = {"kind": "workspace", "arm": "arm", "min_mm": [-100, -100, 0], "max_mm": [100, 100, 300], "margin_mm": 10}
CONE = {"kind": "tilt", "arm": "arm", "direction": [0, 0, 1], "limit_deg": 20}


class Run:
    """A rule asked cycle after cycle."""

    def __init__(self, entry: dict[str, Any], T_tcp_sensor: dict[str, Any] | None = None) -> None:
        (built,) = build_interlocks(parse_interlocks({"it": entry}), T_tcp_sensor or {})
        assert isinstance(built, TimedInterlock)
        self.rule = built
        self.past: InterlockState = {}
        self.k = 0

    def __call__(self, pose_mm_deg: Any, command: Any = None, measured: Any = (0,) * 6) -> Violation | None:
        self.k += 1
        now_ns = self.k * CYCLE_NS
        state = TcpState(se3.from_euler_mm_deg(np.array(pose_mm_deg, dtype=float)), np.array(measured, dtype=float))
        wanted = (
            None if command is None else TwistCommand(np.array(command, dtype=float), TwistFrame.BASE, now_ns, 0.03)
        )
        view = CellView(now_ns, {"arm": ArmView(Stamped(state, now_ns, self.k), wanted)})
        found, self.past = self.rule.evaluate(view, self.past)
        return found


OUTSIDE = (0, 0, 305, 0, 0, 0)
BACK = (0, 0, -0.02, 0, 0, 0)


@pytest.mark.parametrize(
    "command",
    [
        None,
        (0, 0, 0, 0, 0, 0),
        (0, 0, -1e-9, 0, 0, 0),
        (0, 0, -0.9e-3, 0, 0, 0),
        (0.1, 0, -1e-3, 0, 0, 0),
        (5.0, 0, -0.1, 0, 0, 0),
        (0, 0, 0.02, 0, 0, 0),
        (0, 0, -0.02, 0, 0, 0.0)[::-1],
    ],
)
def test_a_command_that_does_not_really_lead_back_is_none(command: Any) -> None:
    assert Run(BOX)(OUTSIDE, command) is not None


@pytest.mark.parametrize(
    "command", [BACK, (0.01, 0.01, -0.02, 0, 0, 0), (0, 0, -1e-3, 0, 0, 0), (0.02, 0, -0.01, 0, 0, 0)]
)
def test_a_command_that_leads_back_passes(command: Any) -> None:
    assert Run(BOX)(OUTSIDE, command) is None


def test_a_command_back_is_none_while_the_arm_is_measured_to_move_out() -> None:
    assert Run(BOX)(OUTSIDE, BACK, measured=(0, 0, 0.05, 0, 0, 0)) is not None
    assert Run(BOX)(OUTSIDE, BACK, measured=(0, 0, 1e-3, 0, 0, 0)) is None, "that is no more than noise"


def test_a_command_back_that_the_arm_does_not_follow_passes_for_a_moment_only() -> None:
    run = Run(BOX)
    stuck = [run(OUTSIDE, BACK) is None for _ in range(60)]
    assert stuck.index(False) == PROGRESS_NS // CYCLE_NS
    assert not any(stuck[stuck.index(False) :])
    moving = Run(BOX)
    assert all(moving(OUTSIDE, BACK, measured=BACK) is None for _ in range(60))


def test_turning_about_the_tool_counts_at_the_end_of_the_sensor() -> None:
    mount = {"sensor": se3.from_euler_mm_deg(np.array([0, 0, 100.0, 0, 0, 0]))}
    entry = {**BOX, "sensor": "sensor"}
    beside = (105, 0, 100, 0, 0, 0)
    assert Run(entry, mount)(beside, (0, 0, 0, 0, -0.1, 0)) is None
    assert Run(entry, mount)(beside, (0, 0, 0, 0, 0.1, 0)) is not None
    assert Run(entry, mount)(beside, (0, 0, 0, 0, -0.1, 0), measured=(0, 0, 0, 0, 0.1, 0)) is not None
    assert Run(entry, mount)((0, 0, 150, 0, 0, 0)) is None
    assert Run(entry, mount)((0, 0, 250, 0, 0, 0)) is not None


def test_what_was_outside_counts_as_outside_until_it_is_a_fifth_of_the_margin_inside() -> None:
    run = Run(BOX)
    assert run((0, 0, 299, 0, 0, 0)) is None
    assert run((0, 0, 301, 0, 0, 0)) is not None
    found = run((0, 0, 299, 0, 0, 0))
    assert found is not None
    assert "not yet 2 mm inside" in found.reason
    assert run((0, 0, 297.9, 0, 0, 0)) is None
    assert run((0, 0, 299, 0, 0, 0)) is None


def test_on_the_way_back_it_still_counts_as_outside_if_it_stops_too_early() -> None:
    run = Run(BOX)
    assert run(OUTSIDE) is not None
    assert run(OUTSIDE, BACK, measured=BACK) is None
    assert run((0, 0, 299, 0, 0, 0), BACK, measured=BACK) is None
    assert run((0, 0, 299, 0, 0, 0)) is not None


def test_a_box_thinner_than_its_margin_still_has_an_inside() -> None:
    run = Run({**BOX, "min_mm": [-100, -100, 290], "margin_mm": 200})
    assert run(OUTSIDE) is not None
    assert run((0, 0, 295, 0, 0, 0)) is None


def tilted(deg: float) -> tuple[float, ...]:
    return (0, 0, 100, deg, 0, 0)


@pytest.mark.parametrize(
    ("command", "passes"),
    [
        (None, False),
        ((0, 0, 0, -0.1, 0, 0), True),
        ((0, 0, 0, 0.1, 0, 0), False),
        ((0, 0, 0, -1e-9, 0, 0), False),
        ((0, 0, 0, -0.009, 0, 0), False),
        ((0, 0, 0, -0.02, 1.0, 0), False),
        ((0, 0, 0, -0.1, 0.1, 0), True),
        ((0, 0, -0.1, 0, 0, 0), False),
    ],
)
def test_of_turns_only_a_real_one_back_into_the_cone_passes(command: Any, passes: bool) -> None:
    assert (Run(CONE)(tilted(25), command) is None) == passes


def test_a_turn_back_is_none_while_the_arm_is_measured_to_tilt_further_or_does_not_follow() -> None:
    back = (0, 0, 0, -0.1, 0, 0)
    assert Run(CONE)(tilted(25), back, measured=(0, 0, 0, 0.1, 0, 0)) is not None
    run = Run(CONE)
    assert [run(tilted(25), back) is None for _ in range(40)].index(False) == PROGRESS_NS // CYCLE_NS


def test_what_was_tilted_counts_as_tilted_down_to_four_fifths() -> None:
    run = Run(CONE)
    assert run(tilted(19)) is None
    found = run(tilted(21))
    assert found is not None
    assert (found.value, found.limit) == (pytest.approx(math.radians(21)), pytest.approx(math.radians(20)))
    found = run(tilted(17))
    assert found is not None
    assert found.limit == pytest.approx(math.radians(16))
    assert run(tilted(15.9)) is None
    assert run(tilted(19)) is None


def test_a_tool_that_points_straight_away_can_turn_back() -> None:
    assert Run(CONE)(tilted(179), (0, 0, 0, -0.1, 0, 0)) is None
    assert Run(CONE)(tilted(180)) is not None


def test_a_depth_that_was_too_deep_counts_as_such_down_to_four_fifths_for_its_own_sensor() -> None:
    (built,) = build_interlocks(parse_interlocks({"it": {"kind": "depth", "limit_mm": 4}}), {})
    assert isinstance(built, TimedInterlock)
    past: InterlockState = {}
    told = []
    for k, (left, right) in enumerate([(3.9, 3.9), (4.1, 3.9), (3.99, 3.9), (3.21, 3.9), (3.19, 3.9), (3.9, 3.9)]):
        sensors = {
            "left": SensorView(k, k, True, 1e-3 * left),
            "right": SensorView(k, k, True, 1e-3 * right),
        }
        found, past = built.evaluate(CellView(k, {}, sensors), past)
        told.append(None if found is None else (found.subject, found.limit))
    assert told == [None, ("left", 0.004), ("left", 0.0032), ("left", 0.0032), None, None]


def test_a_speed_that_was_too_high_counts_as_such_down_to_four_fifths() -> None:
    run = Run({"kind": "tcp_speed", "limit_m_s": 0.1, "limit_rad_s": 1.0})
    fast, slower, slow = ((v, 0, 0, 0, 0, 0) for v in (0.11, 0.09, 0.079))
    assert run(tilted(0), measured=slower) is None
    assert run(tilted(0), measured=fast) is not None
    assert run(tilted(0), measured=slower) is not None
    assert run(tilted(0), command=slower) is not None, "nor may it be commanded"
    assert run(tilted(0), measured=slow) is None
    assert run(tilted(0), measured=slower) is None


@given(
    place=st.tuples(*[st.floats(-400, 400)] * 3),
    command=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)
def test_no_command_that_passes_outside_the_box_leads_further_away(place: Any, command: Any) -> None:
    run = Run(BOX)
    if run((*place, 0, 0, 0), (*command, 0, 0, 0)) is not None:
        return
    low, high = np.array(BOX["min_mm"]), np.array(BOX["max_mm"])
    before = np.linalg.norm(place - np.clip(place, low, high))
    # 10 ms later, in mm.
    after = np.array(place) + 10.0 * np.array(command)
    assert before == 0.0 or np.linalg.norm(after - np.clip(after, low, high)) < before
