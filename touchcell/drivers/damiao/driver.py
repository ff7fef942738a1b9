"""Driver for arms of Damiao motors in MIT mode on CAN (OpenArm, YAM, reBot and home-made ones), with python-can.

The motors have no Cartesian control, so it runs on the host: a loop converts expiring twists into joint setpoints
(``touchcell.drivers.core.joint_setpoint``), adds gravity compensation torques, and sends every motor a position, a
velocity and a torque. The same loop collects the replies; motors send only replies, so one thread suffices.

Stop mechanisms: when a twist expires, the loop decelerates; when the host process dies, each motor holds its last
position and disables itself after its own timeout. **An arm without brakes sinks then**, and whenever it is disabled.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.drivers.core.bench_address import is_virtual_can
from touchcell.drivers.core.bus_arm import BusArm, BusArmConfig
from touchcell.drivers.core.bus_reply import Reply
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.diagnosis import Finding, finding_of
from touchcell.drivers.core.errors import (
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    Remedy,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import (
    SERVO_ARM,
    HealthSource,
    JointGoal,
    JointSource,
    NativeWatchdog,
    StopCategory,
)
from touchcell.drivers.core.samples import JointState, Stamped
from touchcell.drivers.core.spec import Capabilities, DriverContext, DriverSpec
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.bus import TRIES, Address, MotorBus
from touchcell.drivers.damiao.codec import Feedback, MitCommand, Register
from touchcell.drivers.damiao.keeper_bus import KeeperBus
from touchcell.drivers.kinematics.chain import GRAVITY_M_S2, ChainDescription, ChainFile, SerialChain, Vector3
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

_logger = logging.getLogger(__name__)

_TURN_RAD = 2.0 * np.pi
_MAX_BUS_LOAD = 0.8
_PCAN_CLOCK_HZ = 80_000_000
_SAMPLE_POINT_PERCENT = 80.0
_PLAUSIBLE_JUMP_RAD = 0.1
_ENABLE_TRIES = 3
_WARM_C = 70
_SHORTEST_QUEUE = 100
_MODE_REPORTS = ("openarm_can 64", "dimos 1897")
_SCALE_REPORTS = ("openarm_can 146",)
# While one motor is asked, the others hear nothing: all tries together must not last as long as their watchdog.
_ASKING_FRACTION = 0.75

_DOES_NOT_ENABLE = codec.StatusCode(
    "does not enable", FaultClass.INTERNAL, Remedy.OPERATOR, "check power and emergency stop"
)
_DISABLED_ITSELF = codec.StatusCode(
    "disabled itself", FaultClass.ELECTRICAL, Remedy.OPERATOR, "did it lose power, or does another host control it?"
)


class MotorConfig(BaseModel):
    """Configuration of one joint's motor: joint angle = ``direction`` times motor angle, plus ``offset_deg``.

    Attributes:
        esc_id: CAN id that the motor listens to.
        mst_id: CAN id that it answers with.
        direction: sign of joint angle against motor angle.
        offset_deg: joint angle at the motor's zero.
        kp_n_m_rad: stiffness of its position loop, N m/rad.
        kd_n_m_s_rad: damping of its position loop, N m s/rad.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    esc_id: int = Field(ge=1, le=0x7F)
    mst_id: int = Field(ge=1, le=0x7FE)
    direction: Literal[1, -1] = 1
    offset_deg: float = 0.0
    kp_n_m_rad: Annotated[float, Field(gt=0.0, le=codec.KP_MAX)] = 40.0
    kd_n_m_s_rad: Annotated[float, Field(gt=0.0, le=codec.KD_MAX)] = 1.5


