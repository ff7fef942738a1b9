"""Recorded traffic of Damiao motors: which frame answers which, and what contradicts our codec and emulator.

A capture is a file that python-can reads (candump ``.log``, ``.asc``, ``.blf``, ``.trc``), of any client. No I/O but
the reading of that file.
"""

from __future__ import annotations

import statistics
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import can

from touchcell.drivers.core.errors import CodecError
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.codec import Ranges, Register
from touchcell.errors import ConfigError

Request = tuple[str, int]
"""Kind of a request, "read", "write", "state", "command" or "mit", and its register or last byte."""

_OPERATIONS: Final = {0x33: "read", 0x55: "write", 0xCC: "state"}
_HIGHEST_ESC_ID: Final = 0x0F
_ANSWERED_WITHIN_S: Final = 0.1
_SCALES: Final = (Register.PMAX, Register.VMAX, Register.TMAX)


@dataclass(frozen=True, slots=True)
class Frame:
    """One recorded frame: time in s, arbitration id, data."""

    t_s: float
    number: int
    data: bytes


@dataclass(slots=True)
class RecordedMotor:
    """What a capture knows of one motor.

    Attributes:
        esc_id, mst_id: ids of its commands and of its replies; ``mst_id`` is None if it never replied.
        replies: the answers to each request, in order.
        delays_s: time from each request to its answer.
        unanswered: number of requests without an answer.
    """

    esc_id: int
    mst_id: int | None = None
    replies: dict[Request, list[bytes]] = field(default_factory=dict)
    delays_s: list[float] = field(default_factory=list)
    unanswered: int = 0

    def register(self, register: int) -> float | int | None:
        """Return the value of a register when it was last read, or None. Raises CodecError."""
        for data in reversed(self.replies.get(("read", register), [])):
            if (reply := codec.decode_register_reply(data, self.esc_id, register)) is not None:
                return reply.value
        return None

    def ranges(self) -> Ranges | None:
        """Return the full scales that the motor reported, None where not all were read. Raises CodecError."""
        found = [self.register(register) for register in _SCALES]
        return None if None in found else Ranges(*(float(value) for value in found if value is not None))


@dataclass(slots=True)
class Capture:
    """The motors of a capture, by ``esc_id``, and the ids of frames that belong to none."""

    motors: dict[int, RecordedMotor] = field(default_factory=dict)
    others: Counter[int] = field(default_factory=Counter)
    frames: int = 0


def read_frames(path: Path) -> Iterator[Frame]:
    """Yield the data frames of a file. Raises ConfigError naming the file."""
    try:
        with can.LogReader(path) as reader:
            for message in reader:
                if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                    yield Frame(message.timestamp, message.arbitration_id, bytes(message.data))
    except (OSError, ValueError, IndexError, KeyError) as error:
        raise ConfigError(
            f"is no capture of a CAN bus: {error}",
            file=str(path),
            hint="record one with `candump -L can0 > session.log`; .asc, .blf and .trc are read too",
        ) from None


def assign(frames: Iterable[Frame]) -> Capture:
    """Return who sent which frame: requests by their id and form, replies by the request that they follow."""
    ordered = list(frames)
    capture = Capture(frames=len(ordered))
    for frame in ordered:
        if frame.number == codec.PARAMETER_ID and len(frame.data) == 8:
            motor, operation, _, _ = codec.decode_parameter_request(frame.data)
            if operation in _OPERATIONS:
                capture.motors.setdefault(motor, RecordedMotor(motor))
        elif _is_special(frame):
            capture.motors.setdefault(frame.number, RecordedMotor(frame.number))
    for known in capture.motors.values():
        seen = Counter(
            frame.number for frame in ordered if _request(frame, capture.motors) is None and _names(frame, known.esc_id)
        )
        known.mst_id = seen.most_common(1)[0][0] if seen else None
    pending: dict[int, deque[tuple[float, Request]]] = {motor: deque() for motor in capture.motors}
    for frame in ordered:
        if (asked := _request(frame, capture.motors)) is not None:
            motor, request = asked
            pending[motor].append((frame.t_s, request))
        elif not _take_reply(frame, capture, pending):
            capture.others[frame.number] += 1
    for motor, left in pending.items():
        capture.motors[motor].unanswered += len(left)
    return capture


def judge(capture: Capture, emulated_registers: Collection[int]) -> Iterator[str]:
    """Yield what in a capture contradicts our codec or our emulator, one line each; nothing if nothing does.

    Args:
        capture: recorded traffic.
        emulated_registers: registers that the emulator has.
    """
    if not capture.motors:
        yield f"none of {capture.frames} frames is a request to a motor: is it a capture of Damiao motors?"
    for number, count in sorted(capture.others.items()):
        yield f"{count} frames with id {number:#x} belong to no request and no motor"
    for motor in capture.motors.values():
        yield from _judge_motor(motor, emulated_registers)


