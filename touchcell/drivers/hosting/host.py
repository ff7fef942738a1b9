"""Device host: a process that owns drivers, executes commands through their gates, and stops when not guarded.

Single-threaded. Each device cycle handles the watchdog's record, then commands, then publishes the state of every
device.
"""

from __future__ import annotations

import json
import math
import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock, MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import CommandRejected, DeviceError, LifecycleError, Rejection
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import FrameSource, HealthSource, JointSource, StopCategory
from touchcell.drivers.core.samples import Frame, JointState, Quality, Stamped
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.drivers.hosting.layouts import (
    ANSWER,
    ARM,
    COMMAND,
    FRAME,
    HOST,
    MAX_NOTE_BYTES,
    WATCH,
    Cause,
    Reason,
    RecordReader,
    RecordWriter,
    read_cause,
    write_cause,
)
from touchcell.drivers.hosting.realtime import request_realtime
from touchcell.drivers.hosting.watchdog import silence_s
from touchcell.drivers.hosting.wire import encode_adjustments, encode_error, error_note, receive, send
from touchcell.errors import TouchcellError

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import Scene

LIFECYCLES: Final = tuple(Lifecycle)
REST_MARGIN_S: Final = 0.1
"""Time allowed for a stop beyond the deceleration itself."""

_LAST_REST_NS: Final = 2_000_000_000


class HostedArm:
    """One arm in its host: the driver, its blocks, and the record of executed commands and stops.

    Args:
        arm: driver of the arm.
        category: stop category after a failure.
        fds: descriptors of its blocks.
    """

    def __init__(self, arm: Arm, category: StopCategory, fds: Mapping[str, int]) -> None:
        self.arm = arm
        self._category = category
        self._commands = RecordReader(fds["command"], COMMAND)
        self._answers = RecordWriter(fds["answer"], ANSWER)
        self._state = RecordWriter(fds["state"], ARM)
        self._leases: dict[int, Lease] = {}
        self._stop_seen = 0
        self._twist_seen = 0
        self._deadline_ns = 0
        self._stopped_at = np.zeros(3)

    def acquire(self, owner: str) -> dict[str, Any]:
        """Take the arm's lease for the task's process."""
        lease = self.arm.acquire(owner)
        self._leases = {lease.epoch: lease}
        return {"epoch": lease.epoch}

    def release(self, epoch: int) -> dict[str, Any]:
        """Release the lease and stop."""
        if (lease := self._leases.pop(epoch, None)) is not None:
            self.arm.release(lease)
        return {}

    def execute(self, refuse: str, now_ns: int) -> bool:
        """Execute the newest command; return whether there is a reply for the task to read.

        Args:
            refuse: why no motion is allowed; empty if it is. Stops are always executed.
            now_ns: time for the record.
        """
        command = self._commands.read()
        stop, number = int(command["stop"]), int(command["number"])
        if stop > self._stop_seen:
            self._stop_seen = stop
            if not self._state.value["at_rest"]:
                self._state.value["requested_ns"] = now_ns
            # A driver that cannot stop its arm has latched its fault, which the state reports.
            with suppress(DeviceError):
                self.arm.stop(StopCategory(int(command["category"])))
        if number <= max(self._twist_seen, stop):
            return False
        self._twist_seen = number
        self._answer(command, number, refuse, now_ns)
        return True

    def _answer(self, command: Any, number: int, refuse: str, now_ns: int) -> None:
        answer = self._answers.value
        answer["number"] = number
        try:
            if refuse:
                raise CommandRejected(self.arm.name, Rejection.MODE, refuse)
            sent = self.arm.send_twist(_twist_command(command), self._lease(int(command["lease"])))
        except TouchcellError as error:
            answer["refused"], answer["t_ns"] = True, now_ns
            self._answers.publish(error_note(error, MAX_NOTE_BYTES))
            return
        answer["refused"], answer["t_ns"], answer["twist"] = False, sent.t_ns, sent.command.twist
        self._answers.publish(encode_adjustments(sent.adjustments))
        self._state.value["obeyed"] += 1
        self._state.value["executed_ns"] = sent.t_ns

    def _lease(self, epoch: int) -> Lease:
        # A lease that was never granted passes no gate.
        return self._leases.get(epoch) or Lease(self.arm.name, "a process without the lease", epoch)

    def stop(self) -> None:
        """Stop as at the end of a task."""
        with suppress(DeviceError):
            self.arm.stop()

    def latch(self, now_ns: int) -> None:
        """Stop because of a failure, and keep a record of it."""
        # A driver that cannot stop its arm has latched its fault; the deadline applies all the same.
        with suppress(DeviceError):
            self.arm.stop(self._category)
        state, limits = self._state.value, self.arm.limits
        state["stop_ns"], state["rest_ns"], state["stop_way_m"], state["escalated"] = now_ns, 0, 0.0, False
        state["stop_speed_m_s"] = math.hypot(*state["twist"][:3])
        self._stopped_at = state["T_base_tcp"][:3, 3].copy()
        braking_s = max(limits.speed_m_s / limits.accel_m_s2, limits.rot_speed_rad_s / limits.rot_accel_rad_s2)
        self._deadline_ns = now_ns + round(1e9 * (braking_s + REST_MARGIN_S))

    def clear(self) -> None:
        """Discard the record of the stop and prepare for the next."""
        self._deadline_ns = 0
        self._state.value["stop_ns"] = self._state.value["rest_ns"] = 0

    def at_rest(self) -> bool:
        """Return whether the last reading showed it at rest; a disconnected arm counts as at rest."""
        return self.arm.state is Lifecycle.DISCONNECTED or bool(self._state.value["at_rest"])

    def is_released(self) -> bool:
        """Return whether it is at rest and its lease is released."""
        return self.arm.owner is None and self.at_rest()

    def update(self, now_ns: int) -> None:
        """Publish its state, and monitor the progress of a stop."""
        value, note = self._state.value, b""
        value["lifecycle"], value["read_ns"] = LIFECYCLES.index(self.arm.state), now_ns
        if self.arm.state is not Lifecycle.DISCONNECTED:
            try:
                sample = self.arm.tcp()
                value["t_ns"], value["seq"] = sample.t_ns, sample.seq
                value["suspect"] = sample.quality is Quality.SUSPECT
                value["T_base_tcp"], value["twist"] = sample.value.T_base_tcp, sample.value.twist
                if isinstance(self.arm, JointSource):
                    self._put_joints(self.arm.joints())
                value["at_rest"] = self.arm.at_rest()
                value["failed"] = False
            except TouchcellError as error:
                value["at_rest"], value["failed"] = False, True
                note = error_note(error, MAX_NOTE_BYTES)
            value["lifecycle"] = LIFECYCLES.index(self.arm.state)
            if not value["at_rest"]:
                value["moved_ns"] = now_ns
        if self._deadline_ns:
            self._monitor_stop(now_ns)
        self._state.publish(note)

    def _put_joints(self, sample: Stamped[JointState]) -> None:
        value, joints, count = self._state.value, sample.value, len(sample.value.q)
        value["joints_t_ns"], value["joints_seq"], value["joint_count"] = sample.t_ns, sample.seq, count
        value["q"][:count], value["dq"][:count] = joints.q, joints.dq
        value["has_torque"] = joints.tau is not None
        if joints.tau is not None:
            value["tau"][:count] = joints.tau

    def _monitor_stop(self, now_ns: int) -> None:
        value = self._state.value
        if value["rest_ns"]:
            return
        if not value["failed"]:
            way_m = math.dist(value["T_base_tcp"][:3, 3], self._stopped_at)
            value["stop_way_m"] = max(float(value["stop_way_m"]), way_m)
        if value["at_rest"]:
            value["rest_ns"] = now_ns
        elif now_ns > self._deadline_ns and not value["escalated"]:
            value["escalated"] = True
            with suppress(DeviceError):
                self.arm.stop(min(self.arm.stop_categories))


