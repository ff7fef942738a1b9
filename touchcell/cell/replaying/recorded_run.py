"""A recording, control cycle by control cycle: what devices delivered, what was estimated, sent and judged."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Message, read
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.recording.recorded_images import RecordedImage, is_image, recorded_images
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.types import Array

Row = Mapping[str, Any]
"""Fields of one recorded message."""

_WAITING: Final = "waiting"


@dataclass
class RecordedCycle:
    """One control cycle as it was recorded.

    Attributes:
        now_ns: its time.
        states: of the arms, by role.
        joints: the newest of the arms, by role; they are recorded less often than each cycle.
        wrenches, external_torques: of the arms whose interlocks needed them, by role.
        contacts: fields of the contact estimates, by role of the sensor.
        measurements: fields of what the newest frame in contact gave by itself, by role of the sensor.
        readings: of other devices, by role.
        health: the newest of each device, by its name.
        commands: fields of the twists that were sent, by role of the arm.
        verdict: fields of the supervisor's verdict, where it was recorded: only violations are.
        task_state: state of the task after it.
    """

    now_ns: int = 0
    states: dict[str, Stamped[TcpState]] = field(default_factory=dict)
    joints: dict[str, Stamped[JointState]] = field(default_factory=dict)
    wrenches: dict[str, Stamped[Array]] = field(default_factory=dict)
    external_torques: dict[str, Stamped[Array]] = field(default_factory=dict)
    contacts: dict[str, Row] = field(default_factory=dict)
    measurements: dict[str, Row] = field(default_factory=dict)
    readings: dict[str, Stamped[Mapping[str, float]]] = field(default_factory=dict)
    health: dict[str, Row] = field(default_factory=dict)
    commands: dict[str, Row] = field(default_factory=dict)
    verdict: Row | None = None
    task_state: str = ""


@dataclass(frozen=True)
class RecordedRun:
    """What a recording holds of a run.

    Attributes:
        file: the recording.
        cycles: until the task ended, or until an operator let it start again.
        with_images: roles of the sensors whose images were recorded.
        resumed: whether the run went on after a reset, which is not part of ``cycles``.
        lossy: whether images were recorded as video or JPEG, which changes them a little.
    """

    file: Path
    cycles: tuple[RecordedCycle, ...]
    with_images: frozenset[str]
    resumed: bool
    lossy: bool = False

    def images(self, role: str) -> Iterator[RecordedImage]:
        """Yield the recorded images of one sensor in their order, decoded one by one."""
        return recorded_images(
            message for message in read(self.file) if is_image(message.topic) and message.topic.split("/")[2] == role
        )


def read_run(file: Path) -> RecordedRun:
    """Read a recording.

    Raises:
        RecordingError: it is missing, no recording, or holds no control cycle.
    """
    reader = _CycleReader()
    for message in read(file):
        if not reader.take(message):
            break
    if not reader.cycles:
        raise RecordingError(file, "holds no control cycle", hint="a run that ended before it began has none to replay")
    return RecordedRun(file, tuple(reader.cycles), frozenset(reader.with_images), reader.resumed, reader.lossy)


class _CycleReader:
    """Sorts messages into cycles: the task's own message is the last of a cycle but for its transitions."""

    def __init__(self) -> None:
        self.cycles: list[RecordedCycle] = []
        self.with_images: set[str] = set()
        self.resumed = self.lossy = False
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._next = RecordedCycle()
        self._waiting = False

    def take(self, message: Message) -> bool:
        """Take one message; returns False where the task starts again."""
        parts = message.topic.strip("/").split("/")
        cycle, data, t_ns = self._next, message.data, message.t_ns
        match parts:
            case ["task"] if self._waiting:
                self.resumed = True
                return False
            case ["task"]:
                cycle.now_ns, cycle.task_state = t_ns, str(data.get("state", ""))
                self.cycles.append(cycle)
                self._next = RecordedCycle(
                    joints=dict(cycle.joints), measurements=dict(cycle.measurements), health=dict(cycle.health)
                )
            case ["arms", role, "tcp"]:
                cycle.states[role] = Stamped(_tcp_state(data), t_ns, int(data.get("seq", 0)))
            case ["arms", role, "joints"]:
                cycle.joints[role] = Stamped(_joint_state(data), t_ns, self._count(message.topic))
            case ["arms", role, "wrench"]:
                cycle.wrenches[role] = _values(data, t_ns)
            case ["arms", role, "external_torque"]:
                cycle.external_torques[role] = _values(data, t_ns)
            case ["arms", role, "command"]:
                cycle.commands[role] = data
            case ["sensors", role, "contact"]:
                cycle.contacts[role] = data
            case ["sensors", role, "measurement"]:
                cycle.measurements[role] = data
            case ["sensors", role, _] if is_image(message.topic):
                self.with_images.add(role)
                self.lossy = self.lossy or data.get("format") != "png"
            case ["devices", role, "reading"]:
                values = {key: value for key, value in data.items() if key != "seq"}
                cycle.readings[role] = Stamped(values, t_ns, int(data.get("seq", 0)))
            case ["health", name]:
                cycle.health[name] = {key: value for key, value in data.items() if key != "seq"}
            case ["safety"]:
                cycle.verdict = data
            case ["events"]:
                self._waiting = self._waiting or data.get("event") == _WAITING
        return True

    def _count(self, topic: str) -> int:
        self._seq[topic] += 1
        return self._seq[topic]


def pose_of(data: Row) -> Array:
    """Return the pose (4, 4) of a message's six components; of NaN where one is missing."""
    values = [data.get(name) for name in COMPONENTS]
    if any(not isinstance(value, int | float) for value in values):
        return np.full((4, 4), np.nan)
    return se3.from_euler_mm_deg(np.array(values, dtype=np.float64))


def numbers(values: Any) -> Array:
    """Return a recorded list of numbers as an array, NaN for what was not finite."""
    return np.array([np.nan if value is None else value for value in values or ()], dtype=np.float64)


def _tcp_state(data: Row) -> TcpState:
    twist = numbers(data.get("twist"))
    # Recordings before 0.2.0 hold the speed alone.
    return TcpState(pose_of(data), twist if twist.shape == (6,) else np.zeros(6))


def _joint_state(data: Row) -> JointState:
    joints = data.get("joints", ())
    q, dq = (np.array([float(joint.get(key, 0.0)) for joint in joints]) for key in ("position", "velocity"))
    return JointState(q, dq)


def _values(data: Row, t_ns: int) -> Stamped[Array]:
    return Stamped(numbers(data.get("values")), t_ns, int(data.get("seq", 0)))