def describe(capture: Capture) -> Iterator[str]:
    """Yield a line for each motor: ids, requests, how fast it answers."""
    for motor in capture.motors.values():
        answers = len(motor.delays_s)
        master = "no reply" if motor.mst_id is None else f"replies on {motor.mst_id:#x}"
        line = f"motor {motor.esc_id}: {master}, {answers} answers, {motor.unanswered} requests without one"
        if motor.delays_s:
            typical_ms, longest_ms = 1e3 * statistics.median(motor.delays_s), 1e3 * max(motor.delays_s)
            line += f"; answers after {typical_ms:.2f} ms, at most {longest_ms:.2f} ms"
        yield line


def _judge_motor(motor: RecordedMotor, emulated_registers: Collection[int]) -> Iterator[str]:
    name = f"motor {motor.esc_id}"
    if motor.mst_id is None:
        yield f"{name} never replied"
        return
    try:
        ranges = motor.ranges()
    except CodecError as error:
        yield f"{name}: full scales: {error}"
        return
    refused: Counter[str] = Counter()
    for (kind, key), replies in motor.replies.items():
        for data in replies:
            if problem := _problem(motor, kind, key, data, ranges):
                refused[problem] += 1
    for problem, count in refused.items():
        yield f"{name}: {count} replies: {problem}"
    for kind, key in motor.replies:
        if kind == "read" and key not in emulated_registers:
            yield f"{name}: register {key} exists, and not in the emulator"
    longest_s = max(motor.delays_s, default=0.0)
    if longest_s > _ANSWERED_WITHIN_S:
        yield f"{name}: an answer took {longest_s:.3f} s, longer than the driver waits ({_ANSWERED_WITHIN_S} s)"


def _problem(motor: RecordedMotor, kind: str, key: int, data: bytes, ranges: Ranges | None) -> str:
    """Return what is wrong with a reply; "" if nothing is."""
    try:
        if kind in ("read", "write"):
            reply = codec.decode_register_reply(data, motor.esc_id, key)
            return "" if reply is not None else f"no register reply to a {kind} of register {key}"
        state = codec.decode_feedback(data, motor.esc_id, ranges or Ranges(12.5, 30.0, 10.0))
    except CodecError as error:
        return str(error)
    fault = codec.fault(state.status)
    known = fault is None or state.status in codec.FAULTS
    return "" if known else f"status {state.status:#x}, which is not documented"


def _is_special(frame: Frame) -> bool:
    data = frame.data
    special = len(data) == 8 and data[:7] == codec.ENABLE[:7] and data[7] >= codec.CLEAR_ERROR[7]
    return special and 0 < frame.number <= _HIGHEST_ESC_ID


def _request(frame: Frame, motors: Mapping[int, RecordedMotor]) -> tuple[int, Request] | None:
    if len(frame.data) != 8:
        return None
    if frame.number == codec.PARAMETER_ID:
        motor, operation, register, _ = codec.decode_parameter_request(frame.data)
        kind = _OPERATIONS.get(operation)
        if kind is None or motor not in motors:
            return None
        return motor, (kind, 0 if kind == "state" else register)
    if frame.number not in motors:
        return None
    return frame.number, ("command", frame.data[7]) if _is_special(frame) else ("mit", 0)


def _take_reply(frame: Frame, capture: Capture, pending: Mapping[int, deque[tuple[float, Request]]]) -> bool:
    """Assign a frame to the oldest pending request of the motor that sends on its id; return whether there is one."""
    if len(frame.data) != 8:
        return False
    for esc_id, queue in pending.items():
        motor = capture.motors[esc_id]
        if motor.mst_id != frame.number or not queue:
            continue
        if codec.is_register_reply(frame.data, esc_id) and any(_fits(request, frame.data) for _, request in queue):
            # A register reply identifies its request: those before it were lost.
            while not _fits(queue[0][1], frame.data):
                queue.popleft()
                motor.unanswered += 1
        asked_s, request = queue.popleft()
        motor.replies.setdefault(request, []).append(frame.data)
        motor.delays_s.append(frame.t_s - asked_s)
        return True
    return False


def _names(frame: Frame, esc_id: int) -> bool:
    """Return whether a frame could be a reply of that motor, by the id in its data."""
    data = frame.data
    return len(data) == 8 and (codec.is_register_reply(data, esc_id) or data[0] & 0xF == esc_id & 0xF)


def _fits(request: Request, data: bytes) -> bool:
    kind, register = request
    return (kind, register) == (_OPERATIONS.get(data[2]), data[3])