class DamiaoCanConfig(BusArmConfig):
    """Configuration of a Damiao arm.

    ``interface``, ``channel`` and ``bus_options`` go to python-can; the bit rates are those set by the adapter or by
    ``ip link``.

    Attributes:
        interface: of python-can.
        channel: of python-can, such as can0.
        bus_options: further options of python-can.
        fd: whether the bus is CAN FD.
        bitrate: bit/s, as set by the adapter or by ``ip link``.
        data_bitrate: bit/s of the data phase of CAN FD.
        gravity_m_s2: gravity along the axes of the arm's base, for compensation.
        motors: one for each joint, from the base.
        watchdog_s: silence after which a motor lets go by itself: the arm sinks.
        keeper: a process of its own owns the bus; it holds the arm when this process dies, and lowers it slowly.
        lower_after_s: time from the death of this process until the keeper begins to lower the arm.
        lower_speed_mm_s: greatest speed of the tool while it does.
    """

    interface: str = "socketcan"
    channel: str = "can0"
    bus_options: dict[str, str | int | float | bool] = Field(default_factory=dict)
    fd: bool = False
    bitrate: int = Field(default=1_000_000, gt=0)
    data_bitrate: int = Field(default=5_000_000, gt=0)

    chain: ChainFile = "generic_6r"
    gravity_m_s2: Vector3 = GRAVITY_M_S2
    motors: tuple[MotorConfig, ...] = Field(min_length=1)

    keeper: bool = False
    lower_after_s: Annotated[float, Field(ge=0.0, le=60.0)] = 1.0
    lower_speed_mm_s: Annotated[float, Field(gt=0.0, le=50.0)] = 40.0

    rate_hz: Annotated[float, Field(ge=50.0, le=1000.0)] = 250.0
    watchdog_s: Annotated[float, Field(ge=0.02, le=0.4)] = 0.1

    def emulated_address(self) -> str | None:
        """Return ``channel`` if it is a virtual bus of this machine."""
        return "channel" if is_virtual_can(self.interface, self.channel) else None

    @property
    def joint_count(self) -> int:
        """Number of configured motors."""
        return len(self.motors)

    @model_validator(mode="after")
    def _check(self) -> Self:
        for field in ("esc_id", "mst_id"):
            numbers = [getattr(motor, field) for motor in self.motors]
            if len(set(numbers)) < len(numbers):
                raise ValueError(f"two motors share one {field}: {numbers}")
        if self.bus_load > _MAX_BUS_LOAD:
            raise ValueError(
                f"{len(self.motors)} motors at {self.rate_hz:g} Hz would load the bus to {self.bus_load:.0%}, "
                f"more than {_MAX_BUS_LOAD:.0%}: lower rate_hz or use CAN FD"
            )
        if self.watchdog_s * self.rate_hz < 4:
            raise ValueError(f"watchdog_s {self.watchdog_s:g} is less than four cycles of {self.rate_hz:g} Hz")
        return self

    @property
    def bus_load(self) -> float:
        """Worst-case fraction of the bus used by commands and replies."""
        return codec.bus_load(len(self.motors), self.rate_hz, self.bitrate, self.data_bitrate if self.fd else None)

    def describe(self) -> ChainDescription:
        """Return the chain description of the arm.

        Raises:
            ConfigError: unknown chain, wrong number of joints, or a park pose outside the joint limits.
        """
        found = self.named_chain("motors")
        self.require_park_within(found)
        return found


