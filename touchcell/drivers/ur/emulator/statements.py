"""Execution of straight-line URScript on the emulated controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.host import ProgramError, ProgramHost, Thread
from touchcell.drivers.ur.emulator.motion import Brake, Motion, MoveJ, MoveL, SpeedJ, SpeedL
from touchcell.drivers.ur.emulator.script import Argument, Pose, Statement
from touchcell.geometry.types import Array

_FIRST_OUTPUT = {"digital": 0, "standard_digital": 0, "configurable_digital": 8, "tool_digital": 16}


class ScriptProgram:
    """A running straight-line program, with the interface of ``ControlProgram``.

    Args:
        host: controller that runs it.
        statements: the program.
    """

    def __init__(self, host: ProgramHost, statements: Sequence[Statement]) -> None:
        self._thread = run(host, statements)

    def step(self) -> bool:
        """Run for one period; False once the program has ended. Raises ProgramError."""
        return next(self._thread, _ENDED) is not _ENDED


_ENDED = object()


def run(host: ProgramHost, statements: Sequence[Statement], progress: Callable[[int], None] | None = None) -> Thread:
    """Execute statements one after another; waypoints are not blended, the arm stops at each.

    Args:
        host: controller.
        statements: what to execute.
        progress: receives the argument of ``signal_async_progress``.

    Raises:
        ProgramError: an argument is impossible.
    """
    for statement in statements:
        yield from _execute(host, statement, progress)


def until_done(host: ProgramHost, motion: Motion) -> Thread:
    """Let the arm make a motion, and wait for its end."""
    refuse_beside_hand(host)
    host.motion = motion
    while not motion.done:
        yield


def refuse_beside_hand(host: ProgramHost) -> None:
    """Raise ProgramError in freedrive and teach mode, in which the arm cannot follow a trajectory."""
    if host.compliance is not None and not host.compliance.follows_moves:
        raise ProgramError(f"a motion while the arm is in {host.compliance.name}")


def move_to(host: ProgramHost, target: Argument | None, speed: float, accel: float, *, straight: bool) -> Motion:
    """Return the motion to a pose or to joint angles (6,). Raises ProgramError."""
    arm = host.arm
    if not (speed > 0.0 and accel > 0.0):
        raise ProgramError(f"speed {speed} and acceleration {accel} of a move must be positive")
    if host.compliance is not None and host.compliance.selection.any():
        raise ProgramError("a move in force mode is not emulated; speedl is")
    if isinstance(target, Pose):
        T = ur_model.from_pose_vector(target.vector)
        if straight:
            if ur_model.inverse(T, arm.q, arm.T_flange_tcp, arm.model) is None:
                raise ProgramError("the pose of a move cannot be reached")
            return MoveL(arm, T, speed, accel)
        q = ur_model.inverse(T, arm.q, arm.T_flange_tcp, arm.model)
        if q is None:
            raise ProgramError("get_inverse_kin: no solution")
        return MoveJ(arm, q, speed, accel)
    if not isinstance(target, np.ndarray) or target.shape != (6,) or not np.isfinite(target).all():
        raise ProgramError("the target of a move is neither a pose nor six joint angles")
    if straight:
        return MoveL(arm, ur_model.forward(target, arm.T_flange_tcp, arm.model)[0], speed, accel)
    return MoveJ(arm, target, speed, accel)


def _execute(host: ProgramHost, statement: Statement, progress: Callable[[int], None] | None) -> Thread:
    name, given = statement.name, statement.arguments
    if name in ("movej", "movel", "movep"):
        is_joint_move = name == "movej"
        speed = _number(statement, "v", 1.05 if is_joint_move else 0.25)
        accel = _number(statement, "a", 1.4 if is_joint_move else 1.2)
        target = given.get("q" if is_joint_move else "pose")
        yield from until_done(host, move_to(host, target, speed, accel, straight=not is_joint_move))
    elif name in ("stopj", "stopl"):
        yield from until_done(host, Brake(_number(statement, "a", 4.0), linear=name == "stopl"))
    elif name in ("speedl", "speedj"):
        yield from _speed(host, statement)
    elif name == "sleep":
        for _ in range(round(_number(statement, "t", 0.0) / host.period_s)):
            yield
    elif name == "sync":
        yield
    elif name == "signal_async_progress" and progress is not None:
        progress(int(_number(statement, "value", 0.0)))
    else:
        _set(host, statement)


def _speed(host: ProgramHost, statement: Statement) -> Thread:
    refuse_beside_hand(host)
    motion = SpeedL(host.arm) if statement.name == "speedl" else SpeedJ(host.arm)
    motion.aim(_six(statement, "xd" if statement.name == "speedl" else "qd"), _number(statement, "a", 1.0))
    host.motion = motion
    time_s, spent_s = _number(statement, "t", 0.0), 0.0
    while spent_s < time_s if time_s > 0.0 else not motion.reached:
        yield
        spent_s += host.period_s


def _set(host: ProgramHost, statement: Statement) -> None:
    name, given = statement.name, statement.arguments
    if name == "textmsg":
        host.log(" ".join(str(value) for value in given.values()))
    elif name == "set_tcp":
        host.set_tool(ur_model.from_pose_vector(_pose(statement, "pose")))
    elif name == "set_payload":
        centre = given.get("cog")
        host.set_payload(_number(statement, "m", 0.0), centre if isinstance(centre, np.ndarray) else None)
    elif name == "zero_ftsensor":
        host.zero_wrench()
    elif name == "protective_stop":
        host.protective_stop()
    elif name.endswith("_out"):
        first = _FIRST_OUTPUT[name.removeprefix("set_").removesuffix("_out")]
        bit = 1 << int(_number(statement, "n", 0.0)) + first
        host.set_outputs(bit, bit if _number(statement, "b", 0.0) else 0)
    elif name.startswith("write_output_"):
        address, value = int(_number(statement, "address", 0.0)), _number(statement, "value", 0.0)
        is_integer = name == "write_output_integer_register"
        host.outputs[f"output_{'int' if is_integer else 'double'}_register_{address}"] = (
            int(value) if is_integer else value
        )
    else:
        raise ProgramError(f"{name} has no meaning here")


def _number(statement: Statement, name: str, default: float) -> float:
    value = statement.arguments.get(name, default)
    if not isinstance(value, int | float):
        raise ProgramError(f"{name} of {statement.name} is not a number")
    return float(value)


def _six(statement: Statement, name: str) -> Array:
    value = statement.arguments.get(name)
    if not isinstance(value, np.ndarray) or value.shape != (6,):
        raise ProgramError(f"{name} of {statement.name} is not six numbers")
    return value


def _pose(statement: Statement, name: str) -> Array:
    value = statement.arguments.get(name)
    if not isinstance(value, Pose):
        raise ProgramError(f"{name} of {statement.name} is not a pose")
    return value.vector
