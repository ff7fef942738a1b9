"""Moving by hand: nothing moves for longer than it is held, and never past what it would touch or leave."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fault_injection.fault_matrix import cells, on_true_contact
from tests.helpers.jog_script import Held, ScriptedJog, every_state
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.jog import Axes, JogFrame, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.interface import Observation, TaskContext
from touchcell.tasks.jog import SPEC, Jog, JogConfig

X: Axes = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
DOWN: Axes = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Along the z axis of a tool that points down."""


@dataclass
class Trace:
    """What an arm did: times from the first cycle, names of states, poses and speeds."""

    t_s: list[float]
    states: list[str]
    poses: list[Array]
    speeds_m_s: list[float]
    result: RunResult
    resting_s: float

    def moves_at(self, t_s: float) -> bool:
        return self.speeds_m_s[int(np.searchsorted(self.t_s, t_s))] > 1e-3


def jogged(
    folder: Path, script: Sequence[Held], until_s: float, *, dies_s: float = math.inf, change: Any = None
) -> Trace:
    data = on_true_contact(cells()["jog"])
    if change is not None:
        change(data)
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    cell, stop = compose(plan_cell(path), jog_input=ScriptedJog(script, dies_s)), StopRequest()
    trace = Trace([], [], [], [], None, 0.0)  # type: ignore[arg-type]
    with cell:
        loop = RunLoop(cell, None, stop=stop)
        loop.begin()
        start_ns = cell.clock.now_ns()
        going = True
        while going:
            t_s = (cell.clock.now_ns() - start_ns) * 1e-9
            if t_s >= until_s:
                stop.ask()
            state = cell.arms["arm"].tcp().value
            trace.t_s.append(t_s)
            trace.states.append(cell.task.state)
            trace.poses.append(state.T_base_tcp.copy())
            trace.speeds_m_s.append(float(np.linalg.norm(state.twist[:3])))
            going = loop.step()
        trace.result = loop.end()
        trace.resting_s = max(report.declared_s for report in trace.result.stops.values())
    return trace


def test_every_motion_and_its_end(tmp_path: Path) -> None:
    trace = jogged(tmp_path, every_state(), 5.0)
    seen = list(dict.fromkeys(trace.states))
    assert seen == ["prepare", "idle", "moving", "stepping", "until_touch", "release", "backing_off"]
    assert trace.result.outcome is Outcome.DONE
    assert trace.result.causes == ()
    # The tip starts 5 mm above the ramp; it stands within what a brake takes of the touch.
    lowest_mm = min(1e3 * pose[2, 3] for pose in trace.poses)
    assert 17.0 < lowest_mm < 20.5


DEAD_MAN_S, CYCLE_S = 0.15, 0.01


def test_letting_go_brings_the_arm_to_rest_in_time_whenever_it_happens(tmp_path: Path) -> None:
    """Twelve times, back and forth, each held for another time."""
    held, t_s = [], 0.3
    for k in range(12):
        axes = tuple((-1.0) ** k * x for x in X)
        held.append(Held(t_s, t_s + 0.08 + 0.0173 * k, JogRequest("arm", JogMode.FREE, axes)))
        t_s = held[-1].to_s + 0.5
    trace = jogged(tmp_path, held, t_s)
    for each in held:
        assert trace.moves_at(each.to_s + 0.05)
        assert not trace.moves_at(each.to_s + DEAD_MAN_S + 2 * CYCLE_S + trace.resting_s)
    assert trace.result.outcome is Outcome.DONE


def test_an_input_that_is_killed_while_it_is_held_brings_the_arm_to_rest_in_time(tmp_path: Path) -> None:
    trace = jogged(tmp_path, [Held(0.3, 9.0, JogRequest("arm", JogMode.FREE, X))], 1.5, dies_s=0.9)
    assert trace.moves_at(0.88)
    assert not trace.moves_at(0.9 + DEAD_MAN_S + 2 * CYCLE_S + trace.resting_s)
    assert trace.result.outcome is Outcome.DONE


def test_a_step_is_as_long_as_it_was_asked_for_and_done_once(tmp_path: Path) -> None:
    step = JogRequest("arm", JogMode.STEP, X, step_m=0.002)
    trace = jogged(tmp_path, [Held(0.3, 1.5, step)], 2.0)
    went_mm = 1e3 * (trace.poses[-1][:3, 3] - trace.poses[0][:3, 3])
    np.testing.assert_allclose(went_mm, [2.0, 0.0, 0.0], atol=0.1)


def test_a_turn_in_the_tools_frame_leaves_the_tool_where_it_is(tmp_path: Path) -> None:
    step = JogRequest("arm", JogMode.STEP, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), JogFrame.TOOL, step_rad=math.radians(2.0))
    trace = jogged(tmp_path, [Held(0.3, 1.5, step)], 2.0)
    turned = se3.log(se3.compose(se3.inverse(trace.poses[0]), trace.poses[-1]))
    np.testing.assert_allclose(np.degrees(turned[3:]), [0.0, 0.0, 2.0], atol=0.1)
    np.testing.assert_allclose(1e3 * turned[:3], 0.0, atol=0.05)