class DamiaoCanArm(BusArm):
    """Driver for a Damiao arm; see the module for its stop mechanisms.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: real time; the loop is a thread and cannot run on a virtual clock.
    """

    _config: DamiaoCanConfig
    _keeper: KeeperBus | None

    def __init__(self, name: str, config: DamiaoCanConfig, clock: Clock) -> None:
        super().__init__(name, config, clock, SerialChain(config.describe(), config.tool, config.gravity_m_s2))
        motors = config.motors
        self._direction = np.array([motor.direction for motor in motors], dtype=np.float64)
        self._zero = np.deg2rad([motor.offset_deg for motor in motors])
        self._offset = self._zero
        addresses = [Address(motor.esc_id, motor.mst_id) for motor in motors]
        self._bus = MotorBus(
            name,
            addresses,
            self._connect,
            clock,
            max_silence_s=config.max_silence_s,
            answer_s=config.watchdog_s * _ASKING_FRACTION / TRIES,
            fd=config.fd,
        )

    def _connect(self) -> Any:
        if not self._config.keeper:
            return open_bus(self.name, self._config)
        settings = self._config.model_dump(mode="json")
        keeper = KeeperBus(self.name, self._config.interface, self._config.channel, settings)
        self._keeper = keeper
        return keeper

    def _reset_state(self) -> None:
        super()._reset_state()
        self._keeper = None
        self._answers: list[Reply[Feedback] | None] = [None] * len(self._config.motors)
        self._held: tuple[Array, Array] | None = None
        self._turns: Array | None = None

    def watchdog_s(self) -> float:
        """Return the timeout after which the motors disable themselves, as read back; the longest of them."""
        known = [ticks for ticks in self._bus.timeout_ticks if ticks is not None]
        if len(known) < len(self._enabled):
            raise LifecycleError(self.name, "read the watchdog's period", self.state.value, [Lifecycle.READY.value])
        return max(known) * codec.TIMEOUT_TICK_S

    def health(self) -> dict[str, float | int | str | bool]:
        """Return counters of the bus and the loop, temperatures, status, active limits."""
        readings: dict[str, float | int | str | bool] = dict(self._bus.counters.as_dict())
        readings |= {
            "bus_state": self._bus.state,
            "bus_error": self._bus.last_error,
            "bus_load": self._config.bus_load,
            "keeper_pid": 0 if self._keeper is None else self._keeper.pid,
            "turns_added": "" if self._turns is None else " ".join(f"{turn / _TURN_RAD:.0f}" for turn in self._turns),
        }
        readings |= super().health()
        for joint, answer in zip(self._chain.joint_names, self._answers, strict=True):
            if answer is not None:
                readings[f"{joint}_status"] = answer.state.status
                readings[f"{joint}_mos_c"] = answer.state.mos_c
                readings[f"{joint}_rotor_c"] = answer.state.rotor_c
        return readings

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong with motors, bus and adapter; reads registers only."""
        with self._lock:
            for index, motor in enumerate(self._config.motors):
                for check in (self._check_mode, self._check_ranges):
                    try:
                        check(index)
                    except ConfigError as error:
                        yield finding_of(error, *(_MODE_REPORTS if check == self._check_mode else _SCALE_REPORTS))
                if not self._bus.read(index, Register.TIMEOUT):
                    what = f"motor {motor.esc_id} has no timeout: it would obey its last command for ever"
                    yield Finding(
                        what, "configure sets it until the next power cycle", ("lerobot 3178",), is_fault=False
                    )
        yield from self._diagnose_joints()
        if self._bus.state != "active":
            what = f"the CAN controller is {self._bus.state}; it reported: {self._bus.last_error or 'nothing'}"
            yield Finding(what, "check wiring, termination and bit rates", ("CANopenNode 319", "yarp-devices 246"))
        if self._bus.counters.not_sent:
            what = f"the adapter refused {self._bus.counters.not_sent} frames: {self._bus.last_error}"
            remedy = f"sudo ip link set {self._config.channel} txqueuelen 1000"
            yield Finding(what, remedy, ("python-can 1495", "python-can 2004"), False)
        queue = _transmit_queue(self._config)
        if queue is not None and queue < _SHORTEST_QUEUE:
            what = f"the transmit queue of {self._config.channel} holds {queue} frames"
            remedy = f"sudo ip link set {self._config.channel} txqueuelen 1000"
            yield Finding(what, remedy, ("python-can 1495", "linux-can/can-utils 400"), is_fault=False)

    def _diagnose_joints(self) -> Iterator[Finding]:
        for motor, answer in zip(self._config.motors, self._answers, strict=True):
            if answer is None:
                continue
            if (code := codec.fault(answer.state.status)) is not None:
                yield Finding(f"motor {motor.esc_id}: {code.name}", code.hint, ("arx5-sdk 20",))
            hottest_c = max(answer.state.mos_c, answer.state.rotor_c)
            if hottest_c >= _WARM_C:
                yield Finding(f"motor {motor.esc_id} is at {hottest_c} degrees Celsius", "let it cool down", (), False)
        if self._turns is not None and self._turns.any():
            joints = [name for name, turn in zip(self._chain.joint_names, self._turns, strict=True) if turn]
            what = f"powered up one turn off, and corrected: {', '.join(joints)}"
            yield Finding(what, "nothing to do", ("axol 208", "i2rt 82"), is_fault=False)
        if self._joints is not None:
            q = self._joints.value.q
            for joint in np.flatnonzero((q < self._chain.lower) | (q > self._chain.upper)):
                what = (
                    f"joint {self._chain.joint_names[joint]} is at {np.rad2deg(q[joint]):.0f} deg, outside its limits"
                )
                yield Finding(
                    what, "move it back by hand; only if its angle is wrong, correct offset_deg", ("axol 208",)
                )

    def _open_bus(self) -> None:
        self._bus.open()

    def _close_bus(self) -> None:
        self._switch_off()
        self._bus.close()

    def _reopen_bus(self) -> None:
        self._bus.close()
        self._bus.open()
        # What they held is over: motors disable themselves when they hear nothing, and may have lost their power.
        self._answers = [None] * len(self._answers)
        self._turns = None
        states = self._exchange([None] * len(self._answers))
        self._enabled = [each is not None and each.state.status == codec.ENABLED for each in states]

    def _configure(self) -> None:
        with self._lock:
            for index in range(len(self._config.motors)):
                self._check_mode(index)
                self._check_ranges(index)
                self._set_watchdog(index)

    def _activate(self) -> None:
        with self._lock:
            if self._latched_fault is not None:
                raise self._latched_fault
            q = self.joints(self._config.max_silence_s).value.q
            outside = (q < self._chain.lower) | (q > self._chain.upper)
            if outside.any():
                joint = self._chain.joint_names[int(np.argmax(outside))]
                raise DeviceFault(
                    self.name,
                    f"joint {joint} is outside its limits",
                    fault_class=FaultClass.MOTION,
                    needs=Remedy.OPERATOR,
                    hint="move it back by hand; only if its angle is wrong, correct offset_deg and direction",
                )
            for index in range(len(self._enabled)):
                self._check_watchdog(index, int(self._bus.read(index, Register.TIMEOUT)))
            if self._keeper is not None:
                self._keeper.tell_offsets(self._offset)
            if all(self._enabled):
                return
            # Motors that are enabled already keep their setpoint, whatever load makes them sag.
            self._setpoint.reset(np.where(self._enabled, self._setpoint.q, q))
            self._enable([index for index, on in enumerate(self._enabled) if not on])

    def _recover(self, token: OperatorToken) -> None:
        self._require_loop()
        with self._lock:
            answers = [self._fresh_answer(index) for index in range(len(self._enabled))]
            for index, motor in enumerate(self._config.motors):
                status = answers[index].state.status
                if codec.fault(status) is not None:
                    status = self._bus.command(index, codec.CLEAR_ERROR).status
                if (code := codec.fault(status)) is not None:
                    raise _motor_fault(self.name, motor.esc_id, status, code)
                self._enabled[index] = self._enabled[index] and status == codec.ENABLED
            self._configure()
            self._missed.clear()
            self._latched_fault = None

    def _fresh_answer(self, index: int) -> Reply[Feedback]:
        """Return the loop's newest reply. Waiting for a silent motor here would let the others' timeouts expire."""
        answer, limit_s = self._answers[index], self._config.max_silence_s
        if answer is None or (self._clock.now_ns() - answer.t_ns) * 1e-9 > limit_s:
            raise TransportTimeout(self.name, f"reply of motor {self._config.motors[index].esc_id}", limit_s)
        return answer

    def _check_mode(self, index: int) -> None:
        if (mode := self._bus.read(index, Register.CTRL_MODE)) != codec.MIT_MODE:
            raise ConfigError(
                f"motor {self._config.motors[index].esc_id} is in control mode {mode}, not MIT (1)",
                key="motors",
                value=mode,
                hint="set register 10 to 1 with the manufacturer's tool; a driver does not change modes",
            )

    def _check_ranges(self, index: int) -> None:
        motor, ranges = self._config.motors[index], self._bus.ranges(index)
        ends = self._direction[index] * (
            np.array([self._chain.lower[index], self._chain.upper[index]]) - self._offset[index]
        )
        joint = self._chain.joint_names[index]
        if np.abs(ends).max() > ranges.position_rad:
            raise ConfigError(
                f"joint {joint} reaches {np.abs(ends).max():.2f} rad, its motor only {ranges.position_rad:.2f}",
                key=f"motors[{index}]",
            )
        if self._chain.speed[index] > ranges.velocity_rad_s:
            raise ConfigError(
                f"the speed limit of joint {joint} is {self._chain.speed[index]:.2f} rad/s, "
                f"its motor's full scale {ranges.velocity_rad_s:.2f}",
                key=f"motors[{index}]",
            )
        push = motor.kp_n_m_rad * float(np.deg2rad(self._config.tracking_error_deg))
        if push > min(self._chain.torque[index], ranges.torque_n_m):
            raise ConfigError(
                f"kp of joint {joint} gives {push:.1f} N m before tracking_error_deg trips, more than its torque",
                key=f"motors[{index}].kp_n_m_rad",
                value=motor.kp_n_m_rad,
            )

    def _set_watchdog(self, index: int) -> None:
        ticks = round(self._config.watchdog_s / codec.TIMEOUT_TICK_S)
        self._check_watchdog(index, int(self._bus.write(index, Register.TIMEOUT, ticks)))
        self._bus.timeout_ticks[index] = ticks

    def _check_watchdog(self, index: int, ticks: int) -> None:
        wanted = round(self._config.watchdog_s / codec.TIMEOUT_TICK_S)
        if ticks != wanted:
            raise DeviceFault(
                self.name,
                f"motor {self._config.motors[index].esc_id} has a timeout of {ticks * codec.TIMEOUT_TICK_S:g} s, "
                f"not {self._config.watchdog_s:g} s",
                vendor_code="TIMEOUT",
                fault_class=FaultClass.CONFIGURATION,
                hint="did it lose power? configure again; without the timeout an arm whose host died keeps pushing",
            )

    def _enable(self, indices: list[int]) -> None:
        """Enable these motors at the setpoint, all at once; if one fails, disable all of them."""
        frames = self._frames(self._setpoint.q, np.zeros_like(self._setpoint.q))
        waiting = list(indices)
        try:
            # Some motors do not take the first command to enable (openarm issue 471).
            for _ in range(_ENABLE_TRIES):
                self._exchange([codec.ENABLE if i in waiting else self._own(frames, i) for i in range(len(frames))])
                for index in waiting:
                    self._enabled[index] = True
                # A motor enabled without gains is limp until it has its setpoint.
                answers = self._exchange([self._own(frames, i) for i in range(len(frames))])
                waiting = [index for index in waiting if not self._is_enabled(index, answers[index])]
                if not waiting:
                    return
            raise _motor_fault(self.name, self._config.motors[waiting[0]].esc_id, codec.DISABLED, _DOES_NOT_ENABLE)
        except DeviceError:
            self._disable(indices)
            raise

    def _own(self, frames: Sequence[bytes], index: int) -> bytes | None:
        return frames[index] if self._enabled[index] else None

    def _is_enabled(self, index: int, answer: Reply[Feedback] | None) -> bool:
        """Return whether a motor that was enabled reports so. Raises DeviceFault for one that reports a fault."""
        status = codec.DISABLED if answer is None else answer.state.status
        if (code := codec.fault(status)) is not None:
            raise _motor_fault(self.name, self._config.motors[index].esc_id, status, code)
        return status == codec.ENABLED

    def _exchange(self, frames: Sequence[bytes | None]) -> list[Reply[Feedback] | None]:
        """Send every motor a frame, or ask it for its state, and wait for all replies, outside the loop."""
        wait_s = self._config.watchdog_s * _ASKING_FRACTION / TRIES
        return self._bus.exchange(frames, self._clock.now_ns() + round(wait_s * 1e9))

    def _switch_off(self) -> None:
        self._disable(range(len(self._enabled)))

    def _disable(self, indices: Sequence[int]) -> None:
        """Disable these motors, as far as they are reachable."""
        with self._lock:
            for index in indices:
                if not self._enabled[index]:
                    continue
                self._enabled[index] = False
                try:
                    self._bus.command(index, codec.DISABLE)
                except DeviceGone:
                    return
                except TransportTimeout:
                    # An unreachable motor is disabled by its own timeout.
                    continue

    def _cycle(self, now_ns: int, dt_s: float, until_ns: int) -> None:
        frames: list[bytes | None] = [None] * len(self._enabled)
        if any(self._enabled):
            q, dq = self._setpoint.step(now_ns, dt_s)
            commands = self._frames(q, dq)
            frames = [command if on else None for command, on in zip(commands, self._enabled, strict=True)]
        self._take(self._bus.exchange(frames, until_ns))

    def _repeat_commands(self) -> None:
        if self._held is not None:
            q, tau = self._held
            frames = self._encode(q, np.zeros_like(q), tau)
            self._bus.exchange([frame if on else None for frame, on in zip(frames, self._enabled, strict=True)], 0)

    def _frames(self, q: Array, dq: Array) -> list[bytes]:
        strongest = np.minimum(self._chain.torque, [self._bus.ranges(i).torque_n_m for i in range(len(q))])
        tau = np.clip(self._chain.gravity_torques(q), -strongest, strongest)
        frames = self._encode(q, dq, tau)
        self._held = q, tau
        return frames

    def _encode(self, q: Array, dq: Array, tau: Array) -> list[bytes]:
        motor_q = self._direction * (q - self._offset)
        motor_dq, motor_tau = self._direction * dq, self._direction * tau
        return [
            codec.encode_mit(
                MitCommand(motor_q[i], motor_dq[i], motor.kp_n_m_rad, motor.kd_n_m_s_rad, motor_tau[i]),
                self._bus.ranges(i),
            )
            for i, motor in enumerate(self._config.motors)
        ]

    def _take(self, answers: list[Reply[Feedback] | None]) -> None:
        good = [self._plausible(index, answer) for index, answer in enumerate(answers)]
        for index, answer in enumerate(good):
            if answer is not None:
                self._answers[index] = answer
                self._check_status(index, answer.state.status)
        known = [answer for answer in self._answers if answer is not None]
        if len(known) == len(good) and all(answer is not None for answer in good):
            self._publish(known)
        self._missed.append(any(answer is None for answer in good))
        self._check_silence()
        self._check_fences()
        if self._joints is not None:
            self._check_tracking(self._joints.value.q, self._setpoint.q)

    def _plausible(self, index: int, answer: Reply[Feedback] | None) -> Reply[Feedback] | None:
        """Return the reply, or None if the motor cannot have turned that far since the last one."""
        before = self._answers[index]
        if answer is None or before is None:
            return answer
        elapsed_s = max(answer.t_ns - before.t_ns, 0) * 1e-9
        reach = self._bus.ranges(index).velocity_rad_s * elapsed_s + _PLAUSIBLE_JUMP_RAD
        if abs(answer.state.q - before.state.q) <= reach:
            return answer
        self._implausible += 1
        return None

    def _publish(self, answers: list[Reply[Feedback]]) -> None:
        feedback = np.array([(a.state.q, a.state.dq, a.state.tau) for a in answers])
        if self._turns is None:
            self._turns = self._count_turns(self._direction * feedback[:, 0] + self._zero)
            self._offset = self._zero + self._turns
        state = JointState(
            self._direction * feedback[:, 0] + self._offset,
            self._direction * feedback[:, 1],
            self._direction * feedback[:, 2],
        )
        self._seq += 1
        self._joints = Stamped(state, min(answer.t_ns for answer in answers), self._seq)

    def _count_turns(self, q: Array) -> Array:
        """Return whole turns (n,) rad to add to joint angles, where a motor has powered up one turn off.

        Only where its angle is outside the joint's range and one turn leads into it, which is unique.
        """
        turns = np.zeros_like(q)
        for index, (angle, lower, upper) in enumerate(zip(q, self._chain.lower, self._chain.upper, strict=True)):
            fits = [turn for turn in (-_TURN_RAD, 0.0, _TURN_RAD) if lower <= angle + turn <= upper]
            if len(fits) == 1 and fits[0]:
                turns[index] = fits[0]
                _logger.warning(
                    "%s: joint %s powered up one turn off, at %.1f deg; taken as %.1f deg",
                    self.name,
                    self._chain.joint_names[index],
                    np.rad2deg(angle),
                    np.rad2deg(angle + fits[0]),
                )
        return turns

    def _check_status(self, index: int, status: int) -> None:
        esc_id = self._config.motors[index].esc_id
        code = codec.fault(status)
        if code is None and self._enabled[index] and status == codec.DISABLED:
            code = _DISABLED_ITSELF
        if code is not None:
            self._enabled[index] = False
            self._latch(_motor_fault(self.name, esc_id, status, code))

    def _check_silence(self) -> None:
        now_ns = self._clock.now_ns()
        limit_s = self._config.max_silence_s
        for motor, answer in zip(self._config.motors, self._answers, strict=True):
            if answer is not None and (now_ns - answer.t_ns) * 1e-9 > limit_s:
                hint = f"the adapter reported: {self._bus.last_error}" if self._bus.last_error else ""
                self._latch(TransportTimeout(self.name, f"reply of motor {motor.esc_id}", limit_s, hint=hint))
        self._check_missed()

    def _check_fences(self) -> None:
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            for index, ticks in enumerate(self._bus.timeout_ticks):
                if ticks is not None:
                    self._check_watchdog(index, ticks)


def _transmit_queue(config: DamiaoCanConfig) -> int | None:
    """Return the length of the kernel's transmit queue, or None where there is none."""
    if config.interface != "socketcan":
        return None
    try:
        return int(Path(f"/sys/class/net/{config.channel}/tx_queue_len").read_text())
    except (OSError, ValueError):
        return None


