"""Arms and cameras by the name of their driver, given back however the block that uses them ends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from touchcell.api.cells import load_cell
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.yaml_file import KeyPath, YamlFile
from touchcell.cell.runtime.devices import build_devices
from touchcell.control.reach import Reach, is_there
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock, MonotonicClock, VirtualClock
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Device, Lifecycle
from touchcell.drivers.core.errors import DeviceError, EndOfStream
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import FrameSource, HealthSource, JointSource, TcpSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ArrayLike, ImageArray

_MAX_POSE_AGE_S = 0.1
_PERIOD_S = 0.02
_TTL_S = 0.1
_GAIN_PER_S = 3.0
_WITHIN_M, _WITHIN_RAD = 1e-4, 2e-3
_FRAME_TIMEOUT_S = 5.0
_SPARE_S = 5.0


class NotArrived(DeviceError):
    """An arm did not reach a pose in time; it has been stopped.

    Attributes:
        timeout_s: how long it was given.
        T_base_tcp: (4, 4) where it is.
    """

    def __init__(self, device: str, timeout_s: float, T_base_tcp: Array) -> None:
        super().__init__(
            device, f"did not arrive within {timeout_s:.1f} s", hint="is the pose in reach, and is the speed allowed?"
        )
        self.timeout_s = timeout_s
        self.T_base_tcp = T_base_tcp


class _Connected:
    """A device between connect and disconnect; the subclasses say what can be done with it."""

    def __init__(self, device: Device, driver: str, clock: Clock) -> None:
        self.device = device
        self.driver = driver
        self._clock = clock

    @property
    def name(self) -> str:
        """The device's name."""
        return self.device.name

    @property
    def state(self) -> str:
        """Lifecycle state: disconnected, passive, ready, active or faulted."""
        return self.device.state.value

    def health(self) -> dict[str, float | int | str | bool]:
        """Health readings by name; empty for a device that has none. Raises DeviceError."""
        return self.device.health() if isinstance(self.device, HealthSource) else {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}: driver {self.driver}, {self.state}>"

    def __enter__(self) -> Self:
        with ExitStack() as undo:
            undo.enter_context(self.device)
            self.device.configure()
            undo.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.device.disconnect()


class ConnectedArm(_Connected):
    """An arm that is read, and moved inside ``control()``. As a context manager it is connected and given back.

    Attributes:
        device: the driver's own object, for everything that is not offered here.
        driver: name of its driver.
    """

    def pose(self) -> Array:
        """(4, 4) T_base_tcp, m. Raises StaleData if it is older than 0.1 s."""
        if not isinstance(self.device, TcpSource):
            raise ConfigError(f"{self.driver} does not measure the pose of a tool", key="driver", value=self.driver)
        return self.device.tcp(_MAX_POSE_AGE_S).value.T_base_tcp

    def pose_mm_deg(self) -> Array:
        """(6,) pose of the tool centre point in the base frame, mm and degrees (extrinsic xyz Euler angles)."""
        return se3.to_euler_mm_deg(self.pose())

    def joints(self) -> Array:
        """(n,) joint angles, rad. Raises ConfigError for an arm that does not measure them, StaleData."""
        if not isinstance(self.device, JointSource):
            raise ConfigError(f"{self.driver} does not measure joint angles", key="driver", value=self.driver)
        return self.device.joints(_MAX_POSE_AGE_S).value.q

    def control(
        self, *, owner: str = "python", on_exit: DeactivatePolicy | Literal["hold", "brake", "off"] = "hold"
    ) -> ArmControl:
        """Energise the arm and take its command lease for the length of a ``with`` block.

        Args:
            owner: name under which the lease is held.
            on_exit: what the arm does once it stands at the end of the block.

        Raises:
            ConfigError: the driver commands nothing, as a replay does.
        """
        if not isinstance(self.device, Arm):
            raise ConfigError(f"{self.driver} cannot be moved", key="driver", value=self.driver)
        return ArmControl(self.device, self._clock, owner, DeactivatePolicy(on_exit))


