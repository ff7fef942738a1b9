"""Driver for Universal Robots e-Series arms (PolyScope 5) with ur-rtde: twists, joint goals, state, wrench.

Stop mechanisms, fastest first: a zero twist from the caller of ``stop``; the driver's supervision thread once the
time-to-live of a twist has expired; the controller's watchdog after ``1 / watchdog_hz`` of silence; the robot's safety
system and buttons, which alone are safety-rated. ``docs/devices/ur.md`` describes setup and commissioning.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from typing import Annotated, Final, Self

import numpy as np
from pydantic import Field, model_validator

from touchcell.drivers.core.arm import Arm, JointLimitsConfig, LimitsConfig
from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.drivers.core.bench_address import is_this_machine
from touchcell.drivers.core.chain_check import require_same_arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle, OperatorToken
from touchcell.drivers.core.diagnosis import Finding, finding_of
from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    CorruptMessage,
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
    HealthSource,
    JointGoal,
    JointSource,
    NativeWatchdog,
    StopCategory,
    WrenchSource,
)
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.chain import ChainDescription, ChainFile, DifferentialIk, LocalIk, SerialChain, Tool
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.control import ControlLink
from touchcell.drivers.ur.dashboard import dashboard
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode, power_fault, program_fault, safety_fault
from touchcell.drivers.ur.registers import Registers, RtdeWire
from touchcell.drivers.ur.sdk import Upload, upload_control_program
from touchcell.drivers.ur.state import RATE_HZ, Snapshot, StateReader, StateStream
from touchcell.geometry import se3
from touchcell.geometry.types import Array

JOINTS = 6
_MIN_WATCHDOG_HZ = 5.0
_OLDEST_POLYSCOPE = (5, 6)
_KEEPER_PERIOD_S = 0.004
_KEEPER_JOIN_S = 10.0
_CLOCK_WARM_UP_S = 0.03
_FIRST_STATE_S = 2.0
_MODE_CHANGE_S = 20.0
_RECOVER_S = 5.0
_POLL_NS = 2_000_000
_EXPLANATION_NS = 20_000_000
_STILL_TARGET_RAD_S = 1e-6
_STILL_ACTUAL_RAD_S = 0.01
_BEYOND_LIMIT_RAD = 0.1
_SAME_TOOL = 1e-6
_WARM_C, _LOW_VOLTAGE_V = 70.0, 43.0
_TOOL_MM, _CALIBRATION_MM, _TOOL_DEG = 1.0, 20.0, 2.0

_STOPS = frozenset(StopCategory)

Positive = Annotated[float, Field(gt=0.0)]


class UrConfig(DriverConfig):
    """Configuration of a UR arm.

    Attributes:
        host: address of the controller.
        chain: robot model, ``ur3e``, ``ur5e``, ``ur10e`` or a YAML file; checked against the arm on activation.
        flange_to_tcp_mm_deg: [x y z alpha beta gamma] of the tool centre point in the flange's frame, extrinsic xyz.
        limits: speed and acceleration limits of the tool centre point.
        joint_limits: margins to the chain's joint limits and to singularities.
        stop_accel_m_s2: stopping deceleration, m/s2 and rad/s2; at least the accelerations above.
        joint_speed_deg_s, joint_accel_deg_s2: of a joint goal at ``speed_fraction`` 1.
        watchdog_hz: the controller stops the program after ``1 / watchdog_hz`` of silence.
        state_timeout_s: silence of the state stream that is a fault.
        connect_timeout_s: timeout of the controller's first reply.
    """

    host: str = Field(min_length=1)
    flange_to_tcp_mm_deg: tuple[float, float, float, float, float, float]
    chain: ChainFile = "ur5e"
    limits: LimitsConfig = LimitsConfig()
    joint_limits: JointLimitsConfig = JointLimitsConfig()
    stop_accel_m_s2: Annotated[float, Field(gt=0.0, le=10.0)] = 3.0
    joint_speed_deg_s: Annotated[float, Field(gt=0.0, le=180.0)] = 30.0
    joint_accel_deg_s2: Annotated[float, Field(gt=0.0, le=800.0)] = 60.0
    watchdog_hz: Annotated[float, Field(ge=_MIN_WATCHDOG_HZ, le=50.0)] = 10.0
    state_timeout_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1
    connect_timeout_s: Positive = 2.0

    @model_validator(mode="after")
    def _brakes_hard_enough(self) -> Self:
        if self.stop_accel_m_s2 < self.accel:
            raise ValueError(
                f"stop_accel_m_s2 {self.stop_accel_m_s2:g} is less than the acceleration allowed, {self.accel:g}"
            )
        return self

    def emulated_address(self) -> str | None:
        """Return ``host`` if it is this machine."""
        return "host" if is_this_machine(self.host) else None

    def described_chain(self) -> SerialChain:
        """Return the chain of the named model with the configured tool. Raises ConfigError."""
        tool = Tool(origin_mm=self.flange_to_tcp_mm_deg[:3], rotation_deg=self.flange_to_tcp_mm_deg[3:])
        return SerialChain(ChainDescription.named(self.chain), tool)

    @property
    def accel(self) -> float:
        """Acceleration parameter of speedL, m/s2 and rad/s2: the larger of both gate limits."""
        return max(self.limits.tcp_accel_m_s2, self.limits.tcp_rot_accel_rad_s2)


class UrArm(Arm):
    """Driver for a UR arm.

    ``tcp`` and ``wrench`` are of the tool centre point of ``flange_to_tcp_mm_deg``, also before activation, when
    another may be set on the pendant: only a running program may set it. ``health`` warns where they differ.

    One supervision thread, started by ``connect`` and joined by ``disconnect``, checks the state every 4 ms, ends
    expired twists, feeds the watchdog and latches faults. It cannot run while another thread holds the GIL; then the
    watchdog stops the arm.

    Args:
        name: the device's name in the cell.
        config: configuration of the arm.
        clock: injected clock.
        upload: uploads the control program.
    """

    def __init__(self, name: str, config: UrConfig, clock: Clock, upload: Upload = upload_control_program) -> None:
        super().__init__(
            name, clock, config.limits.build(), stop_categories=_STOPS, max_state_age_s=config.state_timeout_s
        )
        self._config = config
        self._upload = upload
        self._flange_to_tcp = _pose_vector(se3.from_euler_mm_deg(np.array(config.flange_to_tcp_mm_deg)))
        self._chain = config.described_chain()
        self._chain.accelerate()
        self._ik = DifferentialIk(self._chain, config.joint_limits.settings(own_controller=True))
        # All UR joints but a UR3e's endless wrist turn by a full turn; a little beyond where software limits are wider.
        ends = np.maximum(np.abs(self._chain.lower), np.abs(self._chain.upper))
        self._max_joint_rad = np.maximum(ends, 2.0 * math.pi) + _BEYOND_LIMIT_RAD
        self._stream: StateStream | None = None
        self._reader: StateReader | None = None
        self._link: ControlLink | None = None
        self._supervision_thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._supervised_from_seq: int | None = None
        self._power_off_by: StopCategory | None = None
        self._model = ""
        self._tool_warning = ""
        self._proven_watchdog_s: float | None = None
        self._ttl_stops = 0
        self._dropping = threading.Lock()
        self._program_is_ours = False

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return pose and twist of the tool centre point. Raises StaleData if older than ``max_age_s``."""
        snapshot = self._newest(max_age_s)
        T_base_tcp = self._tool_pose_of(snapshot)
        lever_m = T_base_tcp[:3, 3] - snapshot.tcp_pose[:3]
        twist = snapshot.tcp_speed.copy()
        twist[:3] += np.cross(twist[3:], lever_m)
        state = TcpState(T_base_tcp, twist)
        return Stamped(state, snapshot.t_ns, snapshot.seq, snapshot.t_device_ns)

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return joint angles and speeds. Raises StaleData if older than ``max_age_s``."""
        snapshot = self._newest(max_age_s)
        state = JointState(snapshot.q.copy(), snapshot.qd.copy())
        return Stamped(state, snapshot.t_ns, snapshot.seq, snapshot.t_device_ns)

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (6,) [force N, torque N m] at the tool centre point along base axes, compensated by the controller."""
        snapshot = self._newest(max_age_s)
        wrench = snapshot.tcp_force.copy()
        wrench[3:] -= np.cross(self._tool_pose_of(snapshot)[:3, 3] - snapshot.tcp_pose[:3], wrench[:3])
        return Stamped(wrench, snapshot.t_ns, snapshot.seq, snapshot.t_device_ns)

    def at_rest(self) -> bool:
        """Return whether measured and target joint speeds are zero. Raises TransportError if the state is stale."""
        snapshot = self._newest(None)
        age_s = snapshot.age_s(self._clock.now_ns())
        if age_s > self._config.state_timeout_s:
            raise self._silence_fault(snapshot, age_s)
        link = self._link
        return (
            float(np.abs(snapshot.qd_target).max()) < _STILL_TARGET_RAD_S
            and float(np.abs(snapshot.qd).max()) < _STILL_ACTUAL_RAD_S
            and not (link is not None and link.goal_running())
        )

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (6,) rad in a straight line in joint space; the arm must be at rest.

        The goal has no time-to-live, but ends with everything else when the host is silent.

        Raises:
            CommandRejected: the goal was rejected; nothing was sent.
        """
        target = self._admitted_joint_goal(q, lease, speed_fraction, self._chain.lower, self._chain.upper, JOINTS)
        link = self._link
        if link is None:
            raise CommandRejected(self.name, Rejection.MODE, "the control program is not running")
        if not self.at_rest():
            raise CommandRejected(self.name, Rejection.MODE, "the arm is moving", hint="stop it first")
        speed = math.radians(self._config.joint_speed_deg_s) * speed_fraction
        accel = math.radians(self._config.joint_accel_deg_s2)
        self._attempt(lambda: link.move_joints(target, speed, accel, self._config.stop_accel_m_s2))

    def kinematics(self) -> DifferentialIk:
        """Return the differential inverse kinematics of the arm."""
        return self._ik

    def watchdog_s(self) -> float:
        """Return the controller's watchdog period, tested at activation. Raises LifecycleError before activation."""
        if self._proven_watchdog_s is None:
            raise LifecycleError(self.name, "read the watchdog's period", self.state.value, [Lifecycle.ACTIVE.value])
        return self._proven_watchdog_s

    def health(self) -> dict[str, float | int | str | bool]:
        """Return modes, age of the state, dropped packets, temperatures, speed slider, watchdog."""
        snapshot = self._newest(None)
        reader = self._opened()
        link = self._link
        readings: dict[str, float | int | str | bool] = {
            "model": self._model,
            "robot_mode": snapshot.robot_mode.name,
            "safety_mode": snapshot.safety_mode.name,
            "runtime_state": snapshot.runtime_state.name,
            "connected": reader.connected,
            "state_age_s": snapshot.age_s(self._clock.now_ns()),
            "corrupt_packets": reader.corrupt,
            "out_of_order_packets": reader.out_of_order,
            "max_joint_temperature_c": float(snapshot.temperatures.max()),
            "speed_fraction": snapshot.speed_fraction,
            "tool_set": link is not None,
            "watchdog_hz": self._config.watchdog_hz,
            "watchdog_trip_s": link.trip_s if link is not None else 0.0,
            "ttl_stops": self._ttl_stops + (link.ttl_stops if link is not None else 0),
            "pendant_tool_differs": bool(self._tool_warning),
        }
        if math.isfinite(snapshot.voltage_v):
            readings["robot_voltage_v"] = snapshot.voltage_v
        if self._tool_warning:
            readings["warning"] = self._tool_warning
        return readings

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong with the controller and its settings; claims the registers for a moment, writes none."""
        snapshot = self._fresh()
        for check, reports in (
            (self._require_safe, ("ur_modern_driver 353", "airo-mono 143", "Universal_Robots_Client_Library 58")),
            (self._require_remote_control, ("Universal_Robots_ROS2_Driver 181",)),
            (self._require_no_program, ("Universal_Robots_ROS_Driver 296",)),
            (self._require_registers, ("Universal_Robots_ROS_Driver 28",)),
            (self._require_chain, ("Universal_Robots_ROS_Driver 317",)),
        ):
            try:
                check()
            except DeviceError as error:
                yield finding_of(error, *reports)
        if self._tool_warning:
            remedy = "set the same tool and its payload on the pendant (Installation > General > TCP)"
            yield Finding(self._tool_warning, remedy, ("Universal_Robots_ROS_Driver 557",), is_fault=False)
        if 0.0 < snapshot.speed_fraction < 1.0:
            what = f"the speed slider is at {snapshot.speed_fraction:.0%}: every motion is slower by that factor"
            yield Finding(what, "move it to 100 %", ("Universal_Robots_ROS_Driver 737",), is_fault=False)
        if (hottest_c := float(snapshot.temperatures.max())) >= _WARM_C:
            yield Finding(f"a joint is at {hottest_c:.0f} degrees Celsius", "let it cool down", (), is_fault=False)
        if snapshot.voltage_v < _LOW_VOLTAGE_V:
            yield Finding(f"the arm's supply is at {snapshot.voltage_v:.1f} V, not 48 V", "have the controller checked")
        if snapshot.robot_mode is not RobotMode.RUNNING:
            what = f"the arm is {snapshot.robot_mode.name}"
            yield Finding(what, "activate powers it on and releases its brakes", (), is_fault=False)

    def _require_registers(self) -> None:
        Registers(self.name, self._config.host, self._config.connect_timeout_s, self._clock).close()

    def _require_chain(self) -> None:
        snapshot = self._fresh()
        if snapshot.tcp_offset is not None:
            # Only of the flange: the tool is compared by itself.
            require_same_arm(self.name, self._chain, snapshot.q, self._tool_pose_of(snapshot))

    def _tool_pose_of(self, snapshot: Snapshot) -> Array:
        """Return the pose (4, 4) of the configured tool centre point, whatever tool is set in the controller."""
        T_base_tcp = _pose(snapshot.tcp_pose)
        offset = snapshot.tcp_offset
        if offset is None:
            # An older controller: ours once the program has set it, and until then where the chain puts it.
            return T_base_tcp if self._link is not None else np.asarray(self._chain.forward(snapshot.q))
        if np.allclose(offset, self._flange_to_tcp, rtol=0.0, atol=_SAME_TOOL):
            return T_base_tcp
        return np.asarray(T_base_tcp @ se3.inverse(_pose(offset)) @ _pose(self._flange_to_tcp))

    def _compare_tools(self, snapshot: Snapshot) -> str:
        """Return how the tool set on the pendant differs from the configured one; empty if it hardly does."""
        apart = se3.compose(se3.inverse(self._tool_pose_of(snapshot)), _pose(snapshot.tcp_pose))
        away_mm = 1e3 * float(np.linalg.norm(apart[:3, 3]))
        turned_deg = math.degrees(float(np.linalg.norm(se3.log(apart)[3:])))
        exact = snapshot.tcp_offset is not None
        if away_mm <= (_TOOL_MM if exact else _CALIBRATION_MM) and turned_deg <= _TOOL_DEG:
            return ""
        return (
            f"the tool on the pendant is {away_mm:.1f} mm and {turned_deg:.1f} deg from flange_to_tcp_mm_deg, which is "
            "the one that is used; payload and safety limits are still those of the pendant's"
        )

    def _open(self) -> None:
        if not _is_installed("rtde_control"):
            raise ConnectError(self.name, "ur-rtde is not installed", hint="pip install touchcell[ur]")
        version = _ask_version(self.name, self._config.host, self._config.connect_timeout_s, self._clock)
        if not _OLDEST_POLYSCOPE <= version[:2] < (6, 0):
            raise ConnectError(
                self.name,
                f"PolyScope {'.'.join(map(str, version))} is not supported",
                hint="this driver needs PolyScope 5.6 or later of version 5",
            )
        self._start_receiving()
        with dashboard(self.name, self._config.host, self._clock) as client:
            self._tool_warning = self._compare_tools(self._newest(None))
            self._model = f"{client.ask('get robot model')}, {client.ask('PolyscopeVersion')}"
        self._ending.clear()
        self._supervision_thread = threading.Thread(target=self._supervise, name=f"{self.name} keeper", daemon=True)
        self._supervision_thread.start()

    def _close(self) -> None:
        self._ending.set()
        keeper, self._supervision_thread = self._supervision_thread, None
        if keeper is not None:
            keeper.join(_KEEPER_JOIN_S)
        # The thread may have latched a fault while the state was already DISCONNECTED.
        self._forget_state()
        self._drop_program()
        if self._power_off_by is not None:
            with suppress(DeviceError), dashboard(self.name, self._config.host, self._clock) as client:
                client.ask("power off")
        self._power_off_by = None
        self._stop_receiving()
        self._reader = None

    def _present_fault(self) -> DeviceError | None:
        snapshot = self._fresh()
        fault = safety_fault(self.name, snapshot.safety_mode, snapshot.safety_bits)
        return fault if fault is not None and fault.needs is Remedy.RECOVER else None

    def _configure(self) -> None:
        self._require_safe()

    def _activate(self) -> None:
        self._require_safe()
        if self._power_off_by is not None:
            raise LifecycleError(self.name, "activate", "being powered off", [Lifecycle.READY.value])
        self._require_remote_control()
        self._require_no_program()
        self._power_on()
        _ask_version(self.name, self._config.host, self._config.connect_timeout_s, self._clock)
        link = ControlLink(self.name, self._config.host, self._clock, self._config.watchdog_hz, self._upload)
        self._link = link
        self._program_is_ours = True
        try:
            link.open(self._flange_to_tcp)
            snapshot = self._await(
                lambda state: state.runtime_state is RuntimeState.PLAYING, _FIRST_STATE_S, "state of the program"
            )
            require_same_arm(self.name, self._chain, snapshot.q, _pose(snapshot.tcp_pose))
        except BaseException:
            self._drop_program()
            raise
        self._proven_watchdog_s = 1.0 / self._config.watchdog_hz
        self._supervised_from_seq = snapshot.seq

    def _after_rest(self, policy: DeactivatePolicy) -> None:
        if policy is DeactivatePolicy.PARK_THEN_OFF:
            raise LifecycleError(
                self.name,
                "park then power off",
                self.state.value,
                [p.value for p in DeactivatePolicy if p is not policy],
                hint="no park pose here: send a joint goal, then deactivate with BRAKE",
            )
        self._drop_program()
        if policy in (DeactivatePolicy.BRAKE, DeactivatePolicy.OFF):
            self._power_off()

    def _recover(self, token: OperatorToken) -> None:
        self._drop_program()
        if not self._opened().connected:
            _ask_version(self.name, self._config.host, self._config.connect_timeout_s, self._clock)
            # The old reader serves the supervision thread until the new one has received a state.
            self._start_receiving()
        self._opened().reset_statistics()
        if self._program_is_ours:
            self._end_program()
        if self._fresh().safety_mode is SafetyMode.PROTECTIVE_STOP:
            self._unlock()
        self._require_safe()

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        link = self._link
        try:
            if link is None or self.state is not Lifecycle.ACTIVE:
                raise CommandRejected(self.name, Rejection.MODE, "the arm has just been powered off or disconnected")
            expires_ns = now_ns + round(ttl_s * 1e9)
            link.speed(twist_base, self._config.accel, self._config.stop_accel_m_s2, expires_ns)
        except CommandRejected:
            self._gate.reset()
            raise
        except DeviceError as error:
            raise self._to_faulted(self._explain(error)) from None

    def _project_to_feasible(self, twist_base: Array) -> tuple[Array, tuple[Adjustment, ...]]:
        # The controller scales every motion by the slider on the pendant.
        fraction = self._newest(None).speed_fraction
        return twist_base, () if fraction >= 1.0 else (Adjustment("speed slider", 1.0, fraction),)

    def _local_ik(self) -> LocalIk:
        return self._ik_at(self._ik, self.joints(self._max_state_age_s).value.q)

    def _begin_stop(self, category: StopCategory) -> None:
        link = self._link
        if category is not StopCategory.STOP_AND_HOLD:
            self._supervised_from_seq = None
            self._power_off_by = category
        if link is not None:
            self._attempt(lambda: link.halt(self._config.stop_accel_m_s2))

    def _supervise(self) -> None:
        while not self._ending.wait(_KEEPER_PERIOD_S):
            try:
                self._supervise_once()
            except DeviceError as error:
                self._report(error)
            except Exception as error:
                # The thread must live on: it alone ends expired twists, drops the program and removes power.
                self._report(
                    DeviceFault(
                        self.name,
                        f"supervision failed: {error!r}",
                        fault_class=FaultClass.INTERNAL,
                        needs=Remedy.SERVICE,
                        hint="the arm has been stopped; disconnect and report this",
                    )
                )

    def _supervise_once(self) -> None:
        # Read the state before the flag: a program seen stopped after the flag was raised is a fault.
        snapshot = self._newest(None)
        supervised_from_seq = self._supervised_from_seq
        trouble = self._find_fault(snapshot, supervised_from_seq)
        link = self._link
        if trouble is None and link is not None:
            try:
                link.tick()
            except DeviceError as error:
                trouble = self._explain(error) if self._supervised_from_seq is not None else None
        if trouble is not None:
            self._report(trouble)
        if self.state is Lifecycle.FAULTED:
            self._drop_program()
        if self._power_off_by is not None:
            self._react_to_power_off()

    def _report(self, trouble: DeviceError) -> None:
        # What lasts is found again after a recovery: reported while it goes on, it would make the recovery fail.
        if self.state not in (Lifecycle.DISCONNECTED, Lifecycle.FAULTED):
            self._to_faulted(trouble)

    def _find_fault(self, snapshot: Snapshot, supervised_from_seq: int | None) -> DeviceError | None:
        reader = self._opened()
        age_s = snapshot.age_s(self._clock.now_ns())
        if age_s > self._config.state_timeout_s or not reader.connected:
            return self._silence_fault(snapshot, age_s)
        if reader.drops_too_many:
            return CorruptMessage(
                self.name, f"too many bad state packets: {reader.corrupt} corrupt, {reader.out_of_order} out of order"
            )
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            fault = safety_fault(self.name, snapshot.safety_mode, snapshot.safety_bits)
            if fault is not None:
                return fault
        if self.state is Lifecycle.ACTIVE and supervised_from_seq is not None and snapshot.seq >= supervised_from_seq:
            return (
                power_fault(self.name, snapshot.robot_mode)
                or program_fault(self.name, snapshot.runtime_state)
                or self._slider_fault(snapshot)
            )
        return None

    def _explain(self, error: DeviceError) -> DeviceError:
        """Return the fault in the state that explains a rejected command, up to one packet late; else ``error``."""
        deadline_ns = self._clock.now_ns() + _EXPLANATION_NS
        while (trouble := self._find_fault(self._newest(None), self._supervised_from_seq)) is None:
            if self._clock.now_ns() > deadline_ns:
                return error
            self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)
        return trouble

    def _silence_fault(self, snapshot: Snapshot, age_s: float) -> DeviceError:
        error: DeviceError
        if self._opened().connected:
            error = TransportTimeout(
                self.name, "good state", self._config.state_timeout_s, hint="the controller or the network hangs"
            )
        else:
            error = DeviceGone(self.name, "lost the RTDE state connection", hint="check the cable and the controller")
        error.__cause__ = StaleData(self.name, age_s, self._config.state_timeout_s, snapshot.seq)
        return error

    def _react_to_power_off(self) -> None:
        with suppress(DeviceError):
            if self._power_off_by is StopCategory.STOP_THEN_REMOVE_POWER and not self.at_rest():
                return
            with dashboard(self.name, self._config.host, self._clock) as client:
                client.ask("power off")
        self._drop_program()
        self._power_off_by = None

    def _drop_program(self) -> None:
        self._supervised_from_seq = None
        self._proven_watchdog_s = None
        with self._dropping:
            link, self._link = self._link, None
            if link is not None:
                link.close()
                self._ttl_stops += link.ttl_stops

    def _start_receiving(self) -> None:
        self._stop_receiving()
        try:
            stream = StateStream(self.name, self._config.host, self._config.connect_timeout_s, self._clock)
        except (OSError, TransportError) as error:
            raise DeviceGone(self.name, f"RTDE state of {self._config.host}: {error}") from error
        self._stream = stream
        reader = StateReader(stream, self._clock, self._max_joint_rad)
        deadline_ns = self._clock.now_ns() + round(_FIRST_STATE_S * 1e9)
        warm_ns = self._clock.now_ns() + round(_CLOCK_WARM_UP_S * 1e9)
        while reader.poll() is None or self._clock.now_ns() < warm_ns:
            if self._clock.now_ns() > deadline_ns:
                hint = f"{reader.last_corrupt}: is `chain` this arm's model?" if reader.last_corrupt else ""
                raise TransportTimeout(self.name, "good state", _FIRST_STATE_S, hint=hint)
            self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS // 4)
        self._reader = reader

    def _stop_receiving(self) -> None:
        # The reader stays until there is another: the supervision thread may be reading.
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def _opened(self) -> StateReader:
        if self._reader is None:
            raise LifecycleError(self.name, "read", self.state.value, ["connected"])
        return self._reader

    def _newest(self, max_age_s: float | None) -> Snapshot:
        snapshot = self._opened().poll()
        assert snapshot is not None, "connect waits for the first state"
        if max_age_s is not None:
            age_s = snapshot.age_s(self._clock.now_ns())
            if age_s > max_age_s:
                raise StaleData(self.name, age_s, max_age_s, snapshot.seq)
        return snapshot

    def _fresh(self) -> Snapshot:
        snapshot = self._newest(None)
        age_s = snapshot.age_s(self._clock.now_ns())
        if age_s > self._config.state_timeout_s:
            raise self._silence_fault(snapshot, age_s)
        return snapshot

    def _require_safe(self) -> None:
        snapshot = self._fresh()
        fault = safety_fault(self.name, snapshot.safety_mode, snapshot.safety_bits)
        if fault is not None:
            raise fault
        fault = self._slider_fault(snapshot)
        if fault is not None:
            raise fault

    def _slider_fault(self, snapshot: Snapshot) -> DeviceFault | None:
        if snapshot.speed_fraction > 0.0:
            return None
        return DeviceFault(
            self.name,
            "the speed slider is at zero",
            vendor_code="speed slider",
            fault_class=FaultClass.CONFIGURATION,
            needs=Remedy.OPERATOR,
            hint="move the slider on the pendant; twists are scaled by it",
        )

    def _require_remote_control(self) -> None:
        with dashboard(self.name, self._config.host, self._clock) as client:
            if client.ask("is in remote control") != "true":
                raise DeviceFault(
                    self.name,
                    "the pendant is in local control",
                    fault_class=FaultClass.CONFIGURATION,
                    needs=Remedy.OPERATOR,
                    hint="enable remote control in the settings and choose Remote at the top of the pendant",
                )

    def _require_no_program(self) -> None:
        snapshot = self._fresh()
        if snapshot.runtime_state is not RuntimeState.STOPPED:
            raise DeviceFault(
                self.name,
                f"another program is {snapshot.runtime_state.name}",
                vendor_code=f"runtime_state {int(snapshot.runtime_state)}",
                fault_class=FaultClass.CONFIGURATION,
                needs=Remedy.OPERATOR,
                hint="stop it on the pendant; this driver does not end foreign programs",
            )

    def _power_on(self) -> None:
        if self._fresh().robot_mode is RobotMode.RUNNING:
            return
        with dashboard(self.name, self._config.host, self._clock) as client:
            client.ask("power on")
            self._await(lambda state: state.robot_mode in (RobotMode.IDLE, RobotMode.RUNNING), _MODE_CHANGE_S, "power")
            client.ask("brake release")
            self._await(lambda state: state.robot_mode is RobotMode.RUNNING, _MODE_CHANGE_S, "release of the brakes")

    def _power_off(self) -> None:
        with dashboard(self.name, self._config.host, self._clock) as client:
            client.ask("power off")
        self._await(lambda state: state.robot_mode is RobotMode.POWER_OFF, _MODE_CHANGE_S, "power-off")

    def _end_program(self) -> None:
        # It may have survived the fault if the controller was unreachable then.
        if self._fresh().runtime_state is not RuntimeState.STOPPED:
            with dashboard(self.name, self._config.host, self._clock) as client:
                client.ask("stop")
        self._await(lambda state: state.runtime_state is RuntimeState.STOPPED, _RECOVER_S, "end of the program")
        self._program_is_ours = False

    def _unlock(self) -> None:
        with dashboard(self.name, self._config.host, self._clock) as client:
            reply = client.ask("unlock protective stop")
        if not reply.startswith("Protective stop releasing"):
            raise DeviceFault(
                self.name,
                f"the protective stop remains: {reply}",
                fault_class=FaultClass.CONTACT,
                needs=Remedy.RECOVER,
                hint="inspect the arm, and wait until 5 s after the stop",
            )
        self._await(
            lambda state: state.safety_mode is not SafetyMode.PROTECTIVE_STOP,
            _RECOVER_S,
            "release of the protective stop",
        )

    def _await(self, condition: Callable[[Snapshot], bool], timeout_s: float, what: str) -> Snapshot:
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not condition(snapshot := self._fresh()):
            if self._clock.now_ns() > deadline_ns:
                raise TransportTimeout(self.name, what, timeout_s)
            self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)
        return snapshot


def _ask_version(device: str, host: str, timeout_s: float, clock: Clock) -> tuple[int, int, int, int]:
    """Read the controller's version by a separate connection: ur-rtde's constructors block on a frozen controller."""
    try:
        wire = RtdeWire(device, host, timeout_s, clock)
        try:
            if not ur_codec.parse_accepted(wire.ask(ur_codec.version_request()).payload):
                raise ConnectError(device, f"RTDE of {host} does not support version {ur_codec.PROTOCOL_VERSION}")
            answer = wire.ask(ur_codec.Packet(ur_codec.PacketType.GET_URCONTROL_VERSION))
            return ur_codec.parse_controller_version(answer.payload)
        finally:
            wire.close()
    except (OSError, TransportError) as error:
        raise ConnectError(
            device,
            f"no RTDE at {host}:{ur_codec.PORT}",
            [error],
            hint=f"is {host} the controller, powered and reachable?",
        ) from error


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ValueError:
        # Imported, without a record of where from.
        return False


def _pose_vector(T: Array) -> Array:
    """Return Universal Robots' pose (6,) [x y z rx ry rz] of a pose (4, 4): metres and a rotation vector."""
    return np.concatenate([T[:3, 3], se3.log(T)[3:]])