def open_bus(device: str, config: DamiaoCanConfig) -> Any:
    """Open the python-can bus of ``config`` at its bit rates. Raises ConnectError."""
    import can

    is_kernels = config.interface == "socketcan"
    # Adapters that python-can opens itself start at a rate of their own (slcan, gs_usb and pcan at 500 kbit/s or none).
    rates = {} if is_kernels else {"bitrate": config.bitrate}
    if config.fd and not is_kernels:
        rates["data_bitrate"] = config.data_bitrate
    options: dict[str, Any] = rates | config.bus_options
    channel: str | int = config.channel
    if config.interface == "gs_usb" and config.channel.isdigit():
        # python-can takes the number of the adapter.
        channel = int(config.channel)
    if config.interface == "pcan":
        _complete_pcan(device, config, options)
    try:
        bus = can.Bus(interface=config.interface, channel=channel, fd=config.fd, **options)
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise ConnectError(
            device,
            f"cannot open CAN {config.interface} {config.channel}: {error}",
            hint=f"is the interface up? `ip link set {config.channel} up type can bitrate {config.bitrate}`"
            if is_kernels
            else f"is the adapter plugged in, and does it support {config.bitrate} bit/s?",
        ) from None
    if config.fd and bus.protocol is can.CanProtocol.CAN_20:
        bus.shutdown()
        raise ConnectError(
            device, f"{config.interface} does not send CAN FD frames", hint="set fd: false, or use another adapter"
        )
    return bus