class ArmControl:
    """Command of one arm for the length of a ``with`` block.

    The arm is energised on entry. On exit, also by an exception or Ctrl-C, it is stopped, seen at rest, and left as
    asked. Commands expire 0.1 s after the last one, so it stops too when this program hangs or is killed.

    Args:
        arm: connected and configured.
        clock: its time.
        owner: of the lease.
        on_exit: what the arm does once it stands.

    Attributes:
        lease: proof of ownership while inside, for calls on the device itself.
    """

    lease: Lease

    def __init__(self, arm: Arm, clock: Clock, owner: str, on_exit: DeactivatePolicy) -> None:
        self._arm = arm
        self._clock = clock
        self._owner = owner
        self._on_exit = on_exit

    def __enter__(self) -> Self:
        self.lease = self._arm.acquire(self._owner)
        try:
            self._arm.activate()
        except BaseException:
            self._arm.release(self.lease)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._arm.release(self.lease)
        finally:
            if self._arm.state is Lifecycle.ACTIVE:
                self._arm.deactivate(self._on_exit)

    def send_twist(
        self, twist: ArrayLike, *, frame: Literal["base", "tcp"] = "base", ttl_s: float = _TTL_S
    ) -> Sent[TwistCommand]:
        """Send one twist, which moves the arm for at most ``ttl_s``; returns what was sent, with the limits applied.

        Args:
            twist: (6,) [vx vy vz wx wy wz] of the tool centre point, m/s and rad/s.
            frame: along whose axes.
            ttl_s: longest motion on this command.

        Raises:
            CommandRejected: nothing was sent; ``reason`` says why.
            StaleData: the pose is too old to turn a twist along tool axes.
        """
        command = TwistCommand(np.asarray(twist, np.float64), TwistFrame(frame), self._clock.now_ns(), ttl_s)
        return self._arm.send_twist(command, self.lease)

    def move(self, twist: ArrayLike, duration_s: float, *, frame: Literal["base", "tcp"] = "base") -> None:
        """Move with a twist for ``duration_s``, then come to rest. Arguments and errors as ``send_twist``."""
        due_ns = self._clock.now_ns()
        end_ns = due_ns + round(duration_s * 1e9)
        while self._clock.now_ns() < end_ns:
            self.send_twist(twist, frame=frame)
            due_ns = min(due_ns + round(_PERIOD_S * 1e9), end_ns)
            self._clock.sleep_until_ns(due_ns)
        self.stop()

    def move_to(
        self,
        pose: ArrayLike,
        *,
        speed_mm_s: float = 20.0,
        turn_deg_s: float = 20.0,
        timeout_s: float | None = None,
    ) -> None:
        """Move the tool centre point straight to a pose and come to rest there, within 0.1 mm and 0.1 deg.

        The path is a screw from here to there. Nothing on the way is avoided.

        Args:
            pose: in the base frame, (6,) mm and degrees (extrinsic xyz) or (4, 4) m.
            speed_mm_s: largest speed.
            turn_deg_s: largest turning rate.
            timeout_s: longest motion; None for three times what the way takes at these speeds.

        Raises:
            NotArrived: it is not there in time, and has been stopped.
            GeometryError: ``pose`` is no pose.
            CommandRejected, StaleData: as ``send_twist``.
        """
        goal = np.asarray(pose, np.float64)
        T_goal = se3.from_euler_mm_deg(goal) if goal.shape == (6,) else goal
        reach = Reach(_GAIN_PER_S, 1e-3 * speed_mm_s, np.deg2rad(turn_deg_s))
        away = se3.log(se3.inverse(self._pose()) @ T_goal)
        if timeout_s is None:
            needed_s = max(np.linalg.norm(away[:3]) / reach.speed_m_s, np.linalg.norm(away[3:]) / reach.turn_rad_s)
            timeout_s = 3.0 * float(needed_s) + _SPARE_S
        due_ns = self._clock.now_ns()
        end_ns = due_ns + round(timeout_s * 1e9)
        while not is_there(T_base_tcp := self._pose(), T_goal, _WITHIN_M, _WITHIN_RAD):
            if self._clock.now_ns() >= end_ns:
                self.stop()
                raise NotArrived(self._arm.name, timeout_s, T_base_tcp)
            self.send_twist(reach.twist(T_base_tcp, T_goal), frame="tcp")
            due_ns += round(_PERIOD_S * 1e9)
            self._clock.sleep_until_ns(due_ns)
        self.stop()

    def stop(self) -> None:
        """Stop now and wait until the arm stands. Raises DeviceFault if it does not."""
        self._arm.stop()
        self._arm.await_rest()

    def _pose(self) -> Array:
        return self._arm.tcp(_MAX_POSE_AGE_S).value.T_base_tcp

    def __repr__(self) -> str:
        return f"<ArmControl of {self._arm.name!r}: owner {self._arm.owner!r}, {self._arm.state.value}>"


