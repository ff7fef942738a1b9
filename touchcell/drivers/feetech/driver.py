"""Driver for arms of Feetech STS3215 bus servos (SO-100, SO-101 and home-made ones) on a serial port, with pyserial.

The servos accept goal positions only, so motion control runs on the host: a loop converts expiring twists into joint
setpoints (``touchcell.drivers.core.joint_setpoint``), sends the servos one small step per cycle, each with the speed
that it needs, and reads them.

Stop mechanisms: when a twist expires, the loop decelerates; when the host process dies, no next step follows. The bus
has **no watchdog**: each servo continues to its last goal, which is at most ``tracking_error_deg`` and three steps from
its last measured position, and holds there until it is switched off. Without power the arm sinks.

Five joints cannot follow every twist. The tip's velocity has priority over rotation; the lost part is reported in the
adjustments of ``Sent`` and in ``health``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.drivers.core.bench_address import is_pseudo_terminal
from touchcell.drivers.core.bus_arm import BusArm, BusArmConfig
from touchcell.drivers.core.bus_reply import Reply
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import OperatorToken
from touchcell.drivers.core.diagnosis import Finding, finding_of
from touchcell.drivers.core.errors import (
    ConnectError,
    CorruptMessage,
    DeviceError,
    DeviceFault,
    FaultClass,
    Remedy,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import SERVO_ARM, HealthSource, JointGoal, JointSource, StopCategory
from touchcell.drivers.core.samples import JointState, Quality, Stamped
from touchcell.drivers.core.spec import Capabilities, DriverContext, DriverSpec
from touchcell.drivers.feetech import codec
from touchcell.drivers.feetech.bus import ServoBus
from touchcell.drivers.feetech.codec import FaultBit, Register, ServoState
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.chain import ChainDescription, ChainFile, SerialChain
from touchcell.drivers.kinematics.twist_projection import project_to_feasible
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

Ticks = Annotated[int, Field(ge=0, lt=codec.TICKS_PER_TURN)]

_MAX_BUS_LOAD = 0.8
_MAX_UNANSWERED = 3
_UNSEEN_CYCLES = 2
_TRIES = 3
_ANSWER_TIMEOUT_S = 0.15
_PLAUSIBLE_JUMP_RAD = 0.1
_SPEED_MARGIN = 1.25
_SLOWEST_RAD_S = 0.1
_SHORTEST_RANGE_RAD = np.deg2rad(10.0)
_MOVED_BY_HAND_TICKS = 20
_WARM_C = 60
_OLDEST_FIRMWARE = (3, 10)
_LONG_DELAY_S = 1e-3
_SETTING_REPORTS = ("lerobot 1360", "lerobot 1010", "lerobot 526")


class ServoConfig(BaseModel):
    """Calibration of one joint's servo: joint angle = ``direction`` times (ticks - ``zero_ticks``).

    ``min_ticks`` and ``max_ticks`` limit the joint's range, within one turn: a servo turns the long way round between
    4095 and 0. ``homing_offset_ticks`` is the value stored in the servo when it was calibrated.

    Attributes:
        id: of the servo on the line.
        zero_ticks: reading at joint angle zero.
        direction: sign of joint angle against ticks.
        min_ticks: lowest reading of the joint's range.
        max_ticks: highest reading of the joint's range.
        homing_offset_ticks: value stored in the servo when it was calibrated.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    id: int = Field(ge=0, le=253)
    zero_ticks: int = Field(default=2048, gt=-codec.TICKS_PER_TURN, lt=2 * codec.TICKS_PER_TURN)
    direction: Literal[1, -1] = 1
    min_ticks: Ticks = 0
    max_ticks: Ticks = 4095
    homing_offset_ticks: int = Field(default=0, ge=-2047, le=2047)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.min_ticks >= self.max_ticks:
            raise ValueError(
                f"servo {self.id}: min_ticks {self.min_ticks} is not below max_ticks {self.max_ticks}; "
                "if the joint passes 4095 within its range, change its homing offset"
            )
        return self

    def angle(self, ticks: float) -> float:
        """Return the joint angle in rad."""
        return self.direction * (ticks - self.zero_ticks) * codec.RAD_PER_TICK

    def ticks(self, angle: float) -> int:
        """Return the nearest goal within the calibrated range."""
        wanted = self.zero_ticks + round(self.direction * angle / codec.RAD_PER_TICK)
        return min(max(wanted, self.min_ticks), self.max_ticks)


