"""Context of a conformance check: the device, its emulator's ground truth, and their common clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError, StaleData
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import FrameSource, HealthSource, ReadingSource
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.testing.emulation.rig import DeviceFixture, Emulated, FixtureFactory

CREEP_M_S = 0.005
CREEP_RAD_S = 0.02
OWNER = "conformance"
_PERIOD_NS = 20_000_000
_TTL_S = 0.25
_STILL_M = 1e-4
_STILL_RAD = 1e-3
_STILL_NS = 60_000_000


@dataclass(frozen=True, slots=True)
class Track:
    """True poses of the tool over time.

    Attributes:
        t_ns: (n,) times on the check's clock.
        poses: (n, 4, 4) in the base frame.
        t_true_s: (n,) the same times on the emulator's own clock, which is used for speeds.
    """

    t_ns: Array
    poses: Array
    t_true_s: Array

    @property
    def late_s(self) -> float:
        """Return the longest gap between samples or lag of the emulator, s: the delay of a busy machine."""
        if len(self.t_ns) < 2:
            return 0.0
        lag_s = self.t_ns * 1e-9 - self.t_true_s
        return float(np.diff(self.t_ns).max() * 1e-9 + np.ptp(lag_s))

    def position_at(self, t_ns: float) -> Array:
        """Return the position (3,) at ``t_ns``, linearly interpolated."""
        return np.array([np.interp(t_ns, self.t_ns, self.poses[:, axis, 3]) for axis in range(3)])

    def since(self, t_ns: float) -> Track:
        """Return the part from ``t_ns`` on."""
        late = self.t_ns >= t_ns
        return Track(self.t_ns[late], self.poses[late], self.t_true_s[late])

    def mean_twist(self, frame: TwistFrame) -> Array:
        """Return the mean twist (6,) of the TCP from the first to the last sample, along base or first tool axes."""
        first, last = self.poses[0], self.poses[-1]
        turn = np.eye(4)
        turn[:3, :3] = last[:3, :3] @ first[:3, :3].T
        moved = np.concatenate([last[:3, 3] - first[:3, 3], se3.log(turn)[3:]])
        if frame is TwistFrame.TCP:
            R = first[:3, :3].T
            moved = np.concatenate([R @ moved[:3], R @ moved[3:]])
        return cast(Array, moved / (self.t_true_s[-1] - self.t_true_s[0]))


class _Recorder:
    """Recorder of a track."""

    def __init__(self, context: ConformanceContext) -> None:
        self._bench = context
        self.times: list[int] = []
        self.poses: list[Array] = []
        self._true: list[float] = []
        self.truth: dict[str, Any] = {}

    def note(self) -> None:
        """Record a sample."""
        context = self._bench
        before_ns = context.clock.now_ns()
        self.truth = {} if context.is_real else context.truth()
        self.poses.append(context.pose(self.truth))
        t_ns = (before_ns + context.clock.now_ns()) // 2
        self.times.append(t_ns)
        self._true.append(t_ns * 1e-9 if context.rig.time is None or context.is_real else self.truth[context.rig.time])

    def track(self, count: int | None = None) -> Track:
        """Return the first ``count`` samples, or all."""
        t_ns, poses, true = self.times[:count], self.poses[:count], self._true[:count]
        return Track(np.array(t_ns, dtype=np.float64), np.array(poses), np.array(true))


class DeviceUnderTest:
    """One device fixture and its emulator, shared by the checks of a driver until one of them spoils it."""

    def __init__(self, function: FixtureFactory, folder: Path, address: int) -> None:
        self.function = function
        self.folder = folder
        self.address = address
        self.rig: DeviceFixture = function(folder, address)
        self._emulator: Emulated | None = None

    def emulator(self) -> Emulated:
        """The running emulator, started on demand."""
        if self._emulator is None:
            assert self.rig.start is not None
            self._emulator = self.rig.start()
        return self._emulator

    def clear(self) -> None:
        """End the emulator; the next check starts a fresh one."""
        emulator, self._emulator = self._emulator, None
        if emulator is not None:
            with suppress(DeviceError):
                emulator.thaw()
            emulator.stop()

    def vanish(self) -> None:
        """Kill the emulator: the device disappears without notice."""
        emulator, self._emulator = self._emulator, None
        assert emulator is not None
        emulator.kill()


class ConformanceContext:
    """Context of one check; creates devices and cleans up after it.

    Attributes:
        under_test: the device fixture and its emulator.
        rig: the device fixture.
        clock: common clock; a virtual one advances only when code sleeps.
        device: the device under test, initially DISCONNECTED.
        late_s: longest delay of the host while the last ``stream`` was sent.
        changed: set it if the emulator has to be reset.
        spoiled: set it if the emulator cannot serve another check.
    """

    def __init__(self, under_test: DeviceUnderTest) -> None:
        self.under_test = under_test
        self.rig = under_test.rig
        self.clock = self.rig.clock()
        self.late_s = 0.0
        self._devices: list[Device] = []
        self._began: set[str] = set()
        if self.rig.start is not None:
            under_test.emulator()
        self.device = self.another()
        # An arm that sinks without power starts each check where it started the first.
        self.changed = self.rig.spec.capabilities.falls_on_power_loss or not self.rig.process
        self.spoiled = False

    @property
    def arm(self) -> Arm:
        """Return the device as an arm."""
        return cast(Arm, self.device)

    @property
    def camera(self) -> FrameSource:
        """Return the device as a camera."""
        return cast(FrameSource, self.device)

    @property
    def emulator(self) -> Emulated:
        """The emulator."""
        return self.under_test.emulator()

    @property
    def is_real(self) -> bool:
        """True for real hardware, which can injure people."""
        return self.rig.start is None

    @property
    def token(self) -> OperatorToken:
        """Return an operator's token."""
        return OperatorToken("conformance suite", self.clock.now_ns())

    def is_in(self, state: Lifecycle) -> bool:
        """Return whether the device is in ``state``."""
        return self.device.state is state

    def another(self) -> Device:
        """Return one more DISCONNECTED driver object for the same device."""
        device = self.rig.build(self.clock)
        self._devices.append(device)
        return device

    def close(self) -> None:
        """Restore everything for the next check."""
        try:
            if not self.is_real and self.rig.process:
                self.emulator.thaw()
                for fault in self._began:
                    self.emulator.clear(fault)
        except (DeviceError, OSError):
            self.spoiled = True
        for device in self._devices:
            device.disconnect()
        if self.spoiled and not self.is_real:
            self.under_test.clear()
        elif self.changed and not self.is_real:
            self.restore()

    def restore(self) -> None:
        """Reset the emulator, or start another."""
        if self.rig.reset is not None:
            self.emulator.fault(self.rig.reset)
            return
        self.under_test.clear()
        self.under_test.emulator()

    def begin(self, fault: str, value: Any) -> None:
        """Inject a fault into the emulator; it ends with the check at the latest."""
        self._began.add(fault)
        self.emulator.fault(fault, value)

    def end(self, fault: str) -> None:
        """End a fault."""
        self._began.discard(fault)
        self.emulator.clear(fault)

    def ready(self) -> Device:
        """Bring the device to READY."""
        self.device.connect()
        self.device.configure()
        return self.device

    def active(self) -> Device:
        """Bring the device to ACTIVE."""
        self.ready().activate()
        return self.device

    def leased(self) -> Lease:
        """Bring the arm to ACTIVE and take its lease."""
        self.active()
        return self.arm.acquire(OWNER)

    def sleep(self, seconds: float) -> None:
        """Sleep on the clock."""
        self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * 1e9))

    def until(self, condition: Callable[[], bool], within_s: float, what: str) -> float:
        """Wait for ``condition``; return the time in s, and fail the check if it took too long."""
        start_ns = self.clock.now_ns()
        while not condition():
            if (self.clock.now_ns() - start_ns) * 1e-9 > within_s:
                pytest.fail(f"{what}: not within {within_s:g} s", pytrace=False)
            self.sleep(0.005)
        return (self.clock.now_ns() - start_ns) * 1e-9

    def truth(self) -> dict[str, Any]:
        """Return the ground truth from the emulator."""
        return self.emulator.state()

    def energised(self) -> int:
        """Return the number of messages at the emulator that change power, mode or zero."""
        return int(self.truth()[self.rig.energising]) if self.rig.energising else 0

    def pose(self, truth: dict[str, Any] | None = None) -> Array:
        """Return the true pose (4, 4) of the tool centre point in the base frame; on real hardware the measured one."""
        if self.is_real:
            return self.arm.tcp().value.T_base_tcp
        truth = truth or self.truth()
        if self.rig.pose is not None:
            return np.array(truth[self.rig.pose])
        T = self.arm.tcp().value.T_base_tcp.copy()
        T[:3, 3] = truth[cast(str, self.rig.position)]
        return T

    def position(self) -> Array:
        """Return the true position (3,) of the tool centre point; on real hardware the measured one."""
        if self.is_real or self.rig.position is None:
            return self.pose()[:3, 3]
        return np.array(self.truth()[self.rig.position])

    def speed(self, fraction: float = 0.3) -> float:
        """Return a linear speed for tests in m/s: a fraction of the limit, and at most 5 mm/s on real hardware."""
        return min(CREEP_M_S if self.is_real else 0.05, fraction * self.arm.limits.speed_m_s)

    def rot_speed(self, fraction: float = 0.3) -> float:
        """Return an angular speed for tests, in rad/s, likewise."""
        return min(CREEP_RAD_S if self.is_real else 0.15, fraction * self.arm.limits.rot_speed_rad_s)

    def axis(self) -> int:
        """Return an axis that the arm can follow."""
        return self.rig.spec.capabilities.twist_axes.index(True)

    def twist(self, axis: int, *, speed: float | None = None) -> Array:
        """Return a twist (6,) along one axis at test speed."""
        twist = np.zeros(6)
        twist[axis] = speed if speed is not None else self.speed() if axis < 3 else self.rot_speed()
        return twist

    def command(
        self, twist: Array, frame: TwistFrame = TwistFrame.BASE, ttl_s: float = _TTL_S, *, age_s: float = 0.0
    ) -> TwistCommand:
        """Return a command computed ``age_s`` ago."""
        return TwistCommand(twist, frame, self.clock.now_ns() - round(age_s * 1e9), ttl_s)

    def stream(
        self,
        lease: Lease,
        twist: Array,
        seconds: float,
        *,
        frame: TwistFrame = TwistFrame.BASE,
        ttl_s: float = _TTL_S,
    ) -> tuple[Track, Sent[TwistCommand]]:
        """Send ``twist`` at 50 Hz for a while; return the true track of the tool, and the last command as sent."""
        recorder = _Recorder(self)
        self.late_s = 0.0
        due_ns = self.clock.now_ns()
        end_ns = due_ns + round(seconds * 1e9)
        while True:
            now_ns = self.clock.now_ns()
            self.late_s = max(self.late_s, (now_ns - due_ns) * 1e-9)
            try:
                sent = self.arm.send_twist(self.command(twist, frame, ttl_s), lease)
            except StaleData as error:
                recorder.note()
                # Not the driver's fault where the emulator was starved; the caller tries again.
                if recorder.track().late_s < error.limit_s or now_ns >= end_ns:
                    pytest.fail(f"{error}; fault: {self.device.fault}", pytrace=False)
                self.late_s = max(self.late_s, error.age_s)
                due_ns = self.clock.now_ns()
                continue
            except DeviceError as error:
                pytest.fail(f"{error}; fault: {self.device.fault}", pytrace=False)
            recorder.note()
            if now_ns >= end_ns:
                return recorder.track(), sent
            due_ns = now_ns + _PERIOD_NS
            self.clock.sleep_until_ns(due_ns)

    def track_to_rest(self, within_s: float, ended: Callable[[dict[str, Any]], bool] | None = None) -> Track:
        """Track the true pose until it rests (or ``ended(truth)`` is true); fail the check if it does not.

        The track ends at the start of the rest.
        """
        recorder = _Recorder(self)
        times, poses = recorder.times, recorder.poses
        deadline_ns = self.clock.now_ns() + round(within_s * 1e9) + _STILL_NS
        while True:
            recorder.note()
            if ended is not None and ended(recorder.truth):
                return recorder.track()
            calm = next((i for i, t_ns in enumerate(times) if t_ns >= times[-1] - _STILL_NS), 0)
            if times[-1] - times[0] >= _STILL_NS and _spread(poses[calm:]):
                return recorder.track(calm + 1)
            if times[-1] > deadline_ns:
                pytest.fail(f"the tool still moves after {within_s:g} s", pytrace=False)
            self.sleep(0.003)

    def settle(self, within_s: float = 2.0) -> None:
        """Wait until the tool is truly at rest."""
        self.track_to_rest(within_s)

    def read(self, max_age_s: float | None = None) -> Any:
        """Return the newest sample of the device, of any kind."""
        if self.rig.spec.capabilities.kind == "camera":
            return self.camera.latest(max_age_s)
        if isinstance(self.device, ReadingSource):
            return self.device.read(max_age_s)
        return self.arm.tcp(max_age_s)

    def counters(self) -> dict[str, int]:
        """Return the integers in the device's health."""
        if not isinstance(self.device, HealthSource):
            return {}
        health = self.device.health()
        return {key: value for key, value in health.items() if isinstance(value, int) and not isinstance(value, bool)}

    def reach_faulted(self, within_s: float, lease: Lease | None = None) -> float:
        """Use the device as a task would until it is FAULTED; return the time in s."""

        def use() -> bool:
            with suppress(DeviceError):
                if lease is not None:
                    self.arm.send_twist(self.command(self.twist(self.axis(), speed=0.002)), lease)
                self.read()
            return self.device.state is Lifecycle.FAULTED

        return self.until(use, within_s, "FAULTED")

    def reconnect(self, within_s: float = 5.0) -> None:
        """Disconnect, and bring the device to ACTIVE again as soon as it is reachable."""
        self.device.disconnect()
        assert self.device.state is Lifecycle.DISCONNECTED
        refused: list[DeviceError] = []

        def again() -> bool:
            try:
                self.active()
            except DeviceError as error:
                refused.append(error)
                self.device.disconnect()
            return self.device.state is Lifecycle.ACTIVE

        try:
            self.until(again, within_s, "ACTIVE again")
        except pytest.fail.Exception:
            pytest.fail(f"not ACTIVE again within {within_s:g} s: {refused[-1]}", pytrace=False)


def _spread(poses: Sequence[Array]) -> bool:
    stack = np.array(poses)
    return bool(
        np.ptp(stack[:, :3, 3], axis=0).max() < _STILL_M and np.ptp(stack[:, :3, :3], axis=0).max() < _STILL_RAD
    )