class HostedCamera:
    """One camera in its host. A failed camera shows by the age of its newest frame."""

    def __init__(self, camera: Device, fd: int) -> None:
        assert isinstance(camera, FrameSource)
        self.camera = camera
        self._source: FrameSource = camera
        self._frames = RecordWriter(fd, FRAME)
        self._seq = -1

    def update(self) -> None:
        """Publish the newest frame if it is new."""
        if self.camera.state is not Lifecycle.ACTIVE:
            return
        try:
            frame = self._source.latest()
        except DeviceError:
            return
        if frame.seq != self._seq:
            self._seq = frame.seq
            self._publish(frame)

    def _publish(self, frame: Stamped[Frame]) -> None:
        value, image = self._frames.value, frame.value.image
        value["t_ns"], value["seq"], value["suspect"] = frame.t_ns, frame.seq, frame.quality is Quality.SUSPECT
        value["has_device_time"], value["t_device_ns"] = frame.t_device_ns is not None, frame.t_device_ns or 0
        value["height"], value["width"] = image.shape[:2]
        value["channels"] = image.shape[2] if image.ndim == 3 else 0
        value["exposure"] = math.nan if frame.value.exposure is None else frame.value.exposure
        value["gain"] = math.nan if frame.value.gain is None else frame.value.gain
        self._frames.publish(np.ascontiguousarray(image).tobytes())


