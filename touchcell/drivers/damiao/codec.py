"""Wire format of Damiao motors on CAN: pure functions between bytes and values, no I/O.

Standard 11-bit frames of eight bytes. A motor sends only replies: every frame to its id (``esc_id``) or to the
parameter id 0x7FF is answered on its master id (``mst_id``). Sources: the manufacturer's "DM-J series" CAN protocol
pages as restated by the MIT-licensed damiao-motor 1.0.6, LeRobot and i2rt; there is no checksum beyond CAN's own.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType

from touchcell.drivers.core.errors import CodecError, FaultClass, Remedy

PARAMETER_ID = 0x7FF
KP_MAX = 500.0
KD_MAX = 5.0
TIMEOUT_TICK_S = 50e-6

ENABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfc"
DISABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfd"
SET_ZERO = b"\xff\xff\xff\xff\xff\xff\xff\xfe"
CLEAR_ERROR = b"\xff\xff\xff\xff\xff\xff\xff\xfb"

_READ, _WRITE, _REQUEST_FEEDBACK = 0x33, 0x55, 0xCC


class Register(IntEnum):
    """Registers that the driver uses."""

    MST_ID = 7
    ESC_ID = 8
    TIMEOUT = 9
    CTRL_MODE = 10
    PMAX = 21
    VMAX = 22
    TMAX = 23


MIT_MODE, POSITION_MODE, VELOCITY_MODE, FORCE_MODE = 1, 2, 3, 4
"""Values of ``Register.CTRL_MODE``: impedance; position at a speed; speed; position at a speed and a torque."""

MODE_ID_STEP = 0x100
"""A motor hears commands of mode m on its ``esc_id`` plus m - 1 times this."""

_FLOAT_REGISTERS = frozenset([*range(0, 7), *range(11, 13), *range(17, 35), *range(50, 57), *range(59, 66), 80, 81])


@dataclass(frozen=True, slots=True)
class Ranges:
    """Full scales of one motor, from its registers 21, 22 and 23: position, velocity and torque range from minus to
    plus these values."""

    position_rad: float
    velocity_rad_s: float
    torque_n_m: float

    def __post_init__(self) -> None:
        for field in ("position_rad", "velocity_rad_s", "torque_n_m"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0.0):
                raise CodecError(field, value, "is not a valid full scale")


@dataclass(frozen=True, slots=True)
class MitCommand:
    """One impedance command: the motor's torque is kp (q - q_motor) + kd (dq - dq_motor) + tau."""

    q: float
    dq: float
    kp: float
    kd: float
    tau: float


@dataclass(frozen=True, slots=True)
class LoopCommand:
    """Command of a mode in which the motor closes the loop itself.

    Attributes:
        q: goal in rad; NaN in speed mode, which has none.
        dq: speed, or largest speed on the way to the goal, rad/s.
        torque_share: largest torque, as a share of ``Ranges.torque_n_m``.
    """

    q: float
    dq: float
    torque_share: float = 1.0


@dataclass(frozen=True, slots=True)
class Feedback:
    """State reply of a motor.

    Attributes:
        motor: low four bits of its ``esc_id``.
        status: see ``STATUS_NAMES``.
        q, dq, tau: rad, rad/s, N m, of the output shaft.
        mos_c, rotor_c: temperatures of driver and winding in degrees Celsius.
    """

    motor: int
    status: int
    q: float
    dq: float
    tau: float
    mos_c: int
    rotor_c: int


@dataclass(frozen=True, slots=True)
class RegisterReply:
    """Reply to a register read, or to a write, which only echoes the value to be written."""

    motor: int
    register: int
    value: float | int
    written: bool = False


@dataclass(frozen=True, slots=True)
class StatusCode:
    """Meaning of one value of the status nibble: fault class, remedy and hint."""

    name: str
    fault_class: FaultClass
    needs: Remedy
    hint: str


DISABLED = 0x0
ENABLED = 0x1
LOST_COMMUNICATION = 0xD

FAULTS: Mapping[int, StatusCode] = MappingProxyType(
    {
        0x5: StatusCode(
            "sensor error", FaultClass.INTERNAL, Remedy.SERVICE, "implausible encoder readings; have the motor checked"
        ),
        0x6: StatusCode(
            "parameter error",
            FaultClass.CONFIGURATION,
            Remedy.SERVICE,
            "rewrite the motor's parameters in the workshop",
        ),
        0x8: StatusCode(
            "over-voltage",
            FaultClass.ELECTRICAL,
            Remedy.OPERATOR,
            "check the supply; braking feeds energy back into it",
        ),
        0x9: StatusCode(
            "under-voltage",
            FaultClass.ELECTRICAL,
            Remedy.OPERATOR,
            "check the supply and the emergency stop's contactor",
        ),
        0xA: StatusCode(
            "over-current", FaultClass.OVERLOAD, Remedy.RECOVER, "check for a collision or a short circuit"
        ),
        0xB: StatusCode("driver too hot", FaultClass.THERMAL, Remedy.RECOVER, "let it cool down"),
        0xC: StatusCode("winding too hot", FaultClass.THERMAL, Remedy.RECOVER, "let it cool down and lower the load"),
        0xD: StatusCode(
            "lost communication",
            FaultClass.COMMUNICATION,
            Remedy.RECOVER,
            "the host was silent for longer than the motor's timeout, which disabled it: the arm may have sunk",
        ),
        0xE: StatusCode("overload", FaultClass.OVERLOAD, Remedy.RECOVER, "lower the load"),
    }
)
"""Status nibbles that are faults. 0 and 1 are normal; the rest are not documented and count as internal faults."""


