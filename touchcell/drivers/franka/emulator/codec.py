"""Wire format of the Franka Control Interface, version 10: pure functions, no I/O.

Everything is packed and little-endian (libfranka-common, ``service_types.h`` and ``rbk_types.h``). Commands are sent
over TCP port 1337 as ``u32 command, u32 command id, u32 total size`` and a payload; the reply repeats command and id
and begins with a status byte. A Move has two replies with the same id: MOTION_STARTED at once, the outcome later. In
addition the robot sends its state as a UDP datagram each millisecond and receives a command datagram in return. There
are no checksums, so only sizes and enumerations can be checked.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.core.errors import CorruptMessage

VERSION = 10
PORT = 1337
ERROR_COUNT = 41
LARGEST_REQUEST = 1024

_DEVICE = "franka wire"
_HEADER = struct.Struct("<III")
_CONNECT = struct.Struct("<HH")
# After the two deviations of three, libfranka 0.21 sends an asynchronous flag and seven more doubles.
_MOVE = struct.Struct("<II6d?7d")
_COMMAND = struct.Struct("<Q7d7d16d6d2d??7d?")
_STATE_TAIL = struct.Struct(f"<BB{ERROR_COUNT}s{ERROR_COUNT}sBf")
_STATE_ID = struct.Struct("<Q")

STATE_FIELDS: tuple[tuple[str, int], ...] = (
    ("O_T_EE", 16),
    ("O_T_EE_d", 16),
    ("F_T_EE", 16),
    ("EE_T_K", 16),
    ("F_T_NE", 16),
    ("NE_T_EE", 16),
    ("m_ee", 1),
    ("I_ee", 9),
    ("F_x_Cee", 3),
    ("m_load", 1),
    ("I_load", 9),
    ("F_x_Cload", 3),
    ("elbow", 2),
    ("elbow_d", 2),
    ("tau_J", 7),
    ("tau_J_d", 7),
    ("dtau_J", 7),
    ("q", 7),
    ("q_d", 7),
    ("dq", 7),
    ("dq_d", 7),
    ("ddq_d", 7),
    ("joint_contact", 7),
    ("cartesian_contact", 6),
    ("joint_collision", 7),
    ("cartesian_collision", 6),
    ("tau_ext_hat_filtered", 7),
    ("O_F_ext_hat_K", 6),
    ("K_F_ext_hat_K", 6),
    ("O_dP_EE_d", 6),
    ("O_ddP_O", 3),
    ("elbow_c", 2),
    ("delbow_c", 2),
    ("ddelbow_c", 2),
    ("O_T_EE_c", 16),
    ("O_dP_EE_c", 6),
    ("O_ddP_EE_c", 6),
    ("theta", 7),
    ("dtheta", 7),
    ("accelerometer_top", 18),
    ("accelerometer_bottom", 18),
)
"""Names and lengths of the float32 fields of the state, in wire order; matrices are column-major."""

_ENDS = tuple(accumulate(length for _, length in STATE_FIELDS))
_SLICES = {name: slice(end - length, end) for (name, length), end in zip(STATE_FIELDS, _ENDS, strict=True)}
_FLOATS = _ENDS[-1]

STATE_SIZE = _STATE_ID.size + 4 * _FLOATS + _STATE_TAIL.size
COMMAND_SIZE = _COMMAND.size


class Request(IntEnum):
    """Commands over TCP."""

    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    SET_COLLISION_BEHAVIOR = 3
    SET_JOINT_IMPEDANCE = 4
    SET_CARTESIAN_IMPEDANCE = 5
    SET_GUIDING_MODE = 6
    SET_EE_TO_K = 7
    SET_NE_TO_EE = 8
    SET_LOAD = 9
    AUTOMATIC_ERROR_RECOVERY = 10
    GET_ROBOT_MODEL = 11


PAYLOAD_SIZE: dict[Request, int] = {
    Request.CONNECT: _CONNECT.size,
    Request.MOVE: _MOVE.size,
    Request.STOP_MOVE: 0,
    Request.SET_COLLISION_BEHAVIOR: 8 * (4 * 7 + 4 * 6),
    Request.SET_JOINT_IMPEDANCE: 8 * 7,
    Request.SET_CARTESIAN_IMPEDANCE: 8 * 6,
    Request.SET_GUIDING_MODE: 7,
    Request.SET_EE_TO_K: 8 * 16,
    Request.SET_NE_TO_EE: 8 * 16,
    Request.SET_LOAD: 8 * 13,
    Request.AUTOMATIC_ERROR_RECOVERY: 0,
    Request.GET_ROBOT_MODEL: 0,
}
"""Size of each request's payload."""


