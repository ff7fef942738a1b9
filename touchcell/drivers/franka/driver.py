"""Driver for Franka arms (FR3, Research 3) with franky, which keeps libfranka's 1 kHz loop in a thread outside the GIL.

A twist becomes a Cartesian velocity motion that lasts as long as its time-to-live: libfranka's thread counts that time
and brakes the arm even if Python hangs. If the whole process dies, the controller misses 20 command packets and stops
the arm with a communication reflex. The Franka Control Interface cannot release or close the brakes; Desk does. So
``activate`` sends nothing: it only checks that the arm is at rest, accepts commands and reports no error.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from pydantic import Field

from touchcell.drivers.core.arm import Arm, JointLimitsConfig, LimitsConfig
from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.drivers.core.bench_address import is_this_machine
from touchcell.drivers.core.chain_check import require_same_arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.command_checks import finite_array
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle, OperatorToken
from touchcell.drivers.core.diagnosis import Finding, finding_of
from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    Rejection,
    Remedy,
    StaleData,
    TransportError,
    TransportTimeout,
)
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import (
    SERVO_ARM,
    ExternalTorqueSource,
    HealthSource,
    JointGoal,
    JointSource,
    NativeWatchdog,
    StopCategory,
    WrenchSource,
)
from touchcell.drivers.core.samples import JointState, Stamped, TcpState, of_other_point
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.franka.errors import BY_NAME, ERRORS, MODES, VendorError
from touchcell.drivers.franka.reader import PERIOD_S, Reading, StateReader
from touchcell.drivers.kinematics.chain import ChainDescription, ChainFile, DifferentialIk, LocalIk, SerialChain, Tool
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

CAPABILITIES = Capabilities(
    kind="arm",
    provides=SERVO_ARM | {JointSource, WrenchSource, ExternalTorqueSource, JointGoal, HealthSource, NativeWatchdog},
    state_rate_hz=1.0 / (2 * PERIOD_S),
    min_command_rate_hz=10.0,
    command_latency_s=0.001,
    stop_categories=frozenset({int(StopCategory.STOP_AND_HOLD)}),
    max_watchdog_s=0.02,
    has_brakes=True,
)

_WATCHDOG_S = 0.02
_CONNECT_S = 5.0
_FIRST_STATE_S = 2.0
_FRESH_S = 0.25
_FRAME_S = 0.5
# Recovery has been seen to take 16 s (franka_ros issue 317).
_RECOVERY_S = 20.0
# franky's motions are smooth already, and libfranka's filter assumes that no state is ever lost: after a loss it jumps.
_NO_FILTER_HZ = 1000.0
_POLL_NS = 2_000_000
_JOINT_TORQUE_NM = 20.0
_REST_SPEED_RAD_S = 0.01
_FRAME_TOLERANCE = 1e-5
_OBEYS = ("Idle", "Move")
_NEEDS_A_PERSON = ("UserStopped", "Other", "Guiding")
_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE, Lifecycle.FAULTED)
_REALTIME_KERNEL = Path("/sys/kernel/realtime")

_JOINTS = 7


class FrankaConfig(DriverConfig):
    """Configuration of a Franka arm.

    Attributes:
        host: address of the controller.
        chain: name of a chain description that ships, or path of a YAML or URDF file; seven joints.
        limits: speed and acceleration limits of the tool centre point.
        joint_limits: margins to the joint limits, which the controller reports, and to singularities.
        enforce_realtime: refuse to run without a PREEMPT_RT kernel; without one expect communication reflexes.
        dynamics_factor: fraction of the arm's largest acceleration and jerk (and speed, for goals) that motions may
            use.
        stop_dynamics_factor: the same for stopping, also at the end of a time-to-live.
        contact_force_limit_n: external force at which libfranka's thread brakes the arm, within a millisecond.
        contact_torque_limit_nm: external torque at which the controller itself stops the arm with a reflex.
        flange_to_tcp_mm_deg: tool centre point in the flange frame, [x y z alpha beta gamma]; None leaves the end
            effector as it is set in Desk.
        state_timeout_s: oldest state with which a twist is followed; an older one is a fault.
    """

    host: str = Field(min_length=1)
    chain: ChainFile = "fr3"
    limits: LimitsConfig = LimitsConfig()
    joint_limits: JointLimitsConfig = JointLimitsConfig()
    enforce_realtime: bool = True
    dynamics_factor: float = Field(default=0.05, gt=0.0, le=1.0)
    stop_dynamics_factor: float = Field(default=0.2, gt=0.0, le=1.0)
    contact_force_limit_n: float = Field(default=20.0, gt=0.0, le=100.0)
    contact_torque_limit_nm: float = Field(default=10.0, gt=0.0, le=50.0)
    flange_to_tcp_mm_deg: tuple[float, float, float, float, float, float] | None = None
    state_timeout_s: float = Field(default=0.5, ge=0.02, le=1.0)

    def emulated_address(self) -> str | None:
        """Return ``host`` if it is this machine."""
        return "host" if is_this_machine(self.host) else None

    def described_chain(self) -> SerialChain:
        """Return the chain with the configured tool, or with none where Desk has set it. Raises ConfigError."""
        x, y, z, alpha, beta, gamma = self.flange_to_tcp_mm_deg or (0.0,) * 6
        tool = Tool(origin_mm=(x, y, z), rotation_deg=(alpha, beta, gamma))
        return SerialChain(self.arm(), tool)

    def arm(self) -> ChainDescription:
        """Return the description of the arm. Raises ConfigError for one that does not have seven joints."""
        found = ChainDescription.named(self.chain)
        if len(found.joints) != _JOINTS:
            raise ConfigError(f"has {len(found.joints)} joints, and this arm {_JOINTS}", key="chain", value=self.chain)
        return found


@dataclass(frozen=True, slots=True)
class _Scheduling:
    policy: int
    priority: int

    @classmethod
    def of_this_thread(cls) -> _Scheduling:
        return cls(os.sched_getscheduler(0), os.sched_getparam(0).sched_priority)

    def apply(self) -> None:
        os.sched_setscheduler(0, self.policy, os.sched_param(self.priority))


class FrankaArm(Arm):
    """Driver for a Franka arm.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
    """

    def __init__(self, name: str, config: FrankaConfig, clock: Clock) -> None:
        super().__init__(
            name,
            clock,
            config.limits.build(),
            stop_categories=CAPABILITIES.stop_categories,
            max_state_age_s=config.state_timeout_s,
        )
        self._config = config
        self._franky: Any = None
        self._tool_is_set = False
        self._robot: Any = None
        self._reader: StateReader | None = None
        self._control_scheduling: _Scheduling | None = None
        self._contact = threading.Event()
        self._moved_ns = clock.now_ns()
        self._joint_limits = np.zeros((7, 2))
        self._ik = self._kinematics_of(SerialChain(config.arm()))

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the newest state. Raises StaleData if older than ``max_age_s``, or the fault of the arm.

        It is that of ``flange_to_tcp_mm_deg``, also before ``configure`` has set this tool in the controller.
        """
        reading = self._reading("read its pose", max_age_s)
        # The controller's rotation matrix is orthonormal to about 1e-6 only.
        state = TcpState(se3.project(reading.T_base_tcp), reading.twist)
        wanted = self._config.flange_to_tcp_mm_deg
        if wanted is not None and not self._tool_is_set:
            T_ee_tcp = np.linalg.solve(reading.T_flange_tcp, se3.from_euler_mm_deg(wanted))
            state = of_other_point(state, se3.compose(state.T_base_tcp, se3.project(T_ee_tcp)))
        return _stamped(state, reading)

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the newest joint state. Raises as ``tcp``."""
        reading = self._reading("read its joints", max_age_s)
        return _stamped(JointState(reading.q, reading.dq, reading.tau), reading)

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return the estimated external wrench (6,) at the tool centre point along base axes. Raises as ``tcp``."""
        reading = self._reading("read its wrench", max_age_s)
        return _stamped(reading.wrench, reading)

    def external_torques(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return the external torques (7,) of the joints, N m, as the controller estimates them. As ``tcp``."""
        reading = self._reading("tell its external torques", max_age_s)
        return _stamped(reading.external_torque, reading)

    def at_rest(self) -> bool:
        """Return whether the arm stands still and no motion runs. Raises the error that ended a motion."""
        self._require("check for standstill", *_READABLE)
        self._raise_failure()
        reader, reading = self._open_reader(), self._newest()
        if self._age_s(reading) > _FRESH_S:
            return False
        if reader.in_motion or reader.polled_ns <= self._moved_ns:
            return False
        return bool(np.abs(reading.dq).max() < _REST_SPEED_RAD_S)

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (7,) rad by franky's planner; ``at_rest`` reports arrival.

        ``speed_fraction`` is of the arm's largest speed; ``dynamics_factor`` of the configuration caps it.

        Raises:
            CommandRejected: no lease, not active, not finite, wrong shape, outside the joint limits, or still moving
                otherwise.
        """
        target = self._checked_goal("q", q, (7,), lease)
        low, high = self._joint_limits.T
        if (target < low).any() or (target > high).any():
            raise CommandRejected(
                self.name, Rejection.LIMIT, "q is outside the joint limits", value=target, limit=self._joint_limits
            )
        factor = self._goal_factor(speed_fraction)
        franky = self._franky
        motion = franky.JointMotion(franky.JointState(target), relative_dynamics_factor=factor)
        self._start(motion, franky.JointStopMotion, franky.ControlSignalType.JointPositions)

    def go_to_pose(self, T_base_tcp: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving in a straight line to ``T_base_tcp`` (4, 4); otherwise like ``go_to_joints``.

        The speed limits of the tool centre point apply too.
        """
        target = self._checked_goal("T_base_tcp", T_base_tcp, (4, 4), lease)
        R = target[:3, :3]
        is_rigid = np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0
        if not is_rigid or (target[3] != (0.0, 0.0, 0.0, 1.0)).any():
            raise CommandRejected(self.name, Rejection.SHAPE, "T_base_tcp is not a rigid transform", value=target)
        factor = min(
            self._goal_factor(speed_fraction),
            self.limits.speed_m_s / self._robot.translation_velocity_limit.max,
            self.limits.rot_speed_rad_s / self._robot.rotation_velocity_limit.max,
        )
        franky = self._franky
        motion = franky.CartesianMotion(franky.Affine(target), relative_dynamics_factor=factor)
        self._start(motion, franky.CartesianStopMotion, franky.ControlSignalType.CartesianPose)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return mode, errors and packet counters."""
        self._require("read its health", *_READABLE)
        reader, reading = self._open_reader(), self._newest()
        return {
            "mode": reading.mode,
            "errors": ", ".join(reading.errors),
            "state_age_s": self._age_s(reading),
            "states": reader.states,
            "bad_states": reader.bad,
            "command_success_rate": reading.success_rate,
            "in_motion": reader.in_motion,
            "external_force_n": float(np.linalg.norm(reading.wrench[:3])),
        }

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong with the controller, the network and this machine."""
        reading = self._newest()
        if reading.mode not in _OBEYS or reading.errors:
            yield finding_of(self._fault(reading), "libfranka 37", "franky 7")
        for name in reading.errors:
            entry = BY_NAME[name]
            yield Finding(name, entry.hint, ("libfranka 23", "frankx 22"))
        if not _has_realtime_kernel():
            what = "this kernel is not PREEMPT_RT: communication_constraints_violation is likely"
            yield Finding(what, "boot a real-time kernel", ("libfranka 60", "franky 7"), self._config.enforce_realtime)
        if self._open_reader().bad:
            what = f"{self._open_reader().bad} states were unreadable"
            yield Finding(what, "use a direct cable to the arm's controller", ("libfranka 174",), is_fault=False)

    def kinematics(self) -> DifferentialIk:
        """Return the differential inverse kinematics, with the tool set in the controller by ``configure``."""
        return self._ik

    def watchdog_s(self) -> float:
        """Return the silence after which the controller stops the arm: 20 command packets at 1 kHz, fixed by Franka."""
        return _WATCHDOG_S

    def _open(self) -> None:
        config = self._config
        if config.enforce_realtime and not _has_realtime_kernel():
            raise ConnectError(
                self.name,
                "this kernel is not PREEMPT_RT",
                hint="boot a real-time kernel, or set enforce_realtime: false and expect communication reflexes",
            )
        self._tool_is_set = False
        franky = self._franky = _import_franky(self.name)
        realtime = franky.RealtimeConfig.Enforce if config.enforce_realtime else franky.RealtimeConfig.Ignore
        try:
            # libfranka makes the connecting thread a real-time thread, where permitted, and its control threads inherit
            # that. Python must not starve the machine, so it keeps its own scheduling and lends real-time only to those
            # threads.
            self._robot, self._control_scheduling = self._connected(
                lambda: franky.Robot(config.host, realtime_config=realtime)
            )
        except (franky.Exception, RuntimeError) as error:
            raise ConnectError(
                self.name,
                f"no Franka controller at {config.host}",
                [error],
                hint="check the cable, activate FCI in Desk, and close other clients: there can be one only",
            ) from None
        # Every motion has its own factor; the robot's would multiply it.
        self._robot.relative_dynamics_factor = 1.0
        self._joint_limits = _joint_limits(self.name, self._robot.model_urdf)
        self._contact.clear()
        self._reader = StateReader(self.name, franky, self._robot, self._clock)
        self._reader.start()
        self._await_reading(_FIRST_STATE_S, "state after connecting")

    def _connected(self, connect: Callable[[], Any]) -> tuple[Any, _Scheduling]:
        """Return the robot and the scheduling that libfranka gave its thread. Raises what ``connect`` raises.

        Raises:
            ConnectError: the controller accepts the connection and does not reply; libfranka waits a minute for that.
        """
        results: queue.SimpleQueue[tuple[Any, _Scheduling] | BaseException] = queue.SimpleQueue()

        def work() -> None:
            try:
                with _scheduled():
                    results.put((connect(), _Scheduling.of_this_thread()))
            except BaseException as error:
                results.put(error)

        threading.Thread(target=work, name=f"{self.name} connection", daemon=True).start()
        try:
            result = results.get(timeout=_CONNECT_S)
        except queue.Empty:
            raise ConnectError(
                self.name,
                f"the controller at {self._config.host} does not reply within {_CONNECT_S:g} s",
                hint="restart it in Desk, and close other clients",
            ) from None
        if isinstance(result, BaseException):
            raise result
        return result

    def _close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        self._reader = None
        self._robot = None

    def _present_fault(self) -> DeviceError | None:
        reading = self._newest()
        if reading.mode in _OBEYS and not reading.errors:
            return None
        fault = self._fault(reading)
        return fault if fault.needs is Remedy.RECOVER else None

    def _configure(self) -> None:
        config = self._config
        # Twice the limit for forces: libfranka's thread should brake the arm gently before the controller's hard stop.
        force, torque = 2.0 * config.contact_force_limit_n, config.contact_torque_limit_nm
        try:
            self._robot.set_collision_behavior([_JOINT_TORQUE_NM] * 7, [force] * 3 + [torque] * 3)
            self._set_frames()
            self._ik = self._read_kinematics()
            # An earlier reading would have another tool centre point.
            self._await_reading(_FIRST_STATE_S, "state", after_ms=self._robot.state.time.to_msec())
        except (self._franky.Exception, RuntimeError) as error:
            raise DeviceFault(
                self.name,
                f"refused a parameter: {error}",
                fault_class=FaultClass.CONFIGURATION,
                hint="parameters can be set only while the arm rests without errors",
            ) from None

    def _set_frames(self) -> None:
        state = self._robot.state
        wanted = self._config.flange_to_tcp_mm_deg
        if wanted is not None:
            F_T_tcp = se3.from_euler_mm_deg(wanted)
            NE_T_tcp = np.linalg.solve(state.F_T_NE.matrix, F_T_tcp)
            self._robot.set_ee(NE_T_tcp.T.ravel())
            self._verify_frame("F_T_EE", F_T_tcp)
            self._tool_is_set = True
        # The wrench is measured at the stiffness frame: place it at the tool centre point.
        if np.abs(state.EE_T_K.matrix - np.eye(4)).max() > _FRAME_TOLERANCE:
            self._robot.set_k(np.eye(4).ravel())
            self._verify_frame("EE_T_K", np.eye(4))

    def _read_kinematics(self) -> DifferentialIk:
        """Return the kinematics with the joint limits that the controller reports and its present tool."""
        state = self._robot.state
        tool = se3.to_euler_mm_deg(np.asarray(state.F_T_EE.matrix)).tolist()
        chain = SerialChain(
            self._config.arm().narrowed(np.rad2deg(self._joint_limits)),
            Tool(origin_mm=tuple(tool[:3]), rotation_deg=tuple(tool[3:])),
        )
        require_same_arm(self.name, chain, np.asarray(state.q), np.asarray(state.O_T_EE.matrix))
        return self._kinematics_of(chain)

    def _kinematics_of(self, chain: SerialChain) -> DifferentialIk:
        chain.accelerate()
        return DifferentialIk(chain, self._config.joint_limits.settings(own_controller=True))

    def _verify_frame(self, name: str, wanted: Array) -> None:
        """Raise a fault unless the controller tells the frame soon: a state from before the change may come first."""
        deadline_ns = self._clock.now_ns() + round(_FRAME_S * 1e9)
        while np.abs(np.asarray(getattr(self._robot.state, name).matrix) - wanted).max() > _FRAME_TOLERANCE:
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                raise DeviceFault(
                    self.name,
                    f"{name} did not change as requested",
                    fault_class=FaultClass.CONFIGURATION,
                    needs=Remedy.OPERATOR,
                    hint="check the end effector settings in Desk",
                )
            self._clock.sleep_until_ns(now_ns + _POLL_NS)

    def _activate(self) -> None:
        reading = self._reading("activate", _FRESH_S)
        if reading.mode != "Idle":
            raise self._to_faulted(self._fault(reading))

    def _after_rest(self, policy: DeactivatePolicy) -> None:
        if policy is not DeactivatePolicy.HOLD:
            raise LifecycleError(
                self.name,
                f"deactivate by {policy.value}",
                self.state.value,
                [f"policy {DeactivatePolicy.HOLD.value}"],
                hint="FCI cannot close the brakes: the arm holds itself; lock the joints in Desk",
            )

    def _recover(self, token: OperatorToken) -> None:
        reader = self._open_reader()
        if reader.failure is not None:
            raise reader.failure
        reading = self._await_reading(_FRESH_S, "fresh state")
        if reading.mode in _NEEDS_A_PERSON:
            raise self._fault(reading)
        force = float(np.linalg.norm(reading.wrench[:3]))
        if force > self._config.contact_force_limit_n:
            raise self._contact_fault(f"still in contact with {force:.1f} N")
        try:
            self._robot.recover_from_errors()
        except (self._franky.Exception, RuntimeError) as error:
            raise self._to_device_error(error) from None
        deadline_ns = self._clock.now_ns() + round(_RECOVERY_S * 1e9)
        while (reading := self._await_reading(_FIRST_STATE_S, "state after recovery")).mode != "Idle":
            if self._clock.now_ns() >= deadline_ns:
                raise self._fault(reading)
        reader.clear_abort()
        self._contact.clear()

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        self._reading("move", self._config.state_timeout_s)
        franky, config = self._franky, self._config
        linear, angular = twist_base[:3], twist_base[3:]
        # For the whole time-to-live, including the ramp to the target; a second waypoint brakes harder than the first.
        lives = franky.Duration(max(1, int(ttl_s * 1e3)))
        motion = franky.CartesianVelocityWaypointMotion(
            [
                franky.CartesianVelocityWaypoint(
                    franky.Twist(linear, angular),
                    relative_dynamics_factor=config.dynamics_factor,
                    hold_target_duration=lives,
                    max_total_duration=lives,
                ),
                franky.CartesianVelocityWaypoint(
                    franky.Twist(np.zeros(3), np.zeros(3)), relative_dynamics_factor=config.stop_dynamics_factor
                ),
            ]
        )
        self._start(motion, franky.CartesianVelocityStopMotion, franky.ControlSignalType.CartesianVelocities)

    def _local_ik(self) -> LocalIk:
        return self._ik_at(self._ik, self.joints(self._max_state_age_s).value.q)

    def _begin_stop(self, category: StopCategory) -> None:
        # franky would wait for the next packet of a silent arm at rest.
        if not self._open_reader().in_motion and self._age_s(self._newest()) > _FRESH_S:
            return
        franky = self._franky
        kinds = franky.ControlSignalType
        stops = {
            kinds.CartesianVelocities: franky.CartesianVelocityStopMotion,
            kinds.JointPositions: franky.JointStopMotion,
            kinds.CartesianPose: franky.CartesianStopMotion,
        }
        try:
            running = self._robot.current_control_signal_type
            if running is not None:
                self._move(stops[running](self._config.stop_dynamics_factor))
        except (franky.Exception, RuntimeError) as error:
            raise self._to_device_error(error) from None

    def _start(self, motion: Any, stop_motion: Any, kind: Any) -> None:
        franky = self._franky
        running = self._robot.current_control_signal_type
        if running not in (None, kind):
            raise CommandRejected(
                self.name,
                Rejection.MODE,
                f"still moving by {running.name}",
                value=kind.name,
                hint="stop, wait until it is at rest, then command otherwise",
            )
        measure = franky.Measure
        squared = measure.FORCE_X**2 + measure.FORCE_Y**2 + measure.FORCE_Z**2
        reaction = franky.Reaction(
            squared > self._config.contact_force_limit_n**2, stop_motion(self._config.stop_dynamics_factor)
        )
        contact = self._contact
        reaction.register_callback(lambda state, relative, absolute: contact.set())
        motion.add_reaction(reaction)
        try:
            self._move(motion)
        except (franky.Exception, RuntimeError) as error:
            raise self._to_faulted(self._to_device_error(error)) from None

    def _move(self, motion: Any) -> None:
        with _scheduled(self._control_scheduling):
            self._moved_ns = self._clock.now_ns()
            self._robot.move(motion, asynchronous=True, cutoff_frequency=_NO_FILTER_HZ)

    def _checked_goal(self, what: str, goal: Array, shape: tuple[int, ...], lease: Lease) -> Array:
        target = finite_array(self.name, what, goal, shape)
        self._desk.check(lease)
        if self.state is not Lifecycle.ACTIVE:
            raise CommandRejected(self.name, Rejection.MODE, f"device is {self.state.value}, not active")
        self._reading("move", self._config.state_timeout_s)
        return target

    def _goal_factor(self, speed_fraction: float) -> float:
        if not 0.0 < speed_fraction <= 1.0:
            raise CommandRejected(
                self.name, Rejection.LIMIT, "speed_fraction is not in (0, 1]", value=speed_fraction, limit=1.0
            )
        return min(speed_fraction, self._config.dynamics_factor)

    def _open_reader(self) -> StateReader:
        assert self._reader is not None, "guarded by the lifecycle"
        return self._reader

    def _newest(self) -> Reading:
        reading = self._open_reader().newest
        assert reading is not None, "connect waits for the first reading"
        return reading

    def _age_s(self, reading: Reading) -> float:
        return (self._clock.now_ns() - reading.t_ns) * 1e-9

    def _reading(self, purpose: str, max_age_s: float | None) -> Reading:
        self._require(purpose, *_READABLE)
        self._raise_failure()
        reading = self._newest()
        age_s = self._age_s(reading)
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, reading.device_ms)
        return reading

    def _raise_failure(self) -> None:
        """Raise and latch a failure since the last call; a FAULTED arm stays FAULTED."""
        if self.state is Lifecycle.FAULTED:
            return
        reader, reading = self._open_reader(), self._newest()
        if reader.failure is not None:
            raise self._to_faulted(reader.failure)
        if self._age_s(reading) > self._config.state_timeout_s:
            raise self._to_faulted(TransportTimeout(self.name, "state", self._config.state_timeout_s))
        if self.state is not Lifecycle.ACTIVE:
            return
        if reading.mode not in _OBEYS or reader.aborted is not None:
            raise self._to_faulted(self._fault(reading, reader.aborted))
        if self._contact.is_set():
            raise self._to_faulted(self._contact_fault("contact force limit reached"))

    def _fault(self, reading: Reading, message: str | None = None) -> DeviceFault:
        """Return the fault that the controller reports; ``message``: franky's message when a motion aborted."""
        if reading.mode in _NEEDS_A_PERSON:
            return self._by_table(MODES[reading.mode], reading.mode)
        if names := reading.errors or (reading.last_errors if message else ()):
            return self._by_table(BY_NAME[names[0]], ERRORS.index(BY_NAME[names[0]]))
        if reading.mode in MODES:
            return self._by_table(MODES[reading.mode], reading.mode)
        return DeviceFault(self.name, f"motion aborted: {message}", fault_class=FaultClass.MOTION)

    def _by_table(self, entry: VendorError, code: int | str) -> DeviceFault:
        return DeviceFault(
            self.name,
            entry.name,
            vendor_code=code,
            fault_class=entry.fault_class,
            needs=entry.needs,
            hint=entry.hint,
        )

    def _contact_fault(self, what: str) -> DeviceFault:
        limit = self._config.contact_force_limit_n
        return DeviceFault(
            self.name,
            f"{what} (limit {limit:g} N)",
            fault_class=FaultClass.CONTACT,
            hint="clear the contact by hand, then recover",
        )

    def _to_device_error(self, error: Exception) -> DeviceError:
        if isinstance(error, self._franky.ControlException):
            try:
                return self._fault(self._await_reading(_FRESH_S, "state"), str(error))
            except TransportError as gone:
                return gone
        if isinstance(error, self._franky.CommandException):
            return DeviceFault(self.name, f"command refused: {error}", fault_class=FaultClass.MOTION)
        return DeviceGone(self.name, f"lost the controller: {error}", hint="disconnect and connect again")

    def _await_reading(self, timeout_s: float, what: str, after_ms: int | None = None) -> Reading:
        """Return a reading later than ``after_ms`` of the controller's time, or than the newest one.

        Raises:
            TransportTimeout: none arrived in time.
            DeviceError: the error that ended the reader.
        """
        reader = self._open_reader()
        if after_ms is None:
            after_ms = reader.newest.device_ms if reader.newest else -1
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (reading := reader.newest) is None or reading.device_ms <= after_ms:
            if reader.failure is not None:
                raise reader.failure
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                raise TransportTimeout(self.name, what, timeout_s)
            self._clock.sleep_until_ns(now_ns + _POLL_NS)
        return reading


def _stamped(value: Any, reading: Reading) -> Stamped[Any]:
    return Stamped(value, reading.t_ns, reading.device_ms, reading.device_ms * 1_000_000)


def _joint_limits(device: str, urdf: str) -> Array:
    """Return (7, 2) lower and upper limits in rad from the URDF that the controller provides."""
    try:
        joints = [joint for joint in ElementTree.fromstring(urdf).iter("joint") if joint.get("type") == "revolute"]
        limits = [next(joint.iter("limit")).attrib for joint in joints[:7]]
        return np.array([[float(limit["lower"]), float(limit["upper"])] for limit in limits]).reshape(7, 2)
    except (ElementTree.ParseError, StopIteration, KeyError, ValueError) as error:
        raise ConnectError(device, "the controller's URDF cannot be parsed", [error]) from None


@contextmanager
def _scheduled(policy: _Scheduling | None = None) -> Iterator[None]:
    """Run with scheduling ``policy``, then restore that of this thread."""
    before = _Scheduling.of_this_thread()
    (policy or before).apply()
    try:
        yield
    finally:
        before.apply()


def _has_realtime_kernel() -> bool:
    return _REALTIME_KERNEL.exists() and _REALTIME_KERNEL.read_text().strip() == "1"


def _import_franky(device: str) -> ModuleType:
    try:
        return import_module("franky")
    except ImportError as error:
        raise ConnectError(device, "franky is not installed", [error], hint="pip install touchcell[franka]") from None


def _build(name: str, config: FrankaConfig, context: DriverContext) -> FrankaArm:
    return FrankaArm(name, config, context.clock)


HOME_DEG: Final = (0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0)
"""Ready pose of Franka's own examples."""

_ACCEL_M_S2, _ROT_ACCEL_RAD_S2 = 9.0, 17.0
"""Largest Cartesian accelerations of an FR3 (Franka, "Robot and interface specifications")."""


def behaviour(config: FrankaConfig) -> ArmBehaviour:
    """Return how the arm behaves: it stops with a fraction of its largest accelerations."""
    return ArmBehaviour(
        state_rate_hz=CAPABILITIES.state_rate_hz,
        latency_s=0.003,
        home_deg=HOME_DEG,
        stop_accel_m_s2=config.stop_dynamics_factor * _ACCEL_M_S2,
        stop_rot_accel_rad_s2=config.stop_dynamics_factor * _ROT_ACCEL_RAD_S2,
        max_state_age_s=config.state_timeout_s,
        watchdog_s=_WATCHDOG_S,
    )


SPEC = DriverSpec(
    name="franka",
    summary="Franka FR3 and Research 3 over franky: velocity streaming with a native time-to-live, contact backstop",
    config=FrankaConfig,
    capabilities=CAPABILITIES,
    build=_build,
    behaviour=behaviour,
    extra="franka",
)