class FeetechSerialConfig(BusArmConfig):
    """Configuration of a Feetech arm. ``servos`` are in the order of the joints; the chain's joint ranges are narrowed
    to the calibrated ones.

    Attributes:
        port: serial port; a name under /dev/serial/by-id stays with the adapter.
        baudrate: bit/s of the line.
        echo: whether the adapter echoes what is sent.
        servos: one for each joint, from the base.
        torque_limit_percent: largest torque, of the servo's own maximum.
    """

    port: str
    baudrate: int = Field(default=1_000_000, gt=0)
    echo: bool = False

    chain: ChainFile = "so101_5r"
    servos: tuple[ServoConfig, ...] = Field(min_length=1)

    rate_hz: Annotated[float, Field(ge=10.0, le=200.0)] = 50.0
    tracking_error_deg: Annotated[float, Field(gt=0.0, le=20.0)] = 8.0
    torque_limit_percent: Annotated[float, Field(ge=5.0, le=100.0)] = 60.0

    def emulated_address(self) -> str | None:
        """Return ``port`` if it is a pseudo-terminal of this machine."""
        return "port" if is_pseudo_terminal(self.port) else None

    @property
    def joint_count(self) -> int:
        """Number of configured servos."""
        return len(self.servos)

    @model_validator(mode="after")
    def _check(self) -> Self:
        ids = [servo.id for servo in self.servos]
        if len(set(ids)) < len(ids):
            raise ValueError(f"two servos share one id: {ids}")
        if self.max_silence_s * self.rate_hz > len(codec.STATE_STARTS):
            raise ValueError(
                f"max_silence_s {self.max_silence_s:g} is more than {len(codec.STATE_STARTS)} cycles of "
                f"{self.rate_hz:g} Hz, within which a late reply can be distinguished from a fresh one"
            )
        if self.max_silence_s * self.rate_hz < _MAX_UNANSWERED:
            raise ValueError(f"max_silence_s {self.max_silence_s:g} is less than three cycles of {self.rate_hz:g} Hz")
        return self

    @property
    def calibration_hash(self) -> str:
        """Return twelve hexadecimal digits that change with any number of the calibration."""
        calibration = "\n".join(servo.model_dump_json() for servo in self.servos)
        return hashlib.sha256(calibration.encode()).hexdigest()[:12]

    def describe(self) -> ChainDescription:
        """Return the chain description, with joint ranges narrowed to the calibrated ones.

        Raises:
            ConfigError: unknown chain, wrong number of joints, a joint without remaining range, or a park pose outside
                the ranges.
        """
        found = self.named_chain("servos")
        joints = []
        for index, (joint, servo) in enumerate(zip(found.joints, self.servos, strict=True)):
            ends = np.rad2deg(sorted((servo.angle(servo.min_ticks), servo.angle(servo.max_ticks))))
            lower, upper = max(joint.lower_deg, float(ends[0])), min(joint.upper_deg, float(ends[1]))
            if upper - lower < np.rad2deg(_SHORTEST_RANGE_RAD):
                raise ConfigError(
                    f"joint {joint.name} has a range of {joint.lower_deg:g} to {joint.upper_deg:g} deg, "
                    f"its calibration {ends[0]:.0f} to {ends[1]:.0f} deg: they hardly overlap",
                    key=f"servos[{index}]",
                    hint="correct zero_ticks, direction, min_ticks and max_ticks",
                )
            joints.append(joint.model_copy(update={"lower_deg": lower, "upper_deg": upper}))
        narrowed = found.model_copy(update={"joints": tuple(joints)})
        self.require_park_within(narrowed)
        return narrowed