def _pose(vector: Array) -> Array:
    """Return pose (4, 4) of Universal Robots' [x y z rx ry rz]."""
    T = se3.exp(np.concatenate([np.zeros(3), vector[3:]]))
    T[:3, 3] = vector[:3]
    return T


def _build(name: str, config: UrConfig, context: DriverContext) -> UrArm:
    return UrArm(name, config, context.clock)


HOME_DEG: Final = (0.0, -90.0, -90.0, -90.0, 90.0, 0.0)
"""Home of a new e-Series arm: upper arm upright, tool down (Universal Robots, user manual, "Home")."""


def behaviour(config: UrConfig) -> ArmBehaviour:
    """Return how the arm behaves: speedL with the configured deceleration, a watchdog in the controller."""
    return ArmBehaviour(
        state_rate_hz=RATE_HZ,
        # One control period until the program reads its registers, one until the arm moves.
        latency_s=2.0 / RATE_HZ,
        home_deg=HOME_DEG,
        stop_accel_m_s2=config.stop_accel_m_s2,
        stop_rot_accel_rad_s2=config.stop_accel_m_s2,
        max_state_age_s=config.state_timeout_s,
        watchdog_s=1.0 / config.watchdog_hz,
    )


SPEC = DriverSpec(
    name="ur",
    summary="Universal Robots e-Series (PolyScope 5) over ur-rtde",
    config=UrConfig,
    capabilities=Capabilities(
        kind="arm",
        provides=SERVO_ARM | {JointSource, WrenchSource, JointGoal, HealthSource, NativeWatchdog},
        state_rate_hz=RATE_HZ,
        min_command_rate_hz=10.0,
        command_latency_s=0.0001,
        stop_categories=_STOPS,
        max_watchdog_s=1.0 / _MIN_WATCHDOG_HZ,
        has_brakes=True,
        falls_on_power_loss=False,
    ),
    build=_build,
    behaviour=behaviour,
    extra="ur",
)
