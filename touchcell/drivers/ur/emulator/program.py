"""The control program that ur-rtde uploads, emulated at the level of its register protocol.

The program's threads are generators, in which each ``yield`` is one ``sync()``. What matters for safety is kept: the
speed thread takes the newest target, passes it to ``speedl`` for ``time`` seconds, and repeats that for ever, so only
another command, a stop of the program or the watchdog ends a motion.

Commands arrive in ``input_int_register_0``. Streaming ones are executed in every cycle; the others once, until the
register returns to 0. ``output_int_register_0`` replies 1 (ready) or 2 (done). A command that is not emulated ends the
program with a message. Source: the program and the client of ur-rtde 1.6.5 (MIT); for the built-in functions, Universal
Robots, "The URScript Programming Language for e-Series".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.compliance import BY_HAND_LIMITS, Compliance
from touchcell.drivers.ur.emulator.host import ProgramError, ProgramHost, Thread
from touchcell.drivers.ur.emulator.motion import Brake, Motion, MoveL, ServoJ, SpeedJ, SpeedL
from touchcell.drivers.ur.emulator.program_registers import ProgramRegisters
from touchcell.drivers.ur.emulator.queries import Queries
from touchcell.drivers.ur.emulator.script import Pose, Statement
from touchcell.drivers.ur.emulator.statements import move_to, refuse_beside_hand, run, until_done
from touchcell.geometry.types import Array

READY, DONE = 1, 2

MOVEJ, MOVEJ_IK, MOVEL, MOVEL_FK = 1, 2, 3, 4
FORCE_MODE, END_FORCE_MODE = 6, 7
SPEEDJ, SPEEDL, SERVOJ, SERVOC, SERVOL = 9, 10, 11, 12, 24
SPEED_STOP, SERVO_STOP = 15, 16
TEACH_MODE, END_TEACH_MODE = 18, 19
PROTECTIVE_STOP = 31
STOPL, STOPJ = 33, 34
SET_WATCHDOG, POSE_IN_LIMITS, JOINTS_IN_LIMITS = 35, 36, 37
JOG, END_JOG, MOVE_PATH = 41, 42, 45
MOVE_UNTIL_CONTACT, FREEDRIVE, END_FREEDRIVE = 51, 52, 53
DETECT_CONTACT, END_CONTACT, READ_CONTACT = 62, 63, 64
STOP_SCRIPT = 255
STREAMED = frozenset({FORCE_MODE, SPEEDJ, SPEEDL, SERVOJ, SERVOL, 25, 26, 27, 38, 58, *range(66, 72)})
NAMES: Mapping[int, str] = MappingProxyType(
    {
        0: "none",
        MOVEJ: "moveJ",
        MOVEJ_IK: "moveJ_IK",
        MOVEL: "moveL",
        MOVEL_FK: "moveL_FK",
        FORCE_MODE: "forceMode",
        END_FORCE_MODE: "forceModeStop",
        8: "zeroFtSensor",
        SPEEDJ: "speedJ",
        SPEEDL: "speedL",
        SERVOJ: "servoJ",
        SERVOC: "servoC",
        SPEED_STOP: "speedStop",
        SERVO_STOP: "servoStop",
        17: "setPayload",
        TEACH_MODE: "teachMode",
        END_TEACH_MODE: "endTeachMode",
        20: "forceModeSetDamping",
        21: "forceModeSetGainScaling",
        SERVOL: "servoL",
        25: "toolContact",
        26: "getStepTime",
        27: "getActualJointPositionsHistory",
        28: "getTargetWaypoint",
        29: "setTcp",
        30: "getInverseKinematics",
        PROTECTIVE_STOP: "triggerProtectiveStop",
        STOPL: "stopL",
        STOPJ: "stopJ",
        SET_WATCHDOG: "setWatchdog",
        POSE_IN_LIMITS: "isPoseWithinSafetyLimits",
        JOINTS_IN_LIMITS: "isJointsWithinSafetyLimits",
        38: "getJointTorques",
        39: "poseTrans",
        40: "getTCPOffset",
        JOG: "jogStart",
        END_JOG: "jogStop",
        43: "getForwardKinematics",
        44: "getForwardKinematics",
        MOVE_PATH: "movePath",
        46: "getInverseKinematics",
        47: "isSteady",
        MOVE_UNTIL_CONTACT: "moveUntilContact",
        FREEDRIVE: "freedriveMode",
        END_FREEDRIVE: "endFreedriveMode",
        54: "getFreedriveStatus",
        56: "ftRtdeInputEnable",
        57: "enableExternalFtSensor",
        58: "getActualToolFlangePose",
        59: "setGravity",
        60: "getInverseKinematicsHasSolution",
        61: "getInverseKinematicsHasSolution",
        DETECT_CONTACT: "startContactDetection",
        END_CONTACT: "stopContactDetection",
        READ_CONTACT: "readContactDetection",
        65: "setTargetPayload",
        66: "directTorque",
        67: "getMassMatrix",
        68: "getCoriolisAndCentrifugalTorques",
        69: "getTargetJointAccelerations",
        70: "getJacobian",
        71: "getJacobianTimeDerivative",
        STOP_SCRIPT: "stopScript",
    }
)
"""Functions of ur-rtde's control interface, by the number of their command."""

