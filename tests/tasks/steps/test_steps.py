"""Guarded motions: what each step does, when it ends, and what the compiler adds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.helpers.kinematic_plant import CONTEXT, DT, KinematicPlant
from touchcell.geometry import se3
from touchcell.tasks.state_machine import lint
from touchcell.tasks.steps.compiler import compile_steps
from touchcell.tasks.steps.model import Hold, Move, Record, Repeat, Retract, Servo, StepsConfig, Until
from touchcell.tasks.steps.task import StepsTask

TOUCH = {"move": {"by_mm_deg": [0, 0, 30], "until": {"contact": True}}}
PRESS = {"servo": {"depth_mm": 2, "until": {"time_s": 2}}}


def task_of(*steps: Any, **more: Any) -> StepsTask:
    return StepsTask(StepsConfig.model_validate({"steps": list(steps), **more}), CONTEXT)


def states_of(task: StepsTask) -> list[str]:
    return [record.target for record in task.transitions]


def depth_mm(plant: KinematicPlant) -> float:
    return float(1e3 * plant.sensor_in_surface()[2, 3])


def test_touch_press_hold_retract() -> None:
    task, plant = task_of(TOUCH, PRESS, {"hold": {"time_s": 0.5}}, {"retract": {"distance_mm": 15}}), KinematicPlant()
    plant.run(task, until="servo_2")
    assert 0.0 < depth_mm(plant) < 0.5
    plant.run(task, until="hold_3")
    labels = se3.to_euler_mm_deg(plant.sensor_in_surface())
    assert labels[2] == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(labels[3:5], 0.0, atol=0.5)
    held = []
    while task.state == "hold_3":
        held.append(plant.T_w_s)
        plant.cycle(task)
    assert len(held) == pytest.approx(0.5 / DT, abs=2)
    np.testing.assert_allclose(held, np.broadcast_to(held[0], (len(held), 4, 4)), atol=1e-12)
    plant.run(task)
    assert task.succeeded
    assert depth_mm(plant) == pytest.approx(2.0 - 15.0, abs=0.3)
    assert states_of(task) == ["move_1", "servo_2", "hold_3", "retract_4", "done"]


def test_the_same_task_is_written_in_python() -> None:
    written = StepsConfig(
        steps=[
            Move(by_mm_deg=(0, 0, 30), until=Until(contact=True)),
            Servo(depth_mm=2, until=Until(time_s=2)),
        ]
    )
    assert written == StepsConfig.model_validate({"steps": [TOUCH, PRESS]})


def test_a_move_that_should_touch_and_does_not_fails_and_withdraws() -> None:
    task, plant = task_of({"move": {"by_mm_deg": [0, 0, 3], "until": {"contact": True}}}), KinematicPlant(gap_mm=30)
    plant.run(task)
    assert task.state == "failed"
    assert "contact" in next(record.reason for record in task.transitions if record.event == "unmet")
    assert depth_mm(plant) == pytest.approx(-30 + 3 - 20, abs=0.5)


@pytest.mark.parametrize(
    ("until", "reason"),
    [
        ({"distance_mm": 4}, "moved"),
        ({"time_s": 0.3}, "0.3"),
        ({"depth_mm": 1.5}, "depth"),
        ({"contact": True}, "contact"),
    ],
)
def test_each_condition_ends_a_move(until: dict[str, Any], reason: str) -> None:
    task = task_of({"move": {"velocity_mm_deg_s": [0, 0, 10, 0, 0, 0], "until": until}})
    plant = KinematicPlant(gap_mm=2, tilt_deg=(0.0, 0.0))
    plant.run(task)
    assert task.succeeded
    assert task.transitions[-1].reason.startswith(reason)


def weighed(gap_mm: float) -> KinematicPlant:
    """A plant whose arm measures the force on its tip, besides the weight of a tool."""
    plant = KinematicPlant(gap_mm=gap_mm, tilt_deg=(0.0, 0.0))
    plant.force_n = lambda depth_mm: 4.0 + 1.5 * depth_mm
    return plant


def test_a_force_ends_a_move_whatever_the_tool_weighs() -> None:
    task = task_of({"move": {"by_mm_deg": [0, 0, 30], "speed_mm_s": 5, "until": {"force_n": 3}}})
    plant = weighed(2)
    plant.run(task)
    assert task.succeeded
    assert task.transitions[-1].reason.startswith("force 3.")
    assert depth_mm(plant) == pytest.approx(2.0, abs=0.15)


def test_a_move_that_should_feel_a_force_and_does_not_fails() -> None:
    task = task_of({"move": {"by_mm_deg": [0, 0, 3], "until": {"force_n": 3}}})
    weighed(30).run(task)
    assert task.state == "failed"
    assert "force of 3 N" in next(record.reason for record in task.transitions if record.event == "unmet")


def test_without_a_fresh_force_the_arm_does_not_move_towards_it() -> None:
    task, plant = task_of({"move": {"by_mm_deg": [0, 0, 30], "until": {"force_n": 3}}}), KinematicPlant()
    before = plant.T_w_s
    plant.run(task)
    assert task.state == "tripped"
    np.testing.assert_allclose(plant.T_w_s, before, atol=1e-12)


def test_contact_false_ends_a_move_when_the_sensor_is_free() -> None:
    task = task_of(TOUCH, {"move": {"velocity_mm_deg_s": [0, 0, -10, 0, 0, 0], "until": {"contact": False}}})
    plant = KinematicPlant()
    plant.run(task)
    assert task.succeeded
    assert -1.0 < depth_mm(plant) <= 0.0


@pytest.mark.parametrize("frame", ["base", "tool", "sensor"])
def test_a_displacement_is_along_the_axes_of_its_frame(frame: str) -> None:
    plant = KinematicPlant(gap_mm=60)
    T_tcp_sensor = CONTEXT.T_tcp_sensor["sensor"]
    T_w_tcp = se3.compose(plant.T_w_s, se3.inverse(T_tcp_sensor))
    plant.run(task := task_of({"move": {"frame": frame, "by_mm_deg": [3, -2, 5], "tolerance_mm": 0.01}}))
    assert task.succeeded
    moved = se3.compose(plant.T_w_s, se3.inverse(T_tcp_sensor))[:3, 3] - T_w_tcp[:3, 3]
    axes = {"base": np.eye(3), "tool": T_w_tcp[:3, :3], "sensor": (T_w_tcp @ T_tcp_sensor)[:3, :3]}[frame]
    np.testing.assert_allclose(1e3 * axes.T @ moved, [3, -2, 5], atol=0.05)


def test_a_displacement_in_the_contact_frame_slides_along_the_surface() -> None:
    task, plant = (
        task_of(TOUCH, PRESS, {"move": {"frame": "contact", "by_mm_deg": [2, 1, 0], "tolerance_mm": 0.01}}),
        (KinematicPlant()),
    )
    plant.run(task)
    assert task.succeeded
    np.testing.assert_allclose(se3.to_euler_mm_deg(plant.sensor_in_surface())[:3], [2, 1, 2], atol=0.1)


def test_a_pose_in_the_base_frame_is_reached() -> None:
    plant = KinematicPlant(gap_mm=60)
    T_w_tcp = se3.compose(plant.T_w_s, se3.inverse(CONTEXT.T_tcp_sensor["sensor"]))
    goal = se3.to_euler_mm_deg(T_w_tcp) + np.array([5, 5, 5, 0, 0, 3])
    plant.run(task := task_of({"move": {"to_mm_deg": goal.tolist()}}))
    assert task.succeeded
    reached = se3.compose(plant.T_w_s, se3.inverse(CONTEXT.T_tcp_sensor["sensor"]))
    np.testing.assert_allclose(reached, se3.from_euler_mm_deg(goal), atol=1e-2)


def test_repeats_nest_and_count() -> None:
    inner = {"repeat": {"times": 2, "steps": [{"hold": {"name": "a", "time_s": 0.02}}]}}
    task = task_of({"repeat": {"times": 3, "steps": [inner, {"hold": {"name": "b", "time_s": 0.02}}]}})
    KinematicPlant().run(task)
    assert states_of(task) == ["a", "a", "b"] * 3 + ["done"]


@given(outer=st.integers(1, 4), inner=st.integers(1, 4))
def test_a_nested_last_step_counts_both_loops(outer: int, inner: int) -> None:
    task = task_of(
        {
            "repeat": {
                "times": outer,
                "steps": [{"repeat": {"times": inner, "steps": [{"hold": {"name": "a", "time_s": 0.01}}]}}],
            }
        }
    )
    KinematicPlant().run(task)
    assert states_of(task).count("a") == outer * inner


def test_record_writes_pose_and_contact_once() -> None:
    task, plant = task_of(TOUCH, PRESS, {"record": {"label": "felt"}}), KinematicPlant()
    written = [action.telemetry for action in plant.run(task) if "felt_contact_z_mm" in action.telemetry]
    assert len(written) == 1
    assert written[0]["felt_contact_z_mm"] == pytest.approx(2.0, abs=0.1)
    assert {f"felt_tool_{name}" for name in ("x_mm", "gamma_deg")} <= written[0].keys()


def test_stop_withdraws_and_then_stops() -> None:
    task, plant = task_of(TOUCH, PRESS), KinematicPlant()
    plant.run(task, until="servo_2")
    plant.operator_stop = True
    plant.run(task)
    assert states_of(task)[-2:] == ["withdraw", "stopped"]
    assert depth_mm(plant) < -15


@pytest.mark.parametrize("step", [TOUCH, {"move": {"velocity_mm_deg_s": [0, 0, 1, 0, 0, 0], "until": {"time_s": 9}}}])
@pytest.mark.parametrize("missing", ["frames", "states"])
def test_no_step_moves_without_fresh_data_and_the_task_trips(step: dict[str, Any], missing: str) -> None:
    task, plant = task_of(step), KinematicPlant(gap_mm=25)
    plant.run(task, until="move_1")
    setattr(plant, missing, False)
    actions = plant.run(task)
    assert task.state == "tripped"
    assert all(not action.twists for action in actions[-round(0.4 / DT) :])


def test_a_retract_needs_no_frames() -> None:
    task, plant = task_of(TOUCH, {"retract": {"distance_mm": 10}}), KinematicPlant()
    plant.run(task, until="retract_2")
    plant.frames = False
    plant.run(task)
    assert task.succeeded


def test_a_servo_that_loses_its_contact_trips() -> None:
    task, plant = task_of(TOUCH, {"servo": {"depth_mm": 2, "until": {"time_s": 9}}}), KinematicPlant()
    plant.run(task, until="servo_2")
    plant.touching = False
    plant.run(task)
    assert task.state == "tripped"


@pytest.mark.parametrize(
    ("steps", "complaint"),
    [
        ([], "at least 1"),
        ([{"mvoe": {}}], "did you mean 'move'"),
        ([{"move": {}, "hold": {}}], "one key"),
        ([{"hold": 3}], "mapping"),
        ([{"move": {"by_mm_deg": [1, 2]}}], "by_mm_deg"),
        ([{"move": {}}], "exactly one of"),
        ([{"move": {"velocity_mm_deg_s": [0, 0, 1, 0, 0, 0]}}], "needs until"),
        ([{"move": {"by_mm_deg": [0, 0, 1], "until": {}}}], "names no condition"),
        ([{"servo": {"until": {"time_s": 1}}}], "depth_mm and reference_mm_deg"),
        ([{"hold": {"time_s": 1, "name": "done"}}], "not a free"),
        ([{"hold": {"time_s": 1, "name": "x"}}, {"hold": {"time_s": 1, "name": "x"}}], "used twice"),
        ([{"move": {"to_mm_deg": [0] * 6, "frame": "tool"}}], "base frame"),
        ([{"hold": {"time_s": float("inf")}}], "finite"),
        ([{"repeat": {"times": 0, "steps": [{"hold": {"time_s": 1}}]}}], "greater than 0"),
    ],
)
def test_mistakes_are_named(steps: list[Any], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        StepsConfig.model_validate({"steps": steps})


LEAVES = st.one_of(
    st.builds(lambda: Hold(time_s=0.05)),
    st.builds(lambda: Retract(distance_mm=1)),
    st.builds(lambda: Record(label="x")),
    st.builds(lambda: Move(by_mm_deg=(0, 0, 1))),
    st.builds(lambda: Servo(depth_mm=1, until=Until(time_s=0.1))),
)


def _repeats(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.builds(
        lambda times, steps: Repeat(times=times, steps=steps),
        st.integers(1, 3),
        st.lists(inner, min_size=1, max_size=3),
    )


PROGRAMS = st.lists(st.recursive(LEAVES, _repeats, max_leaves=8), min_size=1, max_size=5)


@given(PROGRAMS)
def test_every_program_compiles_to_a_table_without_faults(steps: list[Any]) -> None:
    program = compile_steps(StepsConfig(steps=steps))
    model = _Anything()
    assert lint(program.table, model) == []
    assert all(definition.terminal or definition.timeout_s for definition in program.table.states)


class _Anything:
    def __getattr__(self, name: str) -> Any:
        return lambda *_: True


@given(PROGRAMS, st.integers(0, 400))
def test_a_trip_at_any_moment_ends_all_motion(steps: list[Any], cycles: int) -> None:
    task, plant = StepsTask(StepsConfig(steps=steps), CONTEXT), KinematicPlant(gap_mm=-1.0)
    for _ in _cycles(task, cycles):
        plant.cycle(task)
    if not task.finished:
        task.trip(plant.now_ns, "test")
        assert task.state == "tripped"
    assert plant.cycle(task).twists == {}


def _cycles(task: StepsTask, limit: int) -> Iterator[int]:
    for i in range(limit):
        if task.finished:
            return
        yield i


def test_steps_are_read_from_a_cell_file_whose_numbers_are_lists() -> None:
    # Cell files are held to the strict rules for JSON, where a list stands for a tuple.
    text = json.dumps({"steps": [{"repeat": {"times": 2, "steps": [TOUCH, PRESS]}}], "withdraw_mm": 10})
    config = StepsConfig.model_validate_json(text, strict=True)
    (repeat,) = config.steps
    assert isinstance(repeat, Repeat)
    assert isinstance(repeat.steps[0], Move)
    assert repeat.steps[0].by_mm_deg == (0.0, 0.0, 30.0)