class FeetechSerialArm(BusArm):
    """Driver for a Feetech arm; see the module for its stop mechanisms.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: real time; the loop is a thread and cannot run on a virtual clock.
    """

    _config: FeetechSerialConfig

    def __init__(
        self, name: str, config: FeetechSerialConfig, clock: Clock, open_port: Callable[[], Any] | None = None
    ) -> None:
        super().__init__(name, config, clock, SerialChain(config.describe(), config.tool))
        self._ids = [servo.id for servo in config.servos]
        self._bus = ServoBus(name, self._ids, open_port or partial(_open_port, name, config), clock, echo=config.echo)

    def _reset_state(self) -> None:
        super()._reset_state()
        self._answers: list[Reply[ServoState] | None] = [None] * len(self._config.servos)
        # A servo holds its goal by itself: goals are sent only between activation and rest.
        self._driving = False
        self._unanswered = [0] * len(self._config.servos)
        self._lost: tuple[Adjustment, ...] = ()

    def health(self) -> dict[str, float | int | str | bool]:
        """Return counters of the bus and the loop, the calibration's hash, and the state of each servo."""
        readings: dict[str, float | int | str | bool] = dict(self._bus.counters.as_dict())
        readings |= super().health()
        readings |= {
            "firmware": self._bus.firmware,
            "calibration": self._config.calibration_hash,
            "not_followed": ", ".join(f"{a.limit} {a.allowed:.3g} for {a.requested:.3g}" for a in self._lost),
        }
        for joint, answer in zip(self._chain.joint_names, self._answers, strict=True):
            if answer is not None:
                state = answer.state
                readings[f"{joint}_ticks"] = state.position
                readings[f"{joint}_status"] = state.status
                readings[f"{joint}_load"] = state.load
                readings[f"{joint}_v"] = state.voltage_v
                readings[f"{joint}_c"] = state.temperature_c
                readings[f"{joint}_a"] = state.current_a
        return readings

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong with servos and adapter; reads registers only."""
        with self._lock:
            for index in range(len(self._ids)):
                try:
                    self._check_servo(index)
                except ConfigError as error:
                    yield finding_of(error, *_SETTING_REPORTS)
            answers = self._fresh_answers()
        for index, (servo, answer) in enumerate(answers):
            yield from self._diagnose_state(index, servo, answer.state)
        firmware = self._bus.firmware
        if any(_version(each) < _OLDEST_FIRMWARE for each in firmware.split(", ")):
            what = f"firmware {firmware}: older than 3.10, with which others have had damaged replies"
            yield Finding(what, "update it with the maker's tool", ("lerobot 1010",), is_fault=False)
        delay_s = sum(self._bus.identity(servo).return_delay_s for servo in self._ids)
        if delay_s > _LONG_DELAY_S:
            what = f"the servos' return delays take {1e3 * delay_s:.1f} ms of each cycle"
            yield Finding(what, "set register 7 of each servo to 0", ("DynamixelSDK 302",), is_fault=False)
        latency_ms = _latency_timer_ms(self._config.port)
        if latency_ms is not None and latency_ms > 1:
            what = f"the adapter keeps what it has heard for {latency_ms} ms (its latency timer)"
            remedy = f"echo 1 | sudo tee /sys/class/tty/{Path(self._config.port).resolve().name}/device/latency_timer"
            yield Finding(what, remedy, ("DynamixelSDK 116",), is_fault=False)

    def _diagnose_state(self, index: int, servo: int, state: ServoState) -> Iterator[Finding]:
        for bit in codec.faults(state.status):
            yield Finding(f"servo {servo}: {bit.name}", bit.hint, ("SO-ARM100 174", "lerobot 2819"))
        if not 0 <= state.position < codec.TICKS_PER_TURN:
            what = f"servo {servo} is at {state.position} ticks, outside 0 to 4095 by its homing offset"
            yield Finding(what, "move the joint to the middle of its range by hand", ("lerobot 3348", "lerobot 1296"))
        elif not self._chain.lower[index] <= (angle := self._angle(index, state.position)) <= self._chain.upper[index]:
            what = f"joint {self._chain.joint_names[index]} is at {np.rad2deg(angle):.1f} deg, outside its limits"
            yield Finding(what, "move it back by hand, or calibrate it again", ("lerobot 1360",))
        if state.temperature_c >= _WARM_C:
            what = f"servo {servo} is at {state.temperature_c} degrees Celsius"
            yield Finding(what, "let it cool down", ("interbotix_ros_manipulators 10",), is_fault=False)

    def _open_bus(self) -> None:
        self._bus.open()
        self._enabled = [answer.state.torque_enable == codec.TORQUE_ON for _, answer in self._fresh_answers()]

    def _close_bus(self) -> None:
        self._bus.close()

    def _reopen_bus(self) -> None:
        self._bus.close()
        self._driving = False
        self._open_bus()

    def _configure(self) -> None:
        with self._lock:
            delay_s = sum(self._bus.identity(servo).return_delay_s for servo in self._ids)
            busy_s = codec.cycle_time_s(len(self._ids), self._config.baudrate, delay_s)
            if busy_s * self._config.rate_hz > _MAX_BUS_LOAD:
                raise ConfigError(
                    f"a cycle takes {busy_s * 1e3:.1f} ms on the wire, too much for {self._config.rate_hz:g} Hz",
                    key="rate_hz",
                    value=self._config.rate_hz,
                    hint="set the servos' return delay (register 7) to 0, or lower rate_hz",
                )
            for index in range(len(self._ids)):
                self._check_servo(index)
            for servo in self._ids:
                self._bus.write(servo, Register.TORQUE_LIMIT, codec.word(self._torque_limit))

    def _activate(self) -> None:
        with self._lock:
            if self._latched_fault is not None:
                raise self._latched_fault
            states = [answer.state for _, answer in self._fresh_answers()]
            for index, state in enumerate(states):
                self._check_state(index, state)
            # An enabled servo keeps its goal: at the measured position the arm's weight would move it.
            goals = [state.goal if on else state.position for on, state in zip(self._enabled, states, strict=True)]
            if not all(self._enabled):
                self._enable(goals)
            self._setpoint.reset(np.array([s.angle(goal) for s, goal in zip(self._config.servos, goals, strict=True)]))
            self._driving = True

    def _hold(self) -> None:
        with self._lock:
            self._driving = False

    def _switch_off(self) -> None:
        with self._lock:
            self._driving = False
            self._power_off(range(len(self._ids)))

    def _recover(self, token: OperatorToken) -> None:
        self._require_loop()
        with self._lock:
            for servo, answer in self._fresh_answers():
                found = codec.faults(answer.state.status)
                if found and all(bit.needs is Remedy.RECOVER for bit in found):
                    self._power_off([self._ids.index(servo)])
            answers = self._fresh_answers()
            for servo, answer in answers:
                if found := codec.faults(answer.state.status):
                    raise _servo_fault(self.name, servo, answer.state.status, found[0])
            self._enabled = [answer.state.torque_enable == codec.TORQUE_ON for _, answer in answers]
            self._driving = False
            self._configure()
            self._missed.clear()
            self._latched_fault = None

    def _project_to_feasible(self, twist_base: Array) -> tuple[Array, tuple[Adjustment, ...]]:
        twist, self._lost = project_to_feasible(self._chain.jacobian(self._setpoint.q), twist_base)
        return twist, self._lost

    @property
    def _torque_limit(self) -> int:
        """Return the torque limit in the servos' unit. They lose it on power loss."""
        return round(self._config.torque_limit_percent * 10.0)

    def _speed(self, index: int, dq: float) -> int:
        """Return the speed limit of a servo in its own unit: no faster than the motion requires, so that steps are
        smooth and a wrong one has little energy."""
        unit = self._bus.identity(self._ids[index]).speed_unit_ticks_s * codec.RAD_PER_TICK
        return int(np.ceil(max(_SPEED_MARGIN * abs(dq), _SLOWEST_RAD_S) / unit))

    def _check_servo(self, index: int) -> None:
        servo, identity = self._config.servos[index], self._bus.identity(self._ids[index])
        for key, found, wanted, hint in (
            ("model", identity.model, codec.STS3215, "this driver supports STS3215 servos only"),
            ("id", identity.servo, servo.id, "two servos on one line may share an id"),
            ("mode", identity.mode, codec.POSITION_MODE, "set register 33 to 0; a driver does not change modes"),
            ("multi_turn", identity.multi_turn, False, "clear bit 4 of register 18: counted turns are lost with power"),
            ("acknowledges", identity.acknowledges, True, "set register 8 to 1"),
            (
                "homing_offset_ticks",
                identity.homing_offset_ticks,
                servo.homing_offset_ticks,
                "the servo was calibrated again or replaced: calibrate the arm again",
            ),
        ):
            if found != wanted:
                raise ConfigError(
                    f"servo {servo.id} has {key} {found}, not {wanted}", key=f"servos[{index}].{key}", hint=hint
                )
        ends = [servo.ticks(float(end[index])) for end in (self._chain.lower, self._chain.upper)]
        if min(ends) < identity.min_ticks or max(ends) > identity.max_ticks:
            raise ConfigError(
                f"servo {servo.id} limits itself to {identity.min_ticks} and {identity.max_ticks} ticks, "
                f"its joint range is {min(ends)} to {max(ends)}",
                key=f"servos[{index}]",
                hint="narrow min_ticks and max_ticks to registers 9 and 11",
            )

    def _check_state(self, index: int, state: ServoState) -> None:
        """Refuse to enable a servo that is faulty, has lost its settings, or is outside its range."""
        servo = self._ids[index]
        if found := codec.faults(state.status):
            raise _servo_fault(self.name, servo, state.status, found[0])
        if state.torque_limit != self._torque_limit:
            raise _lost_power(self.name, servo)
        if not 0 <= state.position < codec.TICKS_PER_TURN:
            raise DeviceFault(
                self.name,
                f"servo {servo} is at {state.position} ticks, outside 0 to 4095 by its homing offset",
                vendor_code="position",
                fault_class=FaultClass.MOTION,
                needs=Remedy.OPERATOR,
                hint="move the joint to the middle of its range by hand; if that does not help, calibrate again",
            )
        angle = self._angle(index, state.position)
        if not self._chain.lower[index] <= angle <= self._chain.upper[index]:
            raise DeviceFault(
                self.name,
                f"joint {self._chain.joint_names[index]} is at {np.rad2deg(angle):.1f} deg, outside its limits",
                fault_class=FaultClass.MOTION,
                needs=Remedy.OPERATOR,
                hint="move it back by hand, or calibrate it again",
            )

    def _angle(self, index: int, position: int) -> float:
        """Return the joint angle; the count continues beyond 4095 and 0 where that is nearer to the joint's range."""
        servo = self._config.servos[index]
        if not 0 <= position < codec.TICKS_PER_TURN:
            # The servo continues the count itself.
            return servo.angle(position)
        return servo.angle(codec.unwrap(position, (servo.min_ticks + servo.max_ticks) / 2))

    def _enable(self, goals: list[int]) -> None:
        """Send every servo its goal, verify goal and position, then enable torque; undone if anything fails."""
        self._bus.write_goals({s: (goals[i], self._speed(i, 0.0)) for i, s in enumerate(self._ids)})
        for (servo, answer), goal in zip(self._fresh_answers(), goals, strict=True):
            on = self._enabled[self._ids.index(servo)]
            if answer.state.goal != goal or (not on and abs(answer.state.position - goal) > _MOVED_BY_HAND_TICKS):
                raise CorruptMessage(
                    self.name, f"servo {servo} has goal {answer.state.goal} at {answer.state.position}, not {goal}"
                )
        switched_on: list[int] = []
        try:
            for index in [index for index, on in enumerate(self._enabled) if not on]:
                switched_on.append(index)
                self._bus.write(self._ids[index], Register.TORQUE_ENABLE, bytes([codec.TORQUE_ON]))
                self._enabled[index] = True
        except DeviceError:
            with suppress(DeviceError):
                self._power_off(switched_on)
            raise

    def _power_off(self, indices: Sequence[int]) -> None:
        for index in indices:
            self._bus.write(self._ids[index], Register.TORQUE_ENABLE, bytes([codec.TORQUE_OFF]))
            self._enabled[index] = False

    def _fresh_answers(self) -> list[tuple[int, Reply[ServoState]]]:
        """Request the state of every servo now; return servo ids and states. Raises TransportTimeout."""
        silent = list(self._ids)
        for _ in range(_TRIES):
            answers = self._bus.read_states(self._clock.now_ns() + round(_ANSWER_TIMEOUT_S * 1e9))
            found = [(servo, a) for servo, a in zip(self._ids, answers, strict=True) if a is not None]
            if len(found) == len(self._ids):
                self._answers = list(answers)
                self._unanswered = [0] * len(self._ids)
                return found
            silent = [servo for servo, answer in zip(self._ids, answers, strict=True) if answer is None]
        raise TransportTimeout(self.name, f"state of servos {silent}", _TRIES * _ANSWER_TIMEOUT_S)

    def _cycle(self, now_ns: int, dt_s: float, until_ns: int) -> None:
        due = self._setpoint.q
        if self._driving and any(self._enabled):
            q, dq = due, np.zeros_like(due)
            # One lost reply must not jerk the arm, but no further step is sent without feedback.
            if max(self._unanswered) < _UNSEEN_CYCLES:
                q, dq = self._setpoint.step(now_ns, dt_s)
            self._bus.write_goals(
                {
                    servo.id: (servo.ticks(q[index]), self._speed(index, dq[index]))
                    for index, servo in enumerate(self._config.servos)
                    if self._enabled[index]
                }
            )
        self._take(self._bus.read_states(until_ns), due)

    def _take(self, answers: list[Reply[ServoState] | None], due: Array) -> None:
        good = [self._plausible(index, answer) for index, answer in enumerate(answers)]
        for index, answer in enumerate(good):
            self._unanswered[index] += 1
            if answer is not None:
                self._unanswered[index] = 0
                self._answers[index] = answer
                self._check_servo_in_use(index, answer.state)
        complete = [answer for answer in good if answer is not None]
        self._missed.append(len(complete) < len(good))
        self._check_silence()
        if len(complete) == len(good):
            q = self._publish(complete)
            # The goals of the previous cycle: those the servos have had time to reach.
            if self._driving:
                self._check_tracking(q, due)

    def _plausible(self, index: int, answer: Reply[ServoState] | None) -> Reply[ServoState] | None:
        """Return the reply, or None if the servo cannot have turned that far since the last one."""
        before = self._answers[index]
        if answer is None or before is None:
            return answer
        elapsed_s = (answer.t_ns - before.t_ns) * 1e-9
        reach = _SPEED_MARGIN * self._chain.speed[index] * elapsed_s + _PLAUSIBLE_JUMP_RAD
        if abs(self._angle(index, answer.state.position) - self._angle(index, before.state.position)) <= reach:
            return answer
        self._implausible += 1
        return None

    def _publish(self, answers: list[Reply[ServoState]]) -> Array:
        q = np.array([self._angle(index, answer.state.position) for index, answer in enumerate(answers)])
        units = [self._bus.identity(servo).speed_unit_ticks_s for servo in self._ids]
        dq = np.array(
            [
                servo.direction * answer.state.speed * unit * codec.RAD_PER_TICK
                for servo, answer, unit in zip(self._config.servos, answers, units, strict=True)
            ]
        )
        inside = (q >= self._chain.lower - _PLAUSIBLE_JUMP_RAD) & (q <= self._chain.upper + _PLAUSIBLE_JUMP_RAD)
        self._seq += 1
        self._joints = Stamped(
            JointState(q, dq),
            min(answer.t_ns for answer in answers),
            self._seq,
            quality=Quality.GOOD if inside.all() else Quality.SUSPECT,
        )
        return q

    def _check_servo_in_use(self, index: int, state: ServoState) -> None:
        if found := codec.faults(state.status):
            self._latch(_servo_fault(self.name, self._ids[index], state.status, found[0]))
        if self._enabled[index] and state.torque_enable != codec.TORQUE_ON:
            self._enabled[index] = False
            self._latch(_lost_power(self.name, self._ids[index]))

    def _check_silence(self) -> None:
        now_ns = self._clock.now_ns()
        limit_s = self._config.max_silence_s
        for servo, answer, requested in zip(self._ids, self._answers, self._unanswered, strict=True):
            # A host that was busy elsewhere has received nothing either: it must have requested.
            if answer is not None and requested >= _MAX_UNANSWERED and (now_ns - answer.t_ns) * 1e-9 > limit_s:
                self._latch(TransportTimeout(self.name, f"reply of servo {servo}", limit_s))
        self._check_missed()


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(".") if part.isdigit())