def fault(status: int) -> StatusCode | None:
    """Return the fault of a status nibble, or None for a healthy motor."""
    if status in (DISABLED, ENABLED):
        return None
    undocumented = StatusCode(f"undocumented status {status:#x}", FaultClass.INTERNAL, Remedy.SERVICE, "ask Damiao")
    return FAULTS.get(status, undocumented)


def encode_mit(command: MitCommand, ranges: Ranges) -> bytes:
    """Encode eight bytes: q 16 bit, dq, kp, kd, tau 12 bit each, big-endian, linear over the range, rounded to nearest.

    Raises:
        CodecError: a value is not finite or out of range (values are never saturated silently), or all are so near
            their upper ends that a motor would interpret the bytes as a special command.
    """
    q = _steps("q", command.q, -ranges.position_rad, ranges.position_rad, 16)
    dq = _steps("dq", command.dq, -ranges.velocity_rad_s, ranges.velocity_rad_s, 12)
    kp = _steps("kp", command.kp, 0.0, KP_MAX, 12)
    kd = _steps("kd", command.kd, 0.0, KD_MAX, 12)
    tau = _steps("tau", command.tau, -ranges.torque_n_m, ranges.torque_n_m, 12)
    data = (q << 48 | dq << 36 | kp << 24 | kd << 12 | tau).to_bytes(8, "big")
    if data[:7] == ENABLE[:7] and data[7] >= CLEAR_ERROR[7]:
        raise CodecError("command", command, "would be interpreted as enable, disable, set zero or clear error")
    return data


def decode_mit(data: bytes, ranges: Ranges) -> MitCommand:
    """Decode the bytes of ``encode_mit``, to within half a step. Raises CodecError for a wrong length."""
    _require_length(data)
    bits = int.from_bytes(data, "big")
    return MitCommand(
        _value(bits >> 48, -ranges.position_rad, ranges.position_rad, 16),
        _value(bits >> 36 & 0xFFF, -ranges.velocity_rad_s, ranges.velocity_rad_s, 12),
        _value(bits >> 24 & 0xFFF, 0.0, KP_MAX, 12),
        _value(bits >> 12 & 0xFFF, 0.0, KD_MAX, 12),
        _value(bits & 0xFFF, -ranges.torque_n_m, ranges.torque_n_m, 12),
    )


def decode_loop(data: bytes, mode: int) -> LoopCommand:
    """Decode a command of ``POSITION_MODE``, ``VELOCITY_MODE`` or ``FORCE_MODE``. Raises CodecError."""
    _require_length(data)
    if mode == VELOCITY_MODE:
        q, dq, share = math.nan, struct.unpack_from("<f", data)[0], 1.0
    elif mode == POSITION_MODE:
        (q, dq), share = struct.unpack("<ff", data), 1.0
    else:
        q, speed_steps, share_steps = struct.unpack("<fHH", data)
        dq, share = speed_steps / 100.0, min(share_steps, 10_000) / 10_000.0
    if not (math.isfinite(dq) and (mode == VELOCITY_MODE or math.isfinite(q))):
        raise CodecError("command", data.hex(), "is not finite")
    return LoopCommand(q, dq, share)


def encode_feedback(feedback: Feedback, ranges: Ranges) -> bytes:
    """Encode eight bytes as a motor sends them: status and id, q 16 bit, dq and tau 12 bit, two temperatures."""
    q = _steps("q", feedback.q, -ranges.position_rad, ranges.position_rad, 16)
    dq = _steps("dq", feedback.dq, -ranges.velocity_rad_s, ranges.velocity_rad_s, 12)
    tau = _steps("tau", feedback.tau, -ranges.torque_n_m, ranges.torque_n_m, 12)
    head = feedback.status << 4 | feedback.motor & 0xF
    return (head << 56 | q << 40 | dq << 28 | tau << 16 | feedback.mos_c << 8 | feedback.rotor_c).to_bytes(8, "big")


def decode_feedback(data: bytes, motor: int, ranges: Ranges) -> Feedback:
    """Decode the reply of motor ``motor`` (its ``esc_id``).

    Raises:
        CodecError: wrong length, or a reply of another motor.
    """
    _require_length(data)
    if data[0] & 0xF != motor & 0xF:
        raise CodecError("motor", data[0] & 0xF, f"answered instead of {motor & 0xF}")
    bits = int.from_bytes(data, "big")
    return Feedback(
        motor=data[0] & 0xF,
        status=data[0] >> 4,
        q=_value(bits >> 40 & 0xFFFF, -ranges.position_rad, ranges.position_rad, 16),
        dq=_value(bits >> 28 & 0xFFF, -ranges.velocity_rad_s, ranges.velocity_rad_s, 12),
        tau=_value(bits >> 16 & 0xFFF, -ranges.torque_n_m, ranges.torque_n_m, 12),
        mos_c=data[6],
        rotor_c=data[7],
    )


