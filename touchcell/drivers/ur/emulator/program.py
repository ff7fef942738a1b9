"""The control program that ur-rtde uploads, emulated at the level of its register protocol.

No URScript is interpreted. The program's threads are generators, in which each ``yield`` is one ``sync()`` of 2 ms.
What matters for safety is kept: the speed thread takes the newest target, passes it to ``speedl`` for ``time`` seconds,
and repeats that for ever, so only another command, a stop of the program or the watchdog ends a motion.

Commands arrive in ``input_int_register_0``. Streaming ones are executed in every cycle; the others once, until the
register returns to 0. ``output_int_register_0`` replies 1 (ready) or 2 (done). Source: the program and the client of
ur-rtde 1.6.5 (MIT); for the built-in functions, Universal Robots, "The URScript Programming Language for e-Series".
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import Protocol

import numpy as np

from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.motion import ArmState, Brake, Motion, MoveJ, MoveL, ServoJ, SpeedJ, SpeedL
from touchcell.geometry.types import Array

PERIOD_S = 0.002
_JOINT_END_RAD = 2.0 * np.pi
READY, DONE = 1, 2

MOVEJ, MOVEJ_IK, MOVEL, MOVEL_FK = 1, 2, 3, 4
ZERO_FT_SENSOR = 8
SPEEDJ, SPEEDL, SERVOJ, SERVOL = 9, 10, 11, 24
SPEED_STOP, SERVO_STOP = 15, 16
SET_PAYLOAD, SET_TCP, PROTECTIVE_STOP = 17, 29, 31
STOPL, STOPJ = 33, 34
SET_WATCHDOG, POSE_IN_LIMITS, JOINTS_IN_LIMITS = 35, 36, 37
GET_TCP_OFFSET, FORWARD_KINEMATICS, INVERSE_KINEMATICS = 40, 43, 46
IS_STEADY, STOP_SCRIPT = 47, 255
STREAMED = frozenset({6, SPEEDJ, SPEEDL, SERVOJ, SERVOL, 25, 26, 27, 38, 58, *range(66, 72)})
NAMES = {
    MOVEJ: "moveJ",
    MOVEJ_IK: "moveJ_IK",
    MOVEL: "moveL",
    MOVEL_FK: "moveL_FK",
    ZERO_FT_SENSOR: "zeroFtSensor",
    0: "none",
    SPEEDJ: "speedJ",
    SPEEDL: "speedL",
    SERVOJ: "servoJ",
    SERVOL: "servoL",
    SPEED_STOP: "speedStop",
    SERVO_STOP: "servoStop",
    SET_PAYLOAD: "setPayload",
    SET_TCP: "setTcp",
    PROTECTIVE_STOP: "triggerProtectiveStop",
    STOPL: "stopL",
    STOPJ: "stopJ",
    SET_WATCHDOG: "setWatchdog",
    GET_TCP_OFFSET: "getTCPOffset",
    STOP_SCRIPT: "stopScript",
}

Thread = Generator[None, None, None]


class ProgramHost(Protocol):
    """Interface of the controller that runs a program."""

    arm: ArmState
    motion: Motion | None
    inputs: dict[str, Value]
    outputs: dict[str, Value]
    energising: int

    def set_tool(self, T_flange_tcp: Array) -> None:
        """Set the tool centre point."""
        ...

    def set_watchdog(self, min_hz: float) -> None:
        """Require a minimum rate of input packets."""
        ...

    def protective_stop(self) -> None:
        """Stop the arm and latch the protective stop."""
        ...

    def log(self, message: str) -> None:
        """Write to the controller's log."""
        ...


class ProgramError(Exception):
    """A run-time error of the program: the controller stops it."""


