"""The inside of the emulated UR controller, stepped by hand: no process, no clock."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain
from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator import program as ur_program
from touchcell.drivers.ur.emulator.controller import Controller
from touchcell.drivers.ur.emulator.host import ProgramError
from touchcell.drivers.ur.emulator.motion import Trapezoid
from touchcell.drivers.ur.emulator.program import (
    DONE,
    JOINTS_IN_LIMITS,
    POSE_IN_LIMITS,
    ControlProgram,
)
from touchcell.drivers.ur.emulator.script import ScriptError, parse_program
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode

PERIOD_S = 0.002
SCRIPT = "def rtde_control():\n rtde_set_watchdog()\nend\n"
ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)


def run(controller: Controller, seconds: float) -> None:
    for _ in range(round(seconds / PERIOD_S)):
        controller.step()


def command(controller: Controller, number: int, doubles: list[float] = [], *integers: int) -> None:  # noqa: B006
    values: dict[str, Value] = {"input_int_register_0": number}
    values |= {f"input_double_register_{i}": value for i, value in enumerate(doubles)}
    values |= {f"input_int_register_{i + 1}": value for i, value in enumerate(integers)}
    controller.write_inputs(values)


@pytest.fixture
def controller() -> Controller:
    """A controller on which the control program plays."""
    made = Controller()
    made.start_program(SCRIPT)
    run(made, 0.04)
    assert made.runtime_state is RuntimeState.PLAYING
    return made


def test_flange_of_the_stretched_arm() -> None:
    # All joints zero: the arm extends along -x, so the datasheet's lengths add up.
    T, _ = ur_model.forward(np.zeros(6), np.eye(4))
    np.testing.assert_allclose(T[:3, 3], [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], atol=1e-12)


@given(ANGLES, st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array))
def test_jacobian_is_the_derivative_of_the_pose(q: np.ndarray, qd: np.ndarray) -> None:
    tool = ur_model.from_pose_vector(np.array([0.01, -0.02, 0.1, 0.1, 0.2, -0.3]))
    h = 1e-6
    (ahead, _), (behind, _) = ur_model.forward(q + h * qd, tool), ur_model.forward(q - h * qd, tool)
    twist = ur_model.forward(q, tool)[1] @ qd
    np.testing.assert_allclose((ahead[:3, 3] - behind[:3, 3]) / (2 * h), twist[:3], atol=1e-7)
    spin = ur_model.rotation_vector(ahead[:3, :3] @ behind[:3, :3].T) / (2 * h)
    np.testing.assert_allclose(spin, twist[3:], atol=1e-7)


def test_inverse_reaches_the_pose_or_returns_none() -> None:
    controller = Controller()
    T = controller.arm.T_base_tcp.copy()
    T[:3, 3] += [0.05, -0.03, 0.04]
    q = ur_model.inverse(T, controller.arm.q, np.eye(4))
    assert q is not None
    np.testing.assert_allclose(ur_model.forward(q, np.eye(4))[0], T, atol=1e-8)
    T[:3, 3] = [3.0, 0.0, 0.0]
    assert ur_model.inverse(T, controller.arm.q, np.eye(4)) is None


@given(st.floats(1e-6, 10.0), st.floats(1e-3, 3.0), st.floats(1e-2, 40.0))
def test_trapezoid_arrives_within_its_limits(distance: float, speed: float, accel: float) -> None:
    profile = Trapezoid(distance, speed, accel)
    t_s = np.linspace(0.0, profile.duration_s, 400)
    s = np.array([profile.at(float(t)) for t in t_s])
    assert s[0] == 0.0
    assert s[-1] == distance
    speeds = np.diff(s) / np.diff(t_s)
    assert speeds.min() >= -1e-9 * speed
    assert speeds.max() <= speed * (1 + 1e-6)


def test_speedl_moves_the_tool_along_base_axes(controller: Controller) -> None:
    controller.set_tool(ur_model.from_pose_vector(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])))
    start = controller.arm.T_base_tcp.copy()
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0.2, 100.0, PERIOD_S])
    run(controller, 1.0)
    moved = controller.arm.T_base_tcp[:3, 3] - start[:3, 3]
    np.testing.assert_allclose(moved, [0.05, 0.0, 0.0], atol=3e-4)
    turned = ur_model.rotation_vector(controller.arm.T_base_tcp[:3, :3] @ start[:3, :3].T)
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.2], atol=1e-3)
    np.testing.assert_allclose(controller.arm.twist, [0.05, 0, 0, 0, 0, 0.2], atol=5e-5)


def test_the_speed_thread_continues_for_ever_whatever_its_time_argument(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 1.0, 0.1])
    run(controller, 1.0)
    command(controller, 0)
    run(controller, 1.0)
    assert controller.arm.twist[0] == pytest.approx(0.05, abs=1e-5)


def test_the_time_argument_is_the_delay_of_a_newer_target(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 10.0, 0.5])
    run(controller, 0.1)
    command(controller, ur_program.SPEEDL, [0.0] * 6 + [10.0, PERIOD_S])
    run(controller, 0.3)
    assert controller.arm.twist[0] == pytest.approx(0.05, abs=1e-5)
    run(controller, 0.3)
    assert not controller.arm.qd.any()


def test_without_time_a_newer_target_waits_until_the_old_one_is_reached(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.1, 0, 0, 0, 0, 0, 0.1, 0.0])
    run(controller, 0.1)
    command(controller, ur_program.SPEEDL, [0.0] * 6 + [10.0, 0.0])
    run(controller, 0.5)
    assert controller.arm.twist[0] > 0.05
    run(controller, 0.6)
    assert not controller.arm.qd.any()


def test_the_watchdog_stops_the_program_and_the_arm(controller: Controller) -> None:
    command(controller, ur_program.SET_WATCHDOG, [10.0])
    run(controller, 0.01)
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 100.0, PERIOD_S])
    run(controller, 0.098)
    assert controller.arm.twist[0] == pytest.approx(0.05, abs=1e-5)
    start_m = controller.arm.travel_m
    run(controller, 1.0)
    assert controller.watchdog_trips == 1
    assert controller.runtime_state is RuntimeState.STOPPED
    assert controller.arm.travel_m - start_m < 0.05 * 0.06
    assert not controller.arm.qd.any()


def test_registers_outlive_the_program_so_a_new_one_moves_at_once(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 1.0, PERIOD_S])
    run(controller, 0.2)
    controller.stop_program()
    run(controller, 0.5)
    assert not controller.arm.qd.any()
    controller.start_program(SCRIPT)
    run(controller, 0.5)
    assert controller.arm.twist[0] == pytest.approx(0.05, abs=1e-5)


def test_a_protective_stop_pauses_and_play_resumes_the_motion(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 1.0, PERIOD_S])
    run(controller, 0.2)
    controller.protective_stop()
    run(controller, 1.0)
    assert controller.runtime_state is RuntimeState.PAUSED
    assert not controller.arm.qd.any()
    assert not controller.unlock_protective_stop()
    run(controller, 4.5)
    assert controller.unlock_protective_stop()
    assert controller.play()
    run(controller, 0.5)
    assert controller.arm.twist[0] == pytest.approx(0.05, abs=1e-4)


def test_an_emergency_stop_ends_the_program_and_cuts_the_power(controller: Controller) -> None:
    controller.stop_by_safety(SafetyMode.ROBOT_EMERGENCY_STOP)
    run(controller, 1.0)
    assert controller.runtime_state is RuntimeState.STOPPED
    assert controller.robot_mode is RobotMode.POWER_OFF


def test_two_threads_may_not_drive_the_arm(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 1.0, PERIOD_S])
    run(controller, 0.1)
    command(controller, ur_program.MOVEJ, [*controller.arm.q + 0.1, 1.0, 1.0], 1)
    run(controller, 0.1)
    assert controller.runtime_state is RuntimeState.STOPPED
    assert "another thread" in controller.messages[-1]


def test_movej_arrives_and_reports_its_operation(controller: Controller) -> None:
    goal = controller.arm.q + 0.2
    command(controller, ur_program.MOVEJ, [*goal, 1.0, 2.0], 1)
    run(controller, 0.02)
    assert int(controller.outputs["output_int_register_2"]) & 0x8000  # type: ignore[arg-type]
    run(controller, 1.5)
    np.testing.assert_allclose(controller.arm.q, goal, atol=1e-12)
    assert not int(controller.outputs["output_int_register_2"]) & 0x8000  # type: ignore[arg-type]


def test_running_too_fast_is_a_protective_stop(controller: Controller) -> None:
    command(controller, ur_program.SPEEDJ, [5.0, 0, 0, 0, 0, 0, 40.0, PERIOD_S])
    run(controller, 0.5)
    assert controller.safety_mode is SafetyMode.PROTECTIVE_STOP


def test_the_slider_slows_the_tool(controller: Controller) -> None:
    controller.speed_slider = 0.5
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 100.0, PERIOD_S])
    run(controller, 0.5)
    assert float(np.linalg.norm(controller.arm.twist[:3])) == pytest.approx(0.025, abs=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        "def other():\n while True:\n  sync()\n end\nend\n",
        "def other():\n x = 1\nend\n",
        "movej([0, 0, 0, 0, 0, 0], b=1)",
        "set_digital_out(1",
        SCRIPT.replace(" rtde", "$5.0 rtde"),
    ],
)
def test_scripts_that_are_not_understood_are_refused_with_their_line(text: str) -> None:
    controller = Controller()
    controller.start_program(text)
    run(controller, 0.1)
    assert controller.runtime_state is RuntimeState.STOPPED
    assert controller.energising == 0
    assert "line" in controller.messages[-1]


def test_travel_counts_the_way_of_the_tool(controller: Controller) -> None:
    command(controller, ur_program.SPEEDL, [0.05, 0, 0, 0, 0, 0, 100.0, PERIOD_S])
    run(controller, 0.5)
    assert controller.arm.travel_m == pytest.approx(0.025, abs=2e-4)
    assert math.isfinite(controller.last_input_age_s)


def program_on(controller: Controller) -> ControlProgram:
    """Return a control program that runs on ``controller`` and has done its first step."""
    program = ControlProgram(controller, 0)
    assert program.step()
    return program


@pytest.mark.parametrize("command", [5, 13, 66, 67, 70, 99])
def test_a_command_that_is_not_emulated_ends_the_program_and_is_not_answered_done(command: int) -> None:
    controller = Controller()
    program = program_on(controller)
    controller.write_inputs({"input_int_register_0": command})
    with pytest.raises(ProgramError, match=str(command)):
        program.step()
    assert controller.outputs["output_int_register_0"] != DONE


@pytest.mark.parametrize(("q", "within"), [([0.0, -1.5, 1.0, 0.0, 1.0, 0.0], 1), ([10.0] * 6, 0)])
def test_safety_limits_of_joints_are_answered_truly(q: list[float], within: int) -> None:
    controller = Controller()
    program = program_on(controller)
    controller.write_inputs({f"input_double_register_{i}": value for i, value in enumerate(q)})
    controller.write_inputs({"input_int_register_0": JOINTS_IN_LIMITS})
    program.step()
    assert controller.outputs["output_int_register_1"] == within


@pytest.mark.parametrize(("x_m", "within"), [(0.4, 1), (3.0, 0)])
def test_safety_limits_of_poses_are_answered_truly(x_m: float, within: int) -> None:
    controller = Controller()
    program = program_on(controller)
    pose = [x_m, -0.13, 0.48, *ur_model.pose_vector(controller.arm.T_base_tcp)[3:]]
    controller.write_inputs({f"input_double_register_{i}": value for i, value in enumerate(pose)})
    controller.write_inputs({"input_int_register_0": POSE_IN_LIMITS})
    program.step()
    assert controller.outputs["output_int_register_1"] == within


def test_slider_and_outputs_are_set_as_masked() -> None:
    controller = Controller()
    controller.write_inputs({"speed_slider_mask": 1, "speed_slider_fraction": 0.5})
    controller.write_inputs({"standard_digital_output_mask": 0b11, "standard_digital_output": 0b01})
    controller.write_inputs({"standard_digital_output_mask": 0b10, "standard_digital_output": 0b11})
    values = controller.values()
    assert values["speed_scaling"] == 0.5
    assert values["actual_digital_output_bits"] == 0b11


@pytest.mark.parametrize("name", sorted(name for name in ur_model.MODELS if name.endswith("e")))
def test_every_model_is_the_one_of_its_shipped_chain(name: str) -> None:
    chain = SerialChain(ChainDescription.shipped(name))
    q = np.array([0.3, -1.2, 1.0, -0.4, 0.7, 0.2])
    T, J = ur_model.forward(q, np.eye(4), ur_model.MODELS[name])
    np.testing.assert_allclose(T, chain.forward(q), atol=1e-6)
    np.testing.assert_allclose(J, chain.jacobian(q), atol=1e-6)


def test_a_paused_program_stands_and_plays_on() -> None:
    controller = Controller()
    controller.play_foreign_program()
    assert controller.pause()
    assert controller.runtime_state is RuntimeState.PAUSED
    assert not controller.pause()
    assert controller.play()


def then(controller: Controller, number: int, doubles: list[float] = []) -> None:  # noqa: B006
    """Send a command after another one, which a client ends with 0."""
    command(controller, 0)
    run(controller, 0.01)
    command(controller, number, doubles)


def push(controller: Controller, *wrench: float) -> None:
    controller.wrench = np.array([*wrench, *[0.0] * (6 - len(wrench))])


def test_force_mode_moves_along_its_compliant_axis_until_something_pushes_back(controller: Controller) -> None:
    start = controller.arm.T_base_tcp[:3, 3].copy()
    task = [0.0] * 6
    command(controller, ur_program.FORCE_MODE, [*task, 0, 0, -10, 0, 0, 0, *[0.02] * 6], 2, 0, 0, 1, 0, 0, 0)
    run(controller, 1.0)
    moved = controller.arm.T_base_tcp[:3, 3] - start
    np.testing.assert_allclose(moved, [0.0, 0.0, -0.02], atol=1e-4)
    push(controller, 0.0, 0.0, 10.0)
    run(controller, 0.1)
    assert not controller.arm.qd.any()
    command(controller, ur_program.END_FORCE_MODE)
    push(controller)
    run(controller, 0.1)
    assert controller.compliance is None
    assert not controller.arm.qd.any()


def test_a_force_mode_that_is_not_emulated_is_refused_by_name(controller: Controller) -> None:
    command(controller, ur_program.FORCE_MODE, [0.0] * 18, 3, 0, 0, 1, 0, 0, 0)
    run(controller, 0.1)
    assert controller.runtime_state is RuntimeState.STOPPED
    assert "type 3" in controller.messages[-1]


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        (ur_program.FREEDRIVE, ur_program.END_FREEDRIVE),
        (ur_program.TEACH_MODE, ur_program.END_TEACH_MODE),
    ],
)
def test_a_hand_moves_the_arm_in_freedrive_and_not_after_it(controller: Controller, begin: int, end: int) -> None:
    start = controller.arm.T_base_tcp[:3, 3].copy()
    command(controller, begin, [0.0] * 6, 1, 1, 1, 1, 1, 1)
    run(controller, 0.1)
    assert not controller.arm.qd.any()
    push(controller, 10.0)
    run(controller, 0.5)
    assert controller.arm.T_base_tcp[0, 3] - start[0] == pytest.approx(0.025, abs=1e-4)
    then(controller, end)
    run(controller, 0.1)
    assert not controller.arm.qd.any()


def test_freedrive_keeps_the_axes_that_are_not_free(controller: Controller) -> None:
    start = controller.arm.T_base_tcp[:3, 3].copy()
    command(controller, ur_program.FREEDRIVE, [0.0] * 6, 1, 0, 0, 0, 0, 0)
    push(controller, 10.0, 10.0, 10.0)
    run(controller, 0.3)
    np.testing.assert_allclose((controller.arm.T_base_tcp[:3, 3] - start)[1:], 0.0, atol=1e-5)


@pytest.mark.parametrize("moving", [ur_program.SPEEDL, ur_program.MOVEL, ur_program.JOG])
def test_a_motion_in_freedrive_ends_the_program(controller: Controller, moving: int) -> None:
    command(controller, ur_program.FREEDRIVE, [0.0] * 6, 1, 1, 1, 1, 1, 1)
    run(controller, 0.01)
    then(controller, moving, [0.3, -0.1, 0.4, 0.0, 3.1, 0.0, 0.0, 0.5])
    run(controller, 0.1)
    assert controller.runtime_state is RuntimeState.STOPPED
    assert not controller.arm.qd.any()


def test_a_jog_in_the_tools_axes_moves_along_the_tool_until_it_is_stopped(controller: Controller) -> None:
    start = controller.arm.T_base_tcp.copy()
    command(controller, ur_program.JOG, [0, 0, 0.02, 0, 0, 0, 1, 100.0, *[0.0] * 6])
    run(controller, 1.0)
    moved = start[:3, :3].T @ (controller.arm.T_base_tcp[:3, 3] - start[:3, 3])
    np.testing.assert_allclose(moved, [0.0, 0.0, 0.02], atol=1e-4)
    then(controller, ur_program.END_JOG)
    run(controller, 0.5)
    assert not controller.arm.qd.any()


def test_a_move_until_contact_ends_where_the_contact_began(controller: Controller) -> None:
    start = controller.arm.T_base_tcp[:3, 3].copy()
    command(controller, ur_program.MOVE_UNTIL_CONTACT, [0, 0, -0.02, 0, 0, 0, *[0.0] * 6, 0.5])
    run(controller, 0.5)
    touched = controller.arm.T_base_tcp[2, 3]
    assert touched < start[2] - 0.005
    push(controller, 0.0, 0.0, 8.0)
    run(controller, 1.0)
    assert controller.outputs["output_int_register_0"] == DONE
    assert controller.arm.T_base_tcp[2, 3] == pytest.approx(touched, abs=2e-4)


def test_contact_from_behind_does_not_end_a_search(controller: Controller) -> None:
    command(controller, ur_program.MOVE_UNTIL_CONTACT, [0, 0, -0.02, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0.5])
    push(controller, 0.0, 0.0, -8.0)
    run(controller, 0.5)
    assert controller.arm.twist[2] == pytest.approx(-0.02, abs=1e-4)


def test_a_path_is_followed_and_its_progress_reported() -> None:
    controller = Controller()
    q = controller.arm.q
    moves = [f"\tmovej({(q + step).tolist()},a=1.4,v=1.0,r=0)" for step in (0.05, 0.1)]
    path = "\n".join(f"\tsignal_async_progress({i})\n{move}" for i, move in enumerate(moves))
    text = SCRIPT.replace("end\n", f"  def exec_move_path():\n # inject move path\n{path}\n  end\nend\n")
    controller.start_program(text)
    run(controller, 0.04)
    command(controller, ur_program.MOVE_PATH, [], 1)
    run(controller, 0.5)
    assert int(controller.outputs["output_int_register_2"]) & 0xFFFF == 0x8001  # type: ignore[arg-type]
    run(controller, 1.0)
    np.testing.assert_allclose(controller.arm.q, q + 0.1, atol=1e-9)
    assert not int(controller.outputs["output_int_register_2"]) & 0x8000  # type: ignore[arg-type]


def test_a_script_of_one_line_moves_the_arm() -> None:
    controller = Controller()
    goal = controller.arm.q + 0.1
    controller.start_program(f"movej({goal.tolist()}, a=2, v=1)")
    run(controller, 1.0)
    np.testing.assert_allclose(controller.arm.q, goal, atol=1e-9)
    assert controller.runtime_state is RuntimeState.STOPPED


@given(st.text(max_size=80))
def test_no_text_breaks_the_parser(text: str) -> None:
    with contextlib.suppress(ScriptError):
        assert isinstance(parse_program(text), tuple)


def test_a_cb3_controls_every_8_ms() -> None:
    controller = Controller(period_s=0.008)
    controller.start_program(SCRIPT)
    for _ in range(10):
        controller.step()
    command(controller, 26)
    controller.step()
    assert controller.t_s == pytest.approx(0.088)
    assert controller.outputs["output_double_register_0"] == 0.008