def _latency_timer_ms(port: str) -> int | None:
    """Return the latency timer of an FTDI adapter, or None for another."""
    try:
        return int((Path("/sys/class/tty") / Path(port).resolve().name / "device/latency_timer").read_text())
    except (OSError, ValueError):
        return None


def _open_port(device: str, config: FeetechSerialConfig) -> Any:
    import serial

    try:
        return serial.Serial(
            config.port, config.baudrate, timeout=0, write_timeout=config.max_silence_s, exclusive=True
        )
    except (serial.SerialException, OSError, ValueError) as error:
        raise ConnectError(
            device,
            f"cannot open {config.port} at {config.baudrate}: {error}",
            hint="is it plugged in, are you in the group dialout, and is the port not in use elsewhere?",
        ) from None


def _servo_fault(device: str, servo: int, status: int, bit: FaultBit) -> DeviceFault:
    return DeviceFault(
        device,
        f"servo {servo}: {bit.name}",
        vendor_code=status,
        fault_class=bit.fault_class,
        needs=bit.needs,
        hint=bit.hint,
    )


def _lost_power(device: str, servo: int) -> DeviceFault:
    return DeviceFault(
        device,
        f"servo {servo} has lost its torque or its settings",
        vendor_code="brown-out",
        fault_class=FaultClass.ELECTRICAL,
        needs=Remedy.OPERATOR,
        hint="did it lose power? support the arm, check supply and plugs",
    )


