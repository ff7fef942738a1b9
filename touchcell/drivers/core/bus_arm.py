"""Base class of arms whose motors share a bus and whose Cartesian control runs on the host.

A control loop in a thread of the driver sends setpoints, collects replies, and latches faults.
"""

from __future__ import annotations

import logging
import threading
from abc import abstractmethod
from collections import deque
from contextlib import suppress
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from touchcell.drivers.core.arm import JointLimitsConfig, LimitsConfig
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import DeactivatePolicy
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
    TransportTimeout,
)
from touchcell.drivers.core.joint_arm import JointArm
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import JointState, Stamped
from touchcell.drivers.core.spec import DriverConfig
from touchcell.drivers.kinematics.chain import ChainDescription, ChainFile, DifferentialIk, SerialChain, Tool
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.logs import OncePerCause

_logger = logging.getLogger(__name__)

Positive = Annotated[float, Field(gt=0.0)]

_REST_SPEED_RAD_S = 0.03
_FIRST_SAMPLE_S = 1.0
_MISS_WINDOW = 50
_PARK_SPEED_FRACTION = 0.5


class BusArmConfig(DriverConfig):
    """Common configuration keys of bus arms. ``chain``: name of a shipped chain description or path of a YAML file.

    A joint that deviates by ``tracking_error_deg`` from its setpoint, a reply older than ``max_silence_s``, or more
    than ``max_missed_fraction`` of the cycles without all replies is a fault.

    Attributes:
        chain: name of a chain description that ships, or path of a YAML or URDF file.
        tool: tool on the flange.
        rate_hz: cycles of the bus per second.
        max_silence_s: oldest reply of a motor; an older one is a fault.
        max_missed_fraction: share of cycles without all replies; more is a fault.
        tracking_error_deg: largest deviation of a joint from its setpoint; more is a fault.
        limits: limits of the tool centre point.
        joint_limits: how joints are kept within their ranges.
        park_deg: joint angles at which the arm may be switched off; none where it has no such pose.
        park_tolerance_deg: how near to that pose counts as parked.
        on_disconnect: what an energised arm does when it is disconnected.
    """

    chain: ChainFile
    tool: Tool = Tool()
    rate_hz: Positive
    max_silence_s: Positive = 0.1
    max_missed_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.25
    tracking_error_deg: Positive = 8.0

    limits: LimitsConfig = LimitsConfig()
    joint_limits: JointLimitsConfig = JointLimitsConfig()

    park_deg: tuple[float, ...] | None = None
    park_tolerance_deg: Positive = 5.0
    on_disconnect: Literal["hold", "park_then_off"] = "hold"

    @property
    @abstractmethod
    def joint_count(self) -> int:
        """Number of configured motors."""

    @model_validator(mode="after")
    def _can_park(self) -> Self:
        if self.park_deg is not None and len(self.park_deg) != self.joint_count:
            raise ValueError(f"park_deg has {len(self.park_deg)} angles for {self.joint_count} joints")
        if self.on_disconnect == "park_then_off" and self.park_deg is None:
            raise ValueError("on_disconnect: park_then_off needs park_deg")
        return self

    def described_chain(self) -> SerialChain:
        """Return the named chain with the configured tool. Raises ConfigError, also where joints and motors differ."""
        return SerialChain(self.named_chain("chain"), self.tool)

    def named_chain(self, key: str) -> ChainDescription:
        """Return the chain description of the arm.

        Raises:
            ConfigError: unknown chain, or its number of joints differs from the number of motors under ``key``.
        """
        found = ChainDescription.named(self.chain)
        if len(found.joints) != self.joint_count:
            raise ConfigError(f"chain {found.name!r} has {len(found.joints)} joints", key=key, value=self.joint_count)
        return found

    def require_park_within(self, chain: ChainDescription) -> None:
        """Check that the park pose is within the joint limits. Raises ConfigError."""
        for index, (joint, angle_deg) in enumerate(zip(chain.joints, self.park_deg or (), strict=False)):
            if not joint.lower_deg <= angle_deg <= joint.upper_deg:
                raise ConfigError(
                    f"is outside the limits of joint {joint.name!r}", key=f"park_deg[{index}]", value=angle_deg
                )