class MoveStatus(IntEnum):
    """Status at the start or the end of a motion."""

    SUCCESS = 0
    MOTION_STARTED = 1
    PREEMPTED = 2
    PREEMPTED_BY_SAFETY = 3
    REJECTED_BY_SAFETY = 4
    NOT_POSSIBLE = 5
    SINGULAR_START = 6
    INVALID_ARGUMENT = 7
    REFLEX_ABORTED = 8
    EMERGENCY_ABORTED = 9
    INPUT_ERROR_ABORTED = 10
    ABORTED = 11


class SetterStatus(IntEnum):
    """Reply to a setter."""

    SUCCESS = 0
    NOT_POSSIBLE = 1
    INVALID_ARGUMENT = 2


class RecoveryStatus(IntEnum):
    """Reply to an automatic error recovery."""

    SUCCESS = 0
    NOT_POSSIBLE = 1
    REJECTED_BY_SAFETY = 2
    MANUAL_RECOVERY_REQUIRED = 3


class Mode(IntEnum):
    """Robot mode in the state."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERY = 6


class Generator(IntEnum):
    """Motion generator in the state; the numbers in a Move request are one less."""

    IDLE = 0
    JOINT_POSITION = 1
    JOINT_VELOCITY = 2
    CARTESIAN_POSITION = 3
    CARTESIAN_VELOCITY = 4
    NONE = 5


class Controller(IntEnum):
    """Controller in the state."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    OTHER = 3


class RequestMessage(NamedTuple):
    """One request received over TCP."""

    request: Request
    command_id: int
    payload: bytes


class MoveRequest(NamedTuple):
    """Controller and motion generator requested by a Move."""

    controller: Controller
    generator: Generator


class MotionCommand(NamedTuple):
    """One command datagram; only the fields of the running generator are significant."""

    message_id: int
    q: tuple[float, ...]
    dq: tuple[float, ...]
    O_T_EE: tuple[float, ...]
    O_dP_EE: tuple[float, ...]
    elbow: tuple[float, ...]
    has_elbow: bool
    finished: bool
    tau: tuple[float, ...]
    torque_finished: bool


@dataclass(slots=True)
class RobotState:
    """One state datagram: its float32 fields by name, and the other fields."""

    message_id: int = 0
    floats: NDArray[np.float32] = field(default_factory=lambda: np.zeros(_FLOATS, np.float32))
    generator: Generator = Generator.IDLE
    controller: Controller = Controller.OTHER
    errors: bytearray = field(default_factory=lambda: bytearray(ERROR_COUNT))
    reflex_reason: bytearray = field(default_factory=lambda: bytearray(ERROR_COUNT))
    mode: Mode = Mode.IDLE
    success_rate: float = 0.0

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        return self.floats[_SLICES[name]]

    def __setitem__(self, name: str, value: Sequence[float] | NDArray[np.floating] | NDArray[np.bool] | float) -> None:
        self.floats[_SLICES[name]] = value

    def encode(self) -> bytes:
        """Encode the datagram, 1377 bytes."""
        tail = _STATE_TAIL.pack(
            self.generator, self.controller, self.errors, self.reflex_reason, self.mode, self.success_rate
        )
        return _STATE_ID.pack(self.message_id) + self.floats.tobytes() + tail