class Host:
    """Main loop of a device host.

    Args:
        spec: specification written by ``link.HostLink``.
        control: socket to the task's process.
        clock: CLOCK_MONOTONIC, which all processes share.
    """

    def __init__(self, spec: Mapping[str, Any], control: socket.socket, clock: Clock) -> None:
        self._control = control
        self._clock = clock
        self._period_ns = round(1e9 / spec["rate_hz"])
        self._silence_s = silence_s(spec["period_s"])
        fds = spec["fds"]
        self._wake: int = fds["wake"]
        self._answered: int = fds["answered"]
        self._watch = RecordReader(fds["watch"], WATCH)
        self._beat = RecordWriter(fds["host"], HOST)
        self.devices, scene = _build(spec, clock)
        self._policies = {each["name"]: DeactivatePolicy(each["policy"]) for each in spec["devices"] if each["policy"]}
        self._arms = {
            each["name"]: HostedArm(arm, StopCategory(each["category"]), fds["devices"][each["name"]])
            for each in spec["devices"]
            if isinstance(arm := self.devices[each["name"]], Arm)
        }
        self._cameras = [
            HostedCamera(device, fds["devices"][name]["frame"])
            for name, device in self.devices.items()
            if name not in self._arms
        ]
        self._truth = None
        if scene is not None:
            from touchcell.drivers.hosting.truth import HostedScene

            sensors = {name: each["truth"] for name, each in fds["devices"].items() if "truth" in each}
            self._truth = HostedScene(scene, sensors, fds["objects"])
        self._cause: Cause | None = None
        self._guarded = False
        self._turn = 0
        self._due_ns = clock.now_ns()
        self.ending = False

    def run(self) -> None:
        """Run until the task's process has ended or requests the end; the arms are at rest then."""
        while not self.ending:
            wait_s = max(0.0, (self._due_ns - self._clock.now_ns()) * 1e-9)
            ready = select.select([self._wake, self._control.fileno()], [], [], wait_s)[0]
            if self._wake in ready:
                os.eventfd_read(self._wake)
            self.cycle()
            if self._control.fileno() in ready:
                self._serve()
        self._stop_and_deactivate()

    def cycle(self) -> None:
        """Poll the watchdog and the task, and publish the state of all devices when due."""
        now_ns = self._clock.now_ns()
        self._poll_watchdog(now_ns)
        self._execute(now_ns)
        if now_ns >= self._due_ns:
            self._publish(now_ns)
            self._due_ns = max(self._due_ns + self._period_ns, now_ns)

    def _poll_watchdog(self, now_ns: int) -> None:
        watch = self._watch.read()
        was_guarded, self._guarded = self._guarded, bool(watch["guarding"])
        if self._cause is not None:
            return
        silent_s = (now_ns - int(watch["t_ns"])) * 1e-9
        if watch["stop"]:
            self._latch(read_cause(watch), now_ns)
        elif self._guarded and silent_s > self._silence_s:
            self._latch(Cause(Reason.WATCHDOG_SILENT, now_ns, silent_s, self._silence_s), now_ns)
        elif was_guarded and not self._guarded:
            for hosted in self._arms.values():
                hosted.stop()

    def _latch(self, cause: Cause, now_ns: int) -> None:
        self._cause = cause
        for hosted in self._arms.values():
            hosted.latch(now_ns)
        self._beat.value["latched"] = True
        write_cause(self._beat.value, cause)
        self._publish(now_ns)

    def _execute(self, now_ns: int) -> None:
        refuse = "" if self._guarded else "not guarded by a watchdog"
        if self._cause is not None:
            refuse = f"stopped, {self._cause.reason.description}"
        answers = [hosted.execute(refuse, now_ns) for hosted in self._arms.values()]
        if any(answers):
            os.eventfd_write(self._answered, 1)

    def _publish(self, now_ns: int) -> None:
        for hosted in self._arms.values():
            hosted.update(now_ns)
        if self._truth is not None:
            self._truth.update()
        if self._cameras:
            # One per cycle: rendering or decoding an image takes as long as many cycles.
            self._turn = (self._turn + 1) % len(self._cameras)
            self._cameras[self._turn].update()
        beat = self._beat.value
        beat["count"] += 1
        beat["t_ns"] = self._clock.now_ns()
        self._beat.publish()

    def _serve(self) -> None:
        message = receive(self._control)
        if message is None or message["call"] == "end":
            self.ending = True
            if message is None and self._cause is None:
                self._latch(Cause(Reason.TASK_GONE, self._clock.now_ns()), self._clock.now_ns())
            return
        try:
            answer = {"ok": True, **self._call(message)}
        except TouchcellError as error:
            answer = {"ok": False, "error": encode_error(error)}
        # So that the caller sees the outcome.
        self._publish(self._clock.now_ns())
        with suppress(OSError):
            send(self._control, {**answer, "number": message["number"]})

    def _call(self, message: Mapping[str, Any]) -> dict[str, Any]:
        if message["call"] == "clear":
            return self._clear()
        name = message["device"]
        device = self.devices[name]
        calls: dict[str, Callable[[], dict[str, Any] | None]] = {
            "connect": lambda: self._connect(device),
            "configure": lambda: self._configure(device),
            "activate": device.activate,
            "deactivate": lambda: device.deactivate(DeactivatePolicy(message["policy"])),
            "disconnect": device.disconnect,
            "recover": lambda: _recover(device, OperatorToken(message["operator"], message["t_ns"])),
            "health": lambda: {"health": device.health() if isinstance(device, HealthSource) else {}},
            "acquire": lambda: self._arms[name].acquire(message["owner"]),
            "release": lambda: self._arms[name].release(message["epoch"]),
        }
        return calls[message["call"]]() or {}

    def _connect(self, device: Device) -> dict[str, Any]:
        device.connect()
        if not isinstance(device, Arm):
            return {}
        return {"limits": asdict(device.limits), "stop_categories": sorted(device.stop_categories)}

    def _configure(self, device: Device) -> dict[str, Any]:
        device.configure()
        # Some controllers report their tool only now.
        ik = device.kinematics() if isinstance(device, Arm) else None
        if ik is None:
            return {}
        kinematics = {
            "chain": ik.chain.description.model_dump(mode="json"),
            "tool": ik.chain.tool.model_dump(mode="json"),
            "settings": asdict(ik.settings),
        }
        return {"kinematics": kinematics}

    def _clear(self) -> dict[str, Any]:
        watch = self._watch.read()
        is_released = all(hosted.is_released() for hosted in self._arms.values())
        if watch["stop"] or watch["guarding"] or not is_released:
            raise LifecycleError("host", "clear its latch", "stopped", ["at rest, without lease and stop flag"])
        self._cause = None
        self._beat.value["latched"] = False
        for hosted in self._arms.values():
            hosted.clear()
        return {}

    def _stop_and_deactivate(self) -> None:
        """Stop the arms, wait until they are at rest or their time has passed, then deactivate the active ones."""
        for hosted in self._arms.values():
            hosted.stop()
        self._publish(self._clock.now_ns())
        deadline_ns = self._clock.now_ns() + _LAST_REST_NS
        while any(not hosted.at_rest() for hosted in self._arms.values()) and self._clock.now_ns() < deadline_ns:
            self._clock.sleep_until_ns(self._clock.now_ns() + self._period_ns)
            self._publish(self._clock.now_ns())
        for name, device in self.devices.items():
            if device.state is Lifecycle.ACTIVE:
                with suppress(DeviceError):
                    device.deactivate(self._policies.get(name, DeactivatePolicy.HOLD))
        self._publish(self._clock.now_ns())