def test_a_held_key_stops_before_the_wall_and_nothing_trips(tmp_path: Path) -> None:
    trace = jogged(tmp_path, [Held(0.3, 5.0, JogRequest("arm", JogMode.FREE, (-1.0, 0, 0, 0, 0, 0)))], 4.0)
    assert trace.result.causes == ()
    x_mm = 1e3 * trace.poses[-1][0, 3]
    # interlocks.workspace of the cell begins at -150 mm.
    assert -150.0 < x_mm < -147.0


def test_after_a_touch_nothing_moves_until_the_key_is_let_go(tmp_path: Path) -> None:
    touch = JogRequest("arm", JogMode.UNTIL_TOUCH, DOWN, JogFrame.TOOL)
    trace = jogged(tmp_path, [Held(0.3, 4.0, touch)], 3.5)
    touched = trace.states.index("release")
    after = trace.poses[touched + 20 :]
    assert set(trace.states[touched : touched + 100]) == {"release"}
    assert float(np.ptp([pose[2, 3] for pose in after])) < 1e-5


def test_the_contact_frame_needs_a_contact(tmp_path: Path) -> None:
    free = JogRequest("arm", JogMode.FREE, X, JogFrame.CONTACT)
    trace = jogged(tmp_path, [Held(0.3, 0.8, free)], 1.5)
    assert "moving" not in trace.states
    assert "release" in trace.states
    np.testing.assert_allclose(trace.poses[-1], trace.poses[0], atol=1e-9)


def context(**changes: Any) -> TaskContext:
    return replace(TaskContext(100.0, {"sensor": np.eye(4)}, carriers={"sensor": "arm"}), **changes)


def observed(t_ns: int, jog: Stamped[JogRequest] | None, *, arm_t_ns: int | None = None) -> Observation:
    from touchcell.perception.runtime.estimate import ContactEstimate

    state = Stamped(TcpState(np.eye(4), np.zeros(6)), t_ns if arm_t_ns is None else arm_t_ns, t_ns)
    contact = ContactEstimate(False, None, t_ns, t_ns, t_ns)
    return Observation(t_ns, {"arm": state}, {"sensor": contact}, jog=jog)


def ready() -> Jog:
    task = Jog(JogConfig(), context())
    task.tick(observed(10_000_000, None))
    assert task.state == "idle"
    return task


REQUESTS = st.builds(
    JogRequest,
    arm=st.sampled_from(["arm", "other"]),
    mode=st.sampled_from(JogMode),
    axes=st.tuples(*(st.floats(-2.0, 2.0) | st.sampled_from([0.0, 1.0, math.nan, math.inf]) for _ in range(6))),
    frame=st.sampled_from(JogFrame),
    share=st.floats(-1.0, 2.0) | st.just(math.nan),
    step_m=st.floats(-1.0, 1.0) | st.just(0.001),
    step_rad=st.floats(-1.0, 1.0) | st.just(0.01),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(REQUESTS, st.integers(-300, 300), st.integers(0, 20)), min_size=1, max_size=30))
def test_whatever_an_input_asks_the_twist_is_finite_within_the_limits_and_only_of_what_is_held(
    asked: list[tuple[JogRequest, int, int]],
) -> None:
    task, config = ready(), JogConfig()
    for k, (request, age_ms, seq) in enumerate(asked, start=2):
        now_ns = k * 10_000_000
        action = task.tick(observed(now_ns, Stamped(request, now_ns - age_ms * 1_000_000, seq)))
        for command in action.twists.values():
            assert 0 <= age_ms <= config.dead_man_ms
            assert np.isfinite(command.twist).all()
            assert np.linalg.norm(command.twist[:3]) <= 1.001e-3 * config.speed_mm_s
            assert np.linalg.norm(command.twist[3:]) <= 1.001 * math.radians(config.turn_deg_s)
        assert not task.finished


def test_an_arm_whose_state_is_old_does_not_move() -> None:
    task = ready()
    jog = Stamped(JogRequest("arm", JogMode.FREE, X), 400_000_000, 1)
    assert task.tick(observed(400_000_000, jog, arm_t_ns=0)).twists == {}
    assert task.state == "release"


def test_a_cell_has_the_roles_that_it_names() -> None:
    assert SPEC.of_cell is not None
    spec = SPEC.of_cell(frozenset({"leader", "follower"}), frozenset({"tip"}))
    assert set(spec.arms) == {"leader", "follower"}
    assert spec.sensors == {"tip"}


def test_an_operators_stop_moves_nothing() -> None:
    task = ready()
    observation = replace(observed(20_000_000, None), operator_stop=True)
    assert task.tick(observation).twists == {}
    assert task.state == "done"


@pytest.mark.parametrize("then", [lambda r: replace(r, mode=JogMode.RETRACT), lambda r: replace(r, arm="other")])
def test_another_mode_or_arm_ends_the_motion_first(then: Callable[[JogRequest], JogRequest]) -> None:
    task = ready()
    request = JogRequest("arm", JogMode.FREE, X)
    assert task.tick(observed(20_000_000, Stamped(request, 20_000_000, 1))).twists
    assert task.tick(observed(30_000_000, Stamped(then(request), 30_000_000, 2))).twists == {}
    assert task.state == "idle"