def _complete_pcan(device: str, config: DamiaoCanConfig, options: dict[str, Any]) -> None:
    """Check the bit rate of a PCAN adapter, for which python-can silently takes 500 kbit/s; give FD its timing."""
    import can
    from can.interfaces.pcan.basic import PCAN_BITRATES

    if config.fd and not {"timing", "f_clock", "f_clock_mhz"} & options.keys():
        options["timing"] = can.BitTimingFd.from_sample_point(
            f_clock=_PCAN_CLOCK_HZ,
            nom_bitrate=config.bitrate,
            nom_sample_point=_SAMPLE_POINT_PERCENT,
            data_bitrate=config.data_bitrate,
            data_sample_point=_SAMPLE_POINT_PERCENT,
        )
    elif not config.fd and config.bitrate not in PCAN_BITRATES:
        known = ", ".join(map(str, sorted(PCAN_BITRATES)))
        raise ConnectError(device, f"a PCAN adapter has no bit rate of {config.bitrate}", hint=f"one of {known}")


def _motor_fault(device: str, esc_id: int, status: int, code: codec.StatusCode) -> DeviceFault:
    return DeviceFault(
        device,
        f"motor {esc_id}: {code.name}",
        vendor_code=status,
        fault_class=code.fault_class,
        needs=code.needs,
        hint=code.hint,
    )