def _build(spec: Mapping[str, Any], clock: Clock) -> tuple[dict[str, Device], Scene | None]:
    scene = None
    if spec["scene"] is not None:
        scene = scene_section().model_validate(spec["scene"]).build(clock)
    devices: dict[str, Device] = {}
    context = DriverContext(clock, devices, scene, spec["seed"])
    for each in spec["devices"]:
        driver = DRIVERS.load(each["driver"])
        devices[each["name"]] = driver.build(each["name"], driver.config.model_validate(each["config"]), context)
    return devices, scene


def _recover(device: Device, token: OperatorToken) -> None:
    """FAULTED -> READY. A device that is still active here after the task dropped it is only disconnected."""
    if device.state is Lifecycle.ACTIVE:
        device.deactivate()
    elif device.state is not Lifecycle.READY:
        device.recover(token)


def _twist_command(command: Any) -> TwistCommand:
    return TwistCommand(
        command["twist"].copy(),
        TwistFrame.TCP if command["tcp_frame"] else TwistFrame.BASE,
        int(command["t_ns"]),
        float(command["ttl_s"]),
        int(command["t_cause_ns"]) if command["has_cause"] else None,
    )


def main() -> None:
    """Run as ``python -m touchcell.drivers.hosting.host SPEC``, with the descriptors named in SPEC inherited."""
    spec = json.loads(sys.argv[1])
    control = socket.socket(fileno=spec["fds"]["socket"])
    try:
        host = Host(spec, control, MonotonicClock())
    except TouchcellError as error:
        send(control, {"ok": False, "number": 0, "error": encode_error(error)})
        return
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: setattr(host, "ending", True))
    with ExitStack() as exits:
        for device in host.devices.values():
            exits.callback(device.disconnect)
        realtime = request_realtime()
        # The first heartbeat: from now on silence counts.
        host.cycle()
        send(control, {"ok": True, "number": 0, "realtime": realtime})
        host.run()


if __name__ == "__main__":
    main()