class ControlProgram:
    """One uploaded, running program.

    Args:
        controller: the controller that runs it.
        register_offset: 0, or 24 if the client requested the upper range of registers.
    """

    def __init__(self, controller: ProgramHost, register_offset: int) -> None:
        self._controller = controller
        self._offset = register_offset
        self._main: Thread = self._main_loop()
        self._speed: Thread | None = None
        self._servo: Thread | None = None
        self._move: Thread | None = None
        self._speed_target: tuple[int, Array, float, float] = (SPEEDL, np.zeros(6), 0.5, 0.0)
        self._servo_target: tuple[Array, float, float] = (np.zeros(6), PERIOD_S, 0.1)
        self._operation = 0
        self._writes = 0

    def step(self) -> bool:
        """Run every thread for one period; False once the program has ended. Raises ProgramError."""
        for thread in self._threads():
            next(thread, None)
        if sum(thread is not None for thread in (self._speed, self._servo, self._move)) > 1:
            raise ProgramError("another thread is already controlling the robot")
        try:
            next(self._main)
        except StopIteration:
            return False
        return True

    def _threads(self) -> Iterator[Thread]:
        return iter([thread for thread in (self._speed, self._servo, self._move) if thread is not None])

    def _main_loop(self) -> Thread:
        self._report_operation(running=False)
        self._answer(READY)
        obeyed = False
        while True:
            command = self._integer(0)
            if command in STREAMED:
                self._stream(command)
                self._answer(READY)
            elif command == 0:
                obeyed = False
                self._answer(READY)
            elif not obeyed:
                if command == STOP_SCRIPT:
                    return
                yield from self._execute(command)
                self._answer(DONE)
                obeyed = True
            yield

    def _stream(self, command: int) -> None:
        values = self._vector(0)
        if command in (SPEEDL, SPEEDJ):
            self._speed_target = (command, values, self._double(6), self._double(7))
            self._speed = self._speed or self._speed_thread()
        elif command in (SERVOJ, SERVOL):
            q = values if command == SERVOJ else self._inverse(values)
            self._servo_target = (q, self._double(8), self._double(9))
            self._servo = self._servo or self._servo_thread()
        else:
            raise ProgramError(f"command {command} is not emulated")

    def _execute(self, command: int) -> Thread:
        controller = self._controller
        if command in (MOVEJ, MOVEJ_IK, MOVEL, MOVEL_FK):
            self._move = None
            motion = self._move_motion(command)
            if self._integer(1) == 1:
                self._move = self._move_thread(motion)
            else:
                yield from self._until_done(motion)
        elif command in (SPEED_STOP, SERVO_STOP):
            self._speed = self._servo = None
            yield from self._until_done(Brake(self._double(0), linear=True))
        elif command in (STOPL, STOPJ):
            self._move = None
            self._report_operation(running=False)
            brake = Brake(self._double(0), linear=command == STOPL)
            if self._integer(1) == 1:
                self._move = self._move_thread(brake)
            else:
                yield from self._until_done(brake)
        elif command == SET_TCP:
            controller.set_tool(ur_model.from_pose_vector(self._vector(0)))
        elif command == GET_TCP_OFFSET:
            self._reply(ur_model.pose_vector(controller.arm.T_flange_tcp))
        elif command == SET_WATCHDOG:
            controller.set_watchdog(self._double(0))
        elif command == PROTECTIVE_STOP:
            controller.protective_stop()
        elif command == FORWARD_KINEMATICS:
            self._reply(ur_model.pose_vector(controller.arm.T_base_tcp))
        elif command == INVERSE_KINEMATICS:
            self._reply(self._inverse(self._vector(0)))
        elif command in (POSE_IN_LIMITS, JOINTS_IN_LIMITS):
            values = self._vector(0)
            q = values if command == JOINTS_IN_LIMITS else self._solution(values)
            self._decide(q is not None and bool((np.abs(q) <= _JOINT_END_RAD).all()))
        elif command == IS_STEADY:
            self._decide(not controller.arm.qd.any())
        elif command in (ZERO_FT_SENSOR, SET_PAYLOAD):
            controller.energising += 1
        else:
            raise ProgramError(f"command {command} is not emulated")

    def _speed_thread(self) -> Thread:
        controller = self._controller
        motion: SpeedL | SpeedJ | None = None
        while True:
            kind, target, accel, time_s = self._speed_target
            wanted = SpeedL if kind == SPEEDL else SpeedJ
            if motion is None or not isinstance(motion, wanted) or controller.motion is not motion:
                motion = wanted(controller.arm)
                controller.motion = motion
            motion.aim(target, accel)
            # speedl(xd, a, t) returns after t whether or not xd is reached; without t, once it is.
            spent_s = 0.0
            while True:
                yield
                spent_s += PERIOD_S
                if spent_s >= time_s if time_s > 0.0 else motion.reached:
                    break

    def _servo_thread(self) -> Thread:
        while True:
            target, time_s, lookahead_s = self._servo_target
            self._controller.motion = ServoJ(target, max(lookahead_s, PERIOD_S))
            for _ in range(max(1, round(time_s / PERIOD_S))):
                yield

    def _move_thread(self, motion: Motion) -> Thread:
        self._operation = (self._operation + 1) % 128
        self._report_operation(running=True)
        yield from self._until_done(motion)
        self._report_operation(running=False)
        self._move = None

    def _until_done(self, motion: Motion) -> Thread:
        self._controller.motion = motion
        while not motion.done:
            yield

    def _move_motion(self, command: int) -> Motion:
        values, speed, accel = self._vector(0), self._double(6), self._double(7)
        arm = self._controller.arm
        if speed <= 0.0 or accel <= 0.0:
            raise ProgramError(f"speed {speed} and acceleration {accel} of a move must be positive")
        if command in (MOVEJ, MOVEJ_IK):
            return MoveJ(arm, values if command == MOVEJ else self._inverse(values), speed, accel)
        T = ur_model.from_pose_vector(values) if command == MOVEL else self._forward(values)
        return MoveL(arm, T, speed, accel)

    def _decide(self, answer: bool) -> None:
        self._controller.outputs[f"output_int_register_{1 + self._offset}"] = int(answer)

    def _solution(self, pose: Array) -> Array | None:
        arm = self._controller.arm
        return ur_model.inverse(ur_model.from_pose_vector(pose), arm.q, arm.T_flange_tcp, arm.model)

    def _inverse(self, pose: Array) -> Array:
        q = self._solution(pose)
        if q is None:
            raise ProgramError("get_inverse_kin: no solution")
        return q

    def _forward(self, q: Array) -> Array:
        arm = self._controller.arm
        return ur_model.forward(q, arm.T_flange_tcp, arm.model)[0]

    def _report_operation(self, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        word = self._operation << 24 | self._writes << 16 | (0x8000 if running else 0)
        self._controller.outputs[f"output_int_register_{2 + self._offset}"] = word

    def _answer(self, word: int) -> None:
        self._controller.outputs[f"output_int_register_{self._offset}"] = word

    def _reply(self, values: Array) -> None:
        for i, value in enumerate(values):
            self._controller.outputs[f"output_double_register_{i + self._offset}"] = float(value)

    def _integer(self, number: int) -> int:
        return int(self._scalar(f"input_int_register_{number + self._offset}"))

    def _double(self, number: int) -> float:
        return float(self._scalar(f"input_double_register_{number + self._offset}"))

    def _scalar(self, register: str) -> float:
        value = self._controller.inputs.get(register, 0)
        assert not isinstance(value, tuple), "registers hold one number each"
        return value

    def _vector(self, first: int) -> Array:
        return np.array([self._double(first + i) for i in range(6)])