class ConnectedCamera(_Connected):
    """A camera that is read. As a context manager it is connected and given back.

    Attributes:
        device: the driver's own object, for everything that is not offered here.
        driver: name of its driver.
    """

    def __init__(self, device: Device, driver: str, clock: Clock) -> None:
        super().__init__(device, driver, clock)
        self._last_seq = -1

    def frame(self, timeout_s: float = _FRAME_TIMEOUT_S) -> Stamped[Frame]:
        """Next frame that was not delivered before, with its capture time ``t_ns`` and number ``seq``.

        Raises:
            TransportTimeout: none came in time.
            EndOfStream: a recording has been played.
            DeviceGone, CorruptMessage: the camera failed.
        """
        if not isinstance(self.device, FrameSource):
            raise ConfigError(f"{self.driver} delivers no frames", key="driver", value=self.driver)
        found = self.device.next(self._last_seq, timeout_s)
        self._last_seq = found.seq
        return found

    def read(self, timeout_s: float = _FRAME_TIMEOUT_S) -> ImageArray:
        """Image of ``frame``: uint8, (height, width) grey or (height, width, 3) BGR. Raises as ``frame``."""
        return self.frame(timeout_s).value.image

    def __iter__(self) -> Iterator[ImageArray]:
        """Images as they come, until a recording has been played. Raises as ``frame``."""
        while True:
            try:
                yield self.read()
            except EndOfStream:
                return


class ConnectedCell:
    """All devices of a cell file, connected and not energised. As a context manager they are given back.

    Attributes:
        plan: the cell.
        arms: by name in the cell file.
        cameras: the sensors' cameras, by name of the sensor.
    """

    def __init__(self, plan: CellPlan) -> None:
        clock: Clock = VirtualClock() if plan.cell.time == "simulated" else MonotonicClock()
        devices = build_devices(plan, plan.devices, clock)
        self.plan = plan
        self.arms: Mapping[str, ConnectedArm] = {
            name: ConnectedArm(devices[name], plan.devices[name].spec.name, clock) for name in plan.cell.arms
        }
        self.cameras: Mapping[str, ConnectedCamera] = {
            name: ConnectedCamera(devices[name], plan.devices[name].spec.name, clock) for name in plan.cell.sensors
        }
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as undo:
            for device in (*self.arms.values(), *self.cameras.values()):
                undo.enter_context(device)
            self._opened = undo.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()

    def __repr__(self) -> str:
        devices = ", ".join(repr(device) for device in (*self.arms.values(), *self.cameras.values()))
        return f"<ConnectedCell {self.plan.cell.name!r}: {devices}>"


def connect_arm(driver: str, *, name: str = "arm", **settings: Any) -> ConnectedArm:
    """An arm by the name of its driver, to be used as a context manager; nothing is energised before ``control()``.

        with tc.connect_arm("ur", host="192.168.1.10") as arm:
            print(arm.pose_mm_deg())
            with arm.control() as control:
                control.move([0, 0, 0.01, 0, 0, 0], duration_s=1.0)

    Args:
        driver: as ``touchcell list`` shows it.
        name: of the device, in messages.
        settings: keys of the driver, as in a cell file; ``touchcell describe driver NAME`` shows them.

    Raises:
        ConfigError: the driver or a setting is unknown, or out of range.
    """
    device, clock = _build(driver, name, settings)
    if not isinstance(device, TcpSource):
        raise ConfigError(f"{driver} drives no arm", key="driver", value=driver, hint="use connect_camera()")
    return ConnectedArm(device, driver, clock)


def connect_camera(driver: str, *, name: str = "camera", **settings: Any) -> ConnectedCamera:
    """A camera by the name of its driver, to be used as a context manager.

        with tc.connect_camera("v4l2", device="/dev/video0") as camera:
            image = camera.read()

    Args:
        driver: as ``touchcell list`` shows it.
        name: of the device, in messages.
        settings: keys of the driver, as in a cell file; ``touchcell describe driver NAME`` shows them.

    Raises:
        ConfigError: the driver or a setting is unknown, or out of range.
    """
    device, clock = _build(driver, name, settings)
    if not isinstance(device, FrameSource):
        raise ConfigError(f"{driver} drives no camera", key="driver", value=driver, hint="use connect_arm()")
    return ConnectedCamera(device, driver, clock)


def connect_cell(cell: str | PathLike[str] | CellPlan) -> ConnectedCell:
    """Every device of a cell file, to be used as a context manager; nothing is energised.

    Args:
        cell: a cell file, the name of one that ships, or what ``load_cell`` returned.

    Raises:
        ConfigError: the cell file is not valid.
    """
    return ConnectedCell(cell if isinstance(cell, CellPlan) else load_cell(cell))


def _build(driver: str, name: str, settings: Mapping[str, Any]) -> tuple[Device, Clock]:
    spec = DRIVERS.load(driver)
    # No file and no line: a mistake is reported by its key.
    lines: dict[KeyPath, int] = dict.fromkeys([(), *((key,) for key in settings)], 0)
    config = YamlFile(Path(driver), dict(settings), lines).validate(spec.config, _plain(settings))
    clock: Clock = VirtualClock() if spec.capabilities.virtual_time else MonotonicClock()
    return spec.build(name, config, DriverContext(clock)), clock


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as a cell file would have them: arrays as lists."""
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in settings.items()}