def decode_state(datagram: bytes) -> RobotState:
    """Decode a state datagram. Raises CorruptMessage for a wrong size or an unknown enumeration."""
    if len(datagram) != STATE_SIZE:
        raise CorruptMessage(_DEVICE, f"state of {len(datagram)} bytes, not {STATE_SIZE}")
    generator, controller, errors, reflex, mode, rate = _STATE_TAIL.unpack_from(datagram, STATE_SIZE - _STATE_TAIL.size)
    if max(errors + reflex) > 1:
        raise CorruptMessage(_DEVICE, "error flag that is neither 0 nor 1")
    try:
        return RobotState(
            _STATE_ID.unpack_from(datagram)[0],
            np.frombuffer(datagram, "<f4", _FLOATS, _STATE_ID.size).copy(),
            Generator(generator),
            Controller(controller),
            bytearray(errors),
            bytearray(reflex),
            Mode(mode),
            rate,
        )
    except ValueError as error:
        raise CorruptMessage(_DEVICE, str(error)) from None


def encode_command(command: MotionCommand) -> bytes:
    """Encode the command datagram, 371 bytes."""
    return _COMMAND.pack(
        command.message_id,
        *command.q,
        *command.dq,
        *command.O_T_EE,
        *command.O_dP_EE,
        *command.elbow,
        command.has_elbow,
        command.finished,
        *command.tau,
        command.torque_finished,
    )


def decode_command(datagram: bytes) -> MotionCommand:
    """Decode a command datagram. Raises CorruptMessage for a wrong size or a flag that is neither 0 nor 1."""
    if len(datagram) != COMMAND_SIZE:
        raise CorruptMessage(_DEVICE, f"command of {len(datagram)} bytes, not {COMMAND_SIZE}")
    if datagram[312] > 1 or datagram[313] > 1 or datagram[370] > 1:
        raise CorruptMessage(_DEVICE, "flag that is neither 0 nor 1")
    v = _COMMAND.unpack(datagram)
    return MotionCommand(v[0], v[1:8], v[8:15], v[15:31], v[31:37], v[37:39], v[39], v[40], v[41:48], v[48])


def split_requests(buffer: bytes) -> tuple[list[RequestMessage], bytes]:
    """Split a TCP stream into complete requests and the rest. Raises CorruptMessage for an invalid stream."""
    messages = []
    while len(buffer) >= _HEADER.size:
        number, command_id, size = _HEADER.unpack_from(buffer)
        try:
            request = Request(number)
        except ValueError:
            raise CorruptMessage(_DEVICE, f"unknown request {number}") from None
        if size != _HEADER.size + PAYLOAD_SIZE[request]:
            raise CorruptMessage(_DEVICE, f"{request.name} of {size} bytes")
        if len(buffer) < size:
            break
        messages.append(RequestMessage(request, command_id, buffer[_HEADER.size : size]))
        buffer = buffer[size:]
    return messages, buffer


def encode_request(request: Request, command_id: int, payload: bytes = b"") -> bytes:
    """Encode a request with its header."""
    return _HEADER.pack(request, command_id, _HEADER.size + len(payload)) + payload


def encode_reply(request: Request, command_id: int, status: int, payload: bytes = b"") -> bytes:
    """Encode a reply with its header and status byte."""
    return _HEADER.pack(request, command_id, _HEADER.size + 1 + len(payload)) + bytes([status]) + payload


def decode_connect(payload: bytes) -> tuple[int, int]:
    """Return (version, UDP port of the client) of a CONNECT payload."""
    version, port = _CONNECT.unpack(payload)
    return version, port


def connect_reply(command_id: int, accepted: bool, version: int = VERSION) -> bytes:
    """Encode the reply to CONNECT: success, or "incompatible version" with the supported version."""
    return encode_reply(Request.CONNECT, command_id, 0 if accepted else 1, struct.pack("<H", version))


def decode_move(payload: bytes) -> MoveRequest:
    """Decode a MOVE payload. Raises CorruptMessage for an unknown controller or generator."""
    controller, generator = _MOVE.unpack(payload)[:2]
    if controller > Controller.EXTERNAL or generator > Generator.NONE - 1:
        raise CorruptMessage(_DEVICE, f"controller {controller} with motion generator {generator}")
    return MoveRequest(Controller(controller), Generator(generator + 1))


def doubles(payload: bytes) -> NDArray[np.float64]:
    """Return the float64 values of a setter's payload."""
    return np.frombuffer(payload, "<f8")