def request_feedback(motor: int) -> bytes:
    """Return the data of the frame to ``PARAMETER_ID`` that requests a motor's state without commanding it."""
    return struct.pack("<HB5x", motor, _REQUEST_FEEDBACK)


def read_register(motor: int, register: int) -> bytes:
    """Return the data of the frame to ``PARAMETER_ID`` that requests a register."""
    return struct.pack("<HBB4x", motor, _READ, register)


def write_register(motor: int, register: int, value: float | int) -> bytes:
    """Return the data of the frame to ``PARAMETER_ID`` that sets a register until the next power cycle.

    Raises:
        CodecError: the value does not fit the register.
    """
    return struct.pack("<HBB", motor, _WRITE, register) + _register_bytes(register, value)


def encode_register_reply(motor: int, register: int, value: float | int, *, write: bool = False) -> bytes:
    """Encode a motor's reply: the request's first four bytes and the value."""
    head = struct.pack("<HBB", motor, _WRITE if write else _READ, register)
    is_float = register in _FLOAT_REGISTERS
    return head + (struct.pack("<f", value) if is_float else struct.pack("<I", value))


def is_register_reply(data: bytes, motor: int) -> bool:
    """Return whether ``data`` is a register reply of ``motor``: its id in 16 bits, then read or write.

    The state of a disabled motor at the lower end of its range (within 0.03 rad of -12.5) can have the same bytes.
    """
    return len(data) == 8 and data[:2] == struct.pack("<H", motor) and data[2] in (_READ, _WRITE)


def decode_register_reply(data: bytes, motor: int, register: int) -> RegisterReply | None:
    """Decode the reply of ``motor`` for ``register``; None if the bytes are something else, such as its state.

    Raises:
        CodecError: the value is a float that is not finite.
    """
    if not is_register_reply(data, motor) or data[3] != register:
        return None
    written = data[2] == _WRITE
    if register in _FLOAT_REGISTERS:
        (real,) = struct.unpack_from("<f", data, 4)
        if not math.isfinite(real):
            raise CodecError(f"register {register}", real, "is not finite")
        return RegisterReply(motor, register, real, written)
    (whole,) = struct.unpack_from("<I", data, 4)
    return RegisterReply(motor, register, whole, written)


def decode_parameter_request(data: bytes) -> tuple[int, int, int, bytes]:
    """Decode a frame to ``PARAMETER_ID``: motor, operation, register, four bytes of value."""
    _require_length(data)
    motor, operation, register = struct.unpack_from("<HBB", data)
    return motor, operation, register, data[4:]


def frame_time_s(bitrate: int, data_bitrate: int | None = None) -> float:
    """Return the longest time that one eight-byte standard frame takes on the bus, with worst-case stuff bits.

    Args:
        bitrate: bit/s, of the arbitration phase for CAN FD.
        data_bitrate: bit/s of the data phase for CAN FD with bit rate switching; None for classic CAN.

    Source: ISO 11898-1 frame formats. Classic: 111 bits and at most 24 stuff bits. FD: 30 bits and at most 4 stuff
    bits at ``bitrate``; 96 bits (ESI, DLC, data, stuff count, 17-bit CRC with its fixed stuff bits) and at most 17
    stuff bits at ``data_bitrate``.
    """
    if data_bitrate is None:
        return 135 / bitrate
    return 34 / bitrate + 113 / data_bitrate


def bus_load(motors: int, rate_hz: float, bitrate: int, data_bitrate: int | None = None) -> float:
    """Return the worst-case fraction of the bus used by a command and a reply per motor at ``rate_hz``."""
    return 2 * motors * rate_hz * frame_time_s(bitrate, data_bitrate)


def _steps(field: str, value: float, low: float, high: float, bits: int) -> int:
    # The comparison is written so that NaN fails it.
    if not low <= value <= high:
        raise CodecError(field, value, f"is not in [{low:g}, {high:g}]")
    return round((value - low) * ((1 << bits) - 1) / (high - low))


def _value(steps: int, low: float, high: float, bits: int) -> float:
    return low + steps * (high - low) / ((1 << bits) - 1)


def _register_bytes(register: int, value: float | int) -> bytes:
    if register in _FLOAT_REGISTERS:
        if not math.isfinite(value):
            raise CodecError(f"register {register}", value, "is not finite")
        return struct.pack("<f", value)
    if not (isinstance(value, int) and 0 <= value < 1 << 32):
        raise CodecError(f"register {register}", value, "is not an unsigned 32-bit number")
    return struct.pack("<I", value)


def _require_length(data: bytes) -> None:
    if len(data) != 8:
        raise CodecError("data", data.hex(), "is not eight bytes long")