_ALL_AXES = np.ones(6)
# Units are those of stopl and movel when a contact was found (ur-rtde's program, and the defaults of movel).
_CONTACT_DECEL_M_S2, _BACK_M_S, _BACK_M_S2 = 3.0, 0.25, 1.2


class ControlProgram:
    """One uploaded, running program.

    Args:
        controller: the controller that runs it.
        register_offset: 0, or 24 if the client requested the upper range of registers.
        path: moves that were written into the program, for ``movePath``.
    """

    def __init__(self, controller: ProgramHost, register_offset: int, path: Sequence[Statement] = ()) -> None:
        self._controller = controller
        self._registers = ProgramRegisters(controller.inputs, controller.outputs, register_offset)
        self._queries = Queries(controller, self._registers)
        self._path = path
        self._main: Thread = self._main_loop()
        self._speed: Thread | None = None
        self._servo: Thread | None = None
        self._move: Thread | None = None
        self._jog: Thread | None = None
        self._contact: Thread | None = None
        self._speed_target: tuple[int, Array, float, float] = (SPEEDL, np.zeros(6), 0.5, 0.0)
        self._servo_target: tuple[Array, float, float] = (np.zeros(6), controller.period_s, 0.1)
        self._servo_circle: tuple[Array, float, float] = (np.zeros(6), 0.25, 1.2)
        self._jog_target: tuple[Array, Array, float] = (np.zeros(6), np.eye(3), 0.5)
        self._contact_steps = 0
        self._contact_found = False
        self._operation = 0
        self._writes = 0

    def step(self) -> bool:
        """Run every thread for one period; False once the program has ended. Raises ProgramError."""
        for thread in self._moving():
            next(thread, None)
        if self._contact is not None:
            next(self._contact, None)
        if len(self._moving()) > 1:
            raise ProgramError("another thread is already controlling the robot")
        try:
            next(self._main)
        except StopIteration:
            return False
        return True

    def _moving(self) -> list[Thread]:
        return [thread for thread in (self._speed, self._servo, self._move, self._jog) if thread is not None]

    def _main_loop(self) -> Thread:
        registers = self._registers
        self._report_progress(None)
        registers.answer(READY)
        obeyed = False
        while True:
            command = registers.integer(0)
            if command in STREAMED:
                self._stream(command)
                registers.answer(READY)
            elif command == 0:
                obeyed = False
                if self._contact_found:
                    self._contact_found = False
                    yield from self._back_to_contact()
                registers.answer(READY)
            elif not obeyed:
                if command == STOP_SCRIPT:
                    return
                yield from self._execute(command)
                registers.answer(DONE)
                obeyed = True
            yield

    def _stream(self, command: int) -> None:
        registers = self._registers
        if command in (SPEEDL, SPEEDJ, SERVOJ, SERVOL):
            refuse_beside_hand(self._controller)
        if command in (SPEEDL, SPEEDJ):
            self._speed_target = (command, registers.vector(0), registers.double(6), registers.double(7))
            self._speed = self._speed or self._speed_thread()
        elif command in (SERVOJ, SERVOL):
            values = registers.vector(0)
            q = values if command == SERVOJ else self._queries.inverse(values)
            self._servo_target = (q, registers.double(8), registers.double(9))
            self._servo = self._servo or self._servo_thread()
        elif command == FORCE_MODE:
            self._give_way(self._force_mode())
        else:
            self._query(command)

    def _execute(self, command: int) -> Thread:
        if command in (MOVEJ, MOVEJ_IK, MOVEL, MOVEL_FK):
            yield from self._start_or_make(self._move_motion(command))
        elif command in (SPEED_STOP, SERVO_STOP):
            self._speed = self._servo = None
            yield from until_done(self._controller, Brake(self._registers.double(0), linear=True))
        elif command == SERVOC:
            refuse_beside_hand(self._controller)
            registers = self._registers
            self._servo_circle = (registers.vector(0), registers.double(6), registers.double(7))
            self._servo = self._servo or self._servo_circle_thread()
        elif command in (STOPL, STOPJ):
            self._report_progress(None)
            yield from self._start_or_make(Brake(self._registers.double(0), linear=command == STOPL))
        elif command == MOVE_PATH:
            yield from self._follow_path()
        elif command == JOG:
            self._start_jog()
        elif command == END_JOG:
            self._jog = None
            yield from until_done(self._controller, Brake(_BACK_M_S2, linear=True))
        elif command == END_FORCE_MODE:
            self._controller.give_way(None)
            yield from until_done(self._controller, Brake(10.0, linear=True))
        elif command == TEACH_MODE:
            self._give_way(Compliance("teach mode", np.eye(3), _ALL_AXES, np.zeros(6), BY_HAND_LIMITS, False))
        elif command == FREEDRIVE:
            self._give_way(self._freedrive())
        elif command in (END_TEACH_MODE, END_FREEDRIVE):
            self._controller.give_way(None)
        elif command == MOVE_UNTIL_CONTACT:
            yield from self._move_until_contact()
        elif command in (DETECT_CONTACT, END_CONTACT, READ_CONTACT):
            self._detect_contact(command)
        elif command == PROTECTIVE_STOP:
            self._controller.protective_stop()
        else:
            self._query(command)

    def _query(self, command: int) -> None:
        if command not in self._queries.commands:
            raise ProgramError(f"command {command} ({NAMES.get(command, 'unknown')}) is not emulated")
        self._queries.commands[command]()

    def _start_or_make(self, motion: Motion) -> Thread:
        """Let a thread make a motion if the client does not want to wait for its end, else make it."""
        self._move = None
        if self._registers.integer(1) == 1:
            self._move = self._reported(until_done(self._controller, motion))
        else:
            yield from until_done(self._controller, motion)

    def _move_motion(self, command: int) -> Motion:
        values, registers = self._registers.vector(0), self._registers
        target = Pose(values) if command in (MOVEJ_IK, MOVEL) else values
        motion = move_to(
            self._controller,
            target,
            registers.double(6),
            registers.double(7),
            straight=command in (MOVEL, MOVEL_FK),
        )
        is_pose = command in (MOVEJ_IK, MOVEL)
        self._queries.waypoint = values if is_pose else ur_model.pose_vector(self._queries.forward(values))
        return motion

    def _follow_path(self) -> Thread:
        if not self._path:
            raise ProgramError("no path was written into the program")
        moves = run(self._controller, self._path, self._report_progress)
        self._move = None
        if self._registers.integer(1) == 1:
            self._move = self._reported(moves)
        else:
            yield from moves

    def _reported(self, motion: Thread) -> Thread:
        self._report_progress(0)
        yield from motion
        self._report_progress(None)
        self._move = None

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
                spent_s += controller.period_s
                if spent_s >= time_s if time_s > 0.0 else motion.reached:
                    break

    def _servo_thread(self) -> Thread:
        period_s = self._controller.period_s
        while True:
            target, time_s, lookahead_s = self._servo_target
            self._controller.motion = ServoJ(target, max(lookahead_s, period_s))
            for _ in range(max(1, round(time_s / period_s))):
                yield

    def _servo_circle_thread(self) -> Thread:
        """Move to the newest pose; without a blend, so in straight lines."""
        while True:
            pose, speed, accel = self._servo_circle
            yield from until_done(self._controller, move_to(self._controller, Pose(pose), speed, accel, straight=True))
            while self._servo_circle[0] is pose:
                yield

    def _start_jog(self) -> None:
        registers = self._registers
        feature = int(registers.double(6))
        if feature not in (0, 1, 2):
            raise ProgramError(f"feature {feature} of a jog is neither base, tool nor custom")
        refuse_beside_hand(self._controller)
        frame = {
            0: np.eye(4),
            1: self._controller.arm.T_base_tcp,
            2: ur_model.from_pose_vector(registers.vector(8)),
        }[feature]
        # A jog that runs keeps the axes with which it began.
        R_base_frame = frame[:3, :3].copy() if self._jog is None else self._jog_target[1]
        self._jog_target = (registers.vector(0), R_base_frame, registers.double(7))
        self._jog = self._jog or self._jog_thread()

    def _jog_thread(self) -> Thread:
        motion = SpeedL(self._controller.arm)
        self._controller.motion = motion
        while True:
            speed, R_base_frame, accel = self._jog_target
            motion.aim(np.concatenate([R_base_frame @ speed[:3], R_base_frame @ speed[3:]]), accel)
            yield

    def _give_way(self, compliance: Compliance) -> None:
        if not compliance.follows_moves:
            if self._moving():
                raise ProgramError(f"{compliance.name} while the arm moves")
            self._controller.motion = None
        self._controller.give_way(compliance)

    def _force_mode(self) -> Compliance:
        registers = self._registers
        kind = registers.integer(1)
        if kind != 2:
            raise ProgramError(f"type {kind} of the force mode is not emulated, only 2: the frame as it is given")
        selection = np.array([registers.integer(2 + i) for i in range(6)], dtype=np.float64)
        R_base_frame = ur_model.from_pose_vector(registers.vector(0))[:3, :3]
        return Compliance(
            "force mode", R_base_frame, selection, registers.vector(6), np.abs(registers.vector(12)), True
        )

    def _freedrive(self) -> Compliance:
        registers = self._registers
        free = np.array([registers.integer(1 + i) for i in range(6)], dtype=np.float64)
        R_base_frame = ur_model.from_pose_vector(registers.vector(0))[:3, :3]
        return Compliance("freedrive", R_base_frame, free, np.zeros(6), BY_HAND_LIMITS, False)

    def _move_until_contact(self) -> Thread:
        controller, registers = self._controller, self._registers
        refuse_beside_hand(controller)
        direction = registers.vector(6)[:3]
        motion = SpeedL(controller.arm)
        controller.motion = motion
        motion.aim(registers.vector(0), registers.double(12))
        while (steps := controller.contact_steps(direction)) <= 0:
            yield
        yield from self._stop_and_return(steps)

    def _detect_contact(self, command: int) -> None:
        if command == DETECT_CONTACT:
            self._contact_steps = 0
            self._contact = self._contact_thread(self._registers.vector(0)[:3])
            return
        if command == END_CONTACT:
            self._contact = None
        self._registers.decide(self._contact_steps)

    def _contact_thread(self, direction: Array) -> Thread:
        while self._controller.contact_steps(direction) > 0:
            yield
        while (steps := self._controller.contact_steps(direction)) <= 0:
            yield
        self._contact_steps, self._contact_found = steps, True
        self._contact = None

    def _back_to_contact(self) -> Thread:
        self._move = None
        yield from self._stop_and_return(self._contact_steps)

    def _stop_and_return(self, steps: int) -> Thread:
        """Stop, and move to where the contact began ``steps`` periods ago."""
        controller = self._controller
        q = controller.joints_before(steps)
        yield from until_done(controller, Brake(_CONTACT_DECEL_M_S2, linear=True))
        yield from until_done(controller, MoveL(controller.arm, self._queries.forward(q), _BACK_M_S, _BACK_M_S2))

    def _report_progress(self, number: int | None) -> None:
        """Report that an asynchronous operation is at ``number`` of its moves, or that none runs."""
        if number == 0:
            self._operation = (self._operation + 1) % 128
        self._writes = (self._writes + 1) % 128
        word = self._operation << 24 | self._writes << 16
        self._registers.answer(word if number is None else word | 0x8000 | min(number, 0x7FFF), register=2)


def injected_path(script: str) -> Iterator[str]:
    """Yield the lines that a client has written into the program as its path."""
    _, _, rest = script.partition("# inject move path\n")
    for line in rest.splitlines():
        if line.strip() == "end":
            return
        yield line