def _build(name: str, config: FeetechSerialConfig, context: DriverContext) -> FeetechSerialArm:
    return FeetechSerialArm(name, config, context.clock)


HOME_DEG: Final = (0.0, 10.0, 90.0, 80.0, 0.0)
"""Tool in front of the base, pointing down, of an ``so101_5r`` arm."""


def behaviour(config: FeetechSerialConfig) -> ArmBehaviour:
    """Return how the arm behaves: one cycle of the bus until a goal is sent, one until it acts."""
    home_deg = HOME_DEG if config.joint_count == len(HOME_DEG) else config.park_deg or (0.0,) * config.joint_count
    return ArmBehaviour(
        state_rate_hz=config.rate_hz,
        latency_s=2.0 / config.rate_hz,
        home_deg=home_deg,
        max_state_age_s=config.max_silence_s,
    )


SPEC = DriverSpec(
    name="feetech_serial",
    summary="arm of Feetech STS3215 bus servos on a serial port (SO-100, SO-101 class)",
    config=FeetechSerialConfig,
    capabilities=Capabilities(
        kind="arm",
        provides=SERVO_ARM | {JointSource, JointGoal, HealthSource},
        state_rate_hz=50.0,
        min_command_rate_hz=10.0,
        command_latency_s=0.02,
        stop_categories=frozenset({int(StopCategory.STOP_AND_HOLD)}),
        twist_axes=(True, True, True, False, False, True),
        has_brakes=False,
        falls_on_power_loss=True,
    ),
    build=_build,
    behaviour=behaviour,
)