class BusArm(JointArm):
    """An arm on a bus. Subclasses implement the bus, the cycle, and how motors are switched off.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: real time; the loop is a thread and cannot run on a virtual clock.
        chain: kinematic chain of the arm.
    """

    _config: BusArmConfig

    def __init__(self, name: str, config: BusArmConfig, clock: Clock, chain: SerialChain) -> None:
        super().__init__(name, clock, config.limits.build(), max_state_age_s=config.max_silence_s)
        self._config = config
        self._chain = chain
        chain.accelerate()
        self._ik = DifferentialIk(chain, config.joint_limits.settings())
        self._setpoint = JointSetpoint(chain, self._ik, self.limits)
        self._thread: threading.Thread | None = None
        self._lost_bus: DeviceGone | None = None
        self._closing = threading.Event()
        # Held by the loop for one cycle, and by any code that needs the bus or changes what the loop sends.
        self._lock = threading.RLock()
        self._reset_state()

    def _reset_state(self) -> None:
        """Discard samples and faults of an earlier connection."""
        self._latched_fault: DeviceError | None = None
        self._lost_bus = None
        self._enabled = [False] * self._chain.joint_count
        self._joints: Stamped[JointState] | None = None
        self._seq = 0
        self._implausible = 0
        self._overruns = 0
        self._delays = OncePerCause(_logger)
        self._latest_s = 0.0
        self._missed: deque[bool] = deque(maxlen=_MISS_WINDOW)
        self._follows_until_ns = 0

    def at_rest(self) -> bool:
        """Return whether setpoint and joints are at standstill, within the resolution of the measured joint speeds."""
        sample = self._joints
        fresh = sample is not None and sample.age_s(self._clock.now_ns()) <= self._config.max_silence_s
        # A twist accepted just now moves the setpoint in the next cycle only.
        due = self._clock.now_ns() < self._follows_until_ns
        if sample is None or not fresh or due or self._setpoint.moving:
            return False
        return bool((np.abs(sample.value.dq) <= _REST_SPEED_RAD_S).all())

    def health(self) -> dict[str, float | int | str | bool]:
        """Return counters of the loop and the active limits."""
        return {
            "implausible": self._implausible,
            "overruns": self._overruns,
            "latest_cycle_s": self._latest_s,
            "enabled": sum(self._enabled),
            "limited_by": ", ".join(adjustment.limit for adjustment in self._setpoint.adjustments),
        }

    @abstractmethod
    def _open_bus(self) -> None:
        """Open the bus; the loop is not running yet."""

    @abstractmethod
    def _close_bus(self) -> None:
        """Close the bus; the loop has ended."""

    @abstractmethod
    def _reopen_bus(self) -> None:
        """Open the bus again, and see which motors are still enabled. The lock is held. Raises ConnectError."""

    @abstractmethod
    def _cycle(self, now_ns: int, dt_s: float, until_ns: int) -> None:
        """Send setpoints ``dt_s`` after the previous ones and collect replies until ``until_ns``. The lock is held."""

    @abstractmethod
    def _switch_off(self) -> None:
        """Switch all motors off."""

    def _repeat_commands(self) -> None:
        """Keep the motors where they are after a cycle that failed, where silence would disable them."""

    def _hold(self) -> None:
        """Let the motors hold their position by themselves, where supported."""

    def _open(self) -> None:
        self._reset_state()
        self._open_bus()
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, name=f"{self.name} bus", daemon=True)
        self._thread.start()
        deadline_ns = self._clock.now_ns() + round(_FIRST_SAMPLE_S * 1e9)
        while self._joints is None:
            if self._clock.now_ns() >= deadline_ns or not self._thread.is_alive():
                causes = [self._latched_fault] if self._latched_fault is not None else []
                raise ConnectError(self.name, f"no complete state within {_FIRST_SAMPLE_S:g} s", causes)
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def _close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close_bus()

    def _require_loop(self) -> None:
        if self._thread is None or not self._thread.is_alive():
            raise DeviceGone(self.name, "its bus loop has ended", hint="disconnect and connect again")
        if self._lost_bus is not None:
            self._return_to_bus()

    def _return_to_bus(self) -> None:
        """Open the bus again after its adapter was unplugged; wait for a state of all joints. Raises DeviceError."""
        with self._lock:
            try:
                self._reopen_bus()
            except ConnectError as error:
                what = error.message.removeprefix(f"{self.name}: ")
                raise DeviceGone(self.name, f"has not returned: {what}", hint=error.hint) from error
            self._missed.clear()
            returned_ns = self._clock.now_ns()
        deadline_ns = self._clock.now_ns() + round(_FIRST_SAMPLE_S * 1e9)
        # The loop notes that a cycle has succeeded.
        while self._lost_bus is not None or self._joints is None or self._joints.t_ns < returned_ns:
            if self._clock.now_ns() >= deadline_ns:
                raise TransportTimeout(self.name, "complete state", _FIRST_SAMPLE_S)
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def _after_rest(self, policy: DeactivatePolicy) -> None:
        if policy is DeactivatePolicy.BRAKE:
            raise LifecycleError(
                self.name, "brake", self.state.value, ["an arm with brakes"], hint="choose hold or park"
            )
        if policy is DeactivatePolicy.HOLD:
            self._hold()
            return
        if policy is DeactivatePolicy.PARK_THEN_OFF:
            self._park()
        if not self._parked():
            raise LifecycleError(
                self.name, "switch off", self.state.value, ["its park pose"], hint="without power this arm falls"
            )
        self._switch_off()

    def _disconnect_policy(self) -> DeactivatePolicy:
        return DeactivatePolicy(self._config.on_disconnect)

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        if self._latched_fault is not None:
            raise CommandRejected(self.name, Rejection.MODE, "device is faulted", hint=str(self._latched_fault))
        expires_ns = now_ns + round(ttl_s * 1e9)
        self._setpoint.follow(twist_base, expires_ns)
        self._follows_until_ns = expires_ns if twist_base.any() else 0

    def _begin_stop(self, category: StopCategory) -> None:
        self._follows_until_ns = 0
        self._setpoint.stop()

    def _park(self) -> None:
        if self._config.park_deg is None:
            raise LifecycleError(
                self.name, "park", self.state.value, ["configured with park_deg"], hint="add park_deg to the cell file"
            )
        self._setpoint.go_to(np.deg2rad(self._config.park_deg), _PARK_SPEED_FRACTION)
        while not self.at_rest():
            if self._latched_fault is not None:
                raise self._latched_fault
            self._clock.sleep_until_ns(self._clock.now_ns() + 5_000_000)

    def _parked(self) -> bool:
        """Return whether every joint is near the park pose; False without a park pose."""
        if self._config.park_deg is None:
            return False
        away = np.abs(self.joints().value.q - np.deg2rad(self._config.park_deg))
        return bool((away <= np.deg2rad(self._config.park_tolerance_deg)).all())

    def _run(self) -> None:
        period_ns = round(1e9 / self._config.rate_hz)
        last_ns = self._clock.now_ns() - period_ns
        next_ns = self._clock.now_ns()
        while not self._closing.is_set():
            with self._lock:
                now_ns = self._clock.now_ns()
                self._run_cycle(now_ns, min(now_ns - last_ns, 2 * period_ns) * 1e-9, now_ns + period_ns * 3 // 4)
            last_ns = now_ns
            next_ns += period_ns
            late_ns = self._clock.now_ns() - next_ns
            self._latest_s = max(self._latest_s, late_ns * 1e-9)
            if late_ns > 0:
                self._overruns += 1
                self._delays.warning("overrun", "%s: bus cycle %.1f ms late", self.name, late_ns * 1e-6)
                next_ns += late_ns
            self._clock.sleep_until_ns(next_ns)

    def _run_cycle(self, now_ns: int, dt_s: float, until_ns: int) -> None:
        """Run one cycle. No failure may end the loop: an arm without brakes falls when its motors hear nothing."""
        try:
            if self._latched_fault is not None:
                self._latch(self._latched_fault)
            self._cycle(now_ns, dt_s, until_ns)
            self._lost_bus = None
        except DeviceGone as error:
            # An interface that was taken down and up again carries frames again.
            self._lost_bus = error
            self._latch(error)
        except DeviceError as error:
            self._latch(error)
            self._keep_holding()
        except Exception as error:
            self._latch(DeviceFault(self.name, f"control loop failed: {error!r}", needs=Remedy.SERVICE))
            self._keep_holding()

    def _keep_holding(self) -> None:
        # The first failure is latched already; a second one must not end the loop either.
        with suppress(Exception):
            self._repeat_commands()

    def _check_missed(self) -> None:
        """Latch a fault when too many of the latest cycles ended without all replies."""
        full = len(self._missed) == self._missed.maxlen
        if full and sum(self._missed) > self._config.max_missed_fraction * len(self._missed):
            what = f"complete state in {sum(self._missed)} of {len(self._missed)} cycles"
            self._latch(
                TransportTimeout(self.name, what, 1.0 / self._config.rate_hz, hint="check wiring, supply and load")
            )

    def _check_tracking(self, q: Array, due: Array) -> None:
        """Latch a fault when an enabled joint in ``q`` deviates too far from setpoint ``due``, both (n,) rad."""
        error = np.where(self._enabled, np.abs(q - due), 0.0)
        worst = int(np.argmax(error))
        if error[worst] > np.deg2rad(self._config.tracking_error_deg):
            # Hold the measured position, so that the arm stops pushing against whatever blocks it.
            self._setpoint.reset(q)
            self._latch(
                DeviceFault(
                    self.name,
                    f"joint {self._chain.joint_names[worst]} is {np.rad2deg(error[worst]):.1f} deg off its setpoint",
                    fault_class=FaultClass.MOTION,
                    hint="check for a collision, an excessive payload or tool, or a wrong joint offset",
                )
            )