def _build(name: str, config: DamiaoCanConfig, context: DriverContext) -> DamiaoCanArm:
    return DamiaoCanArm(name, config, context.clock)


HOME_DEG: Final = (0.0, 40.0, 90.0, 0.0, 50.0, 0.0)
"""Tool in front of the base, pointing down, of a ``generic_6r`` arm."""


def behaviour(config: DamiaoCanConfig) -> ArmBehaviour:
    """Return how the arm behaves: one cycle of the bus until a setpoint is sent, one until it acts."""
    home_deg = HOME_DEG if config.joint_count == len(HOME_DEG) else config.park_deg or (0.0,) * config.joint_count
    return ArmBehaviour(
        state_rate_hz=config.rate_hz,
        latency_s=2.0 / config.rate_hz,
        home_deg=home_deg,
        max_state_age_s=config.max_silence_s,
        watchdog_s=config.watchdog_s,
    )


SPEC = DriverSpec(
    name="damiao_can",
    summary="arm of Damiao MIT-mode motors on CAN or CAN FD (OpenArm, YAM, reBot class), over python-can",
    config=DamiaoCanConfig,
    capabilities=Capabilities(
        kind="arm",
        provides=SERVO_ARM | {JointSource, JointGoal, HealthSource, NativeWatchdog},
        state_rate_hz=250.0,
        min_command_rate_hz=20.0,
        command_latency_s=0.004,
        stop_categories=frozenset({int(StopCategory.STOP_AND_HOLD)}),
        max_watchdog_s=0.4,
        has_brakes=False,
        falls_on_power_loss=True,
    ),
    build=_build,
    behaviour=behaviour,
)
