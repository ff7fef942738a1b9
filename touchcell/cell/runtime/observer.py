"""What a run loop observes: the arms' states, the sensors' contacts, and both as the supervisor sees them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.health import HealthMonitor
from touchcell.cell.runtime.sensor import Sensor
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.control.interlocks.snapshot import ArmView, CellView, DeviceView, SensorView
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.errors import DeviceFault
from touchcell.drivers.core.protocols import ReadingSource
from touchcell.drivers.core.samples import Health, JointState, Stamped, TcpState
from touchcell.errors import TouchcellError, described
from touchcell.geometry import se3
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Reading:
    """What was read in one cycle.

    Attributes:
        now_ns: time that it is for.
        states: of the arms, by role.
        contacts: of the sensors that have seen a frame, by role.
        devices: of the other devices that are read, by role.
        health: what devices have just reported about themselves, by name; most cycles have none.
        wrenches: (6,) N and N m of the arms of which they are needed, by role.
        external_torques: (n,) N m of each joint of the arms of which they are needed, by role.
    """

    now_ns: int
    states: Mapping[str, Stamped[TcpState]]
    contacts: Mapping[str, ContactEstimate]
    devices: Mapping[str, Stamped[Mapping[str, float]]] = field(default_factory=dict)
    health: Mapping[str, Stamped[Health]] = field(default_factory=dict)
    wrenches: Mapping[str, Stamped[Array]] = field(default_factory=dict)
    external_torques: Mapping[str, Stamped[Array]] = field(default_factory=dict)


class Observer:
    """Reads a cell's arms and sensors.

    What a driver raises that is no TouchcellError comes out as a DeviceFault that names the device.

    Args:
        cell: activated.
        times: takes the duration of reading the arms.
    """

    def __init__(self, cell: Cell, times: CycleTimes) -> None:
        self._cell = cell
        self._times = times
        self._watched = {device for device, _ in cell.watched_readings}
        self._health = HealthMonitor(cell.devices(), cell.clock)

    @property
    def exhausted(self) -> bool:
        """Whether no sensor will deliver anything more, because recordings have been played."""
        sensors = self._cell.sensors
        return bool(sensors) and all(sensor.source.ended for sensor in sensors.values())

    def await_frames(self) -> None:
        """Wait for each camera's first frame, so that no control cycle has to, and begin with the sensors' threads.

        Raises:
            DeviceError: a camera gives none.
            ImageError: it is not what the model reads.
        """
        for role, sensor in self._cell.sensors.items():
            call_driver(self._device(role), sensor.await_frame)
        for role, sensor in self._cell.sensors.items():
            call_driver(self._device(role), partial(sensor.begin, role))

    def read(self) -> Reading:
        """Read the arms and perceive. Raises DeviceError, ImageError."""
        cell = self._cell
        self._times.begin()
        started = time.perf_counter_ns()
        states = {role: call_driver(arm.name, arm.tcp) for role, arm in cell.arms.items()}
        wrenches = {role: call_driver(cell.arms[role].name, cell.arms[role].wrench) for role in cell.watched_wrenches}
        torques = {
            role: call_driver(cell.arms[role].name, cell.arms[role].external_torques) for role in cell.watched_torques
        }
        self._times.add("read arms", time.perf_counter_ns() - started)
        contacts = {}
        for role, sensor in cell.sensors.items():
            estimate = call_driver(self._device(role), partial(self._perceive, sensor, states))
            if estimate is not None:
                contacts[role] = estimate
        devices = {}
        for role, device in cell.auxiliaries.items():
            if device.fault is not None:
                raise device.fault
            if isinstance(device, ReadingSource):
                devices[role] = call_driver(device.name, device.read)
        started = time.perf_counter_ns()
        health = self._health.read()
        if health:
            self._times.add("read health", time.perf_counter_ns() - started)
        # Only now: what a device's own thread brought in the meantime would seem to come from the future.
        return Reading(cell.clock.now_ns(), states, contacts, devices, health, wrenches, torques)

    def view(
        self,
        reading: Reading,
        action: Action | None = None,
        sent: Mapping[str, Sent[TwistCommand]] | None = None,
    ) -> CellView:
        """The cell as the supervisor sees it. Raises DeviceError.

        Args:
            reading: of this cycle.
            action: what the task asks for; None while no task is at work.
            sent: what was sent in the cycle before.
        """
        cell, asked, sent = self._cell, action or Action(), sent or {}
        return CellView(
            reading.now_ns,
            {
                role: ArmView(
                    state,
                    asked.twists.get(role),
                    sent.get(role),
                    self._joints(role),
                    reading.wrenches.get(role),
                    reading.external_torques.get(role),
                )
                for role, state in reading.states.items()
            },
            {role: _sensor_view(estimate, self._cell.sensors[role]) for role, estimate in reading.contacts.items()},
            self._cell.task.state,
            at_work=action is not None,
            enabling=None if cell.enabling_device is None else cell.enabling_device.position(),
            devices={
                role: DeviceView(reading.devices.get(role), asked.settings.get(role)) for role in cell.auxiliaries
            },
            health={name: self._health.newest[name] for name in self._watched if name in self._health.newest},
        )

    def _device(self, sensor_role: str) -> str:
        return self._cell.plan.sensor_roles.get(sensor_role, sensor_role)

    def _perceive(self, sensor: Sensor, states: Mapping[str, Stamped[TcpState]]) -> ContactEstimate | None:
        if sensor.arm_role is not None:
            state = states[sensor.arm_role]
            # A pose that is not finite is for the supervisor to see, not for the filter.
            if all_finite(state.value.T_base_tcp):
                sensor.source.record_pose(state.t_ns, se3.compose(state.value.T_base_tcp, sensor.T_tcp_sensor))
        return sensor.source.update(self._cell.clock.now_ns())

    def _joints(self, role: str) -> Stamped[JointState] | None:
        arm = self._cell.arms[role]
        return call_driver(arm.name, arm.joints) if role in self._cell.watched_joints else None


def call_driver(device: str, call: Callable[[], _T]) -> _T:
    """Call a driver; whatever it raises that is no TouchcellError comes out as a DeviceFault of ``device``."""
    try:
        return call()
    except (TouchcellError, KeyboardInterrupt):
        raise
    except BaseException as error:
        # A driver that calls sys.exit, too: that is no end of a run.
        raise DeviceFault(device, f"its driver raised {described(error)}") from error


def _sensor_view(estimate: ContactEstimate, sensor: Sensor) -> SensorView:
    depth_m = sigma_m = shear_m = torsion_rad = None
    if estimate.belief is not None:
        T_f_s = se3.inverse(estimate.belief.mean)
        depth_m = float(T_f_s[2, 3])
        sigma_m = math.sqrt(estimate.belief.covariance[2, 2])
        shear_m = math.hypot(T_f_s[0, 3], T_f_s[1, 3])
        torsion_rad = math.atan2(T_f_s[1, 0], T_f_s[0, 0])
    content, brightness = sensor.picture()
    return SensorView(
        estimate.t_frame_ns,
        estimate.seq,
        estimate.in_contact,
        depth_m,
        estimate.in_range,
        estimate.nis,
        sigma_m,
        shear_m,
        torsion_rad,
        content,
        brightness,
        None if estimate.belief is None else estimate.belief.mean,
        estimate.markers,
        sensor.arm_role,
        estimate.refusal,
    )
