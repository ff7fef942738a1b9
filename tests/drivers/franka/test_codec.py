"""Franka Control Interface on the wire: golden vectors, round trips, mutated bytes."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core.errors import CorruptMessage
from touchcell.drivers.franka.emulator import codec

finite = st.floats(allow_nan=False, allow_infinity=False)
flags = st.binary(min_size=codec.ERROR_COUNT, max_size=codec.ERROR_COUNT).map(lambda raw: bytes(b & 1 for b in raw))


def vector(length: int) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[finite] * length)


commands = st.builds(
    codec.MotionCommand,
    st.integers(0, 2**64 - 1),
    vector(7),
    vector(7),
    vector(16),
    vector(6),
    vector(2),
    st.booleans(),
    st.booleans(),
    vector(7),
    st.booleans(),
)


def test_sizes_are_those_that_libfranka_accepts() -> None:
    # 8 + 4 * 318 + 2 + 41 + 41 + 1 + 4, and 8 + 8 * 38 + 2 + 8 * 7 + 1.
    assert codec.STATE_SIZE == 1377
    assert codec.COMMAND_SIZE == 371
    assert codec.PAYLOAD_SIZE[codec.Request.MOVE] == 113
    assert codec.PAYLOAD_SIZE[codec.Request.SET_COLLISION_BEHAVIOR] == 416


def test_golden_connect() -> None:
    # command 0, id 1, size 16; version 10, UDP port 0xC350 = 50000; all little-endian.
    wire = bytes.fromhex("00000000 01000000 10000000 0a00 50c3")
    assert codec.encode_request(codec.Request.CONNECT, 1, struct.pack("<HH", 10, 50000)) == wire
    (message,), rest = codec.split_requests(wire)
    assert (message.request, message.command_id, rest) == (codec.Request.CONNECT, 1, b"")
    assert codec.decode_connect(message.payload) == (10, 50000)
    # The answer: size 15, status 0, version 10.
    assert codec.connect_reply(1, accepted=True) == bytes.fromhex("00000000 01000000 0f000000 00 0a00")


def test_golden_move_started() -> None:
    # command 1, id 7, size 13, status 1.
    reply = codec.encode_reply(codec.Request.MOVE, 7, codec.MoveStatus.MOTION_STARTED)
    assert reply == bytes.fromhex("01000000 07000000 0d000000 01")


def test_golden_move_of_cartesian_velocity() -> None:
    # Joint impedance controller 0, request generator 3 (Cartesian velocity, which the state calls 4).
    payload = bytes.fromhex("00000000 03000000") + bytes(105)
    assert codec.decode_move(payload) == (codec.Controller.JOINT_IMPEDANCE, codec.Generator.CARTESIAN_VELOCITY)


def test_golden_command() -> None:
    datagram = bytearray(371)
    datagram[0:8] = bytes.fromhex("0201000000000000")
    # O_dP_EE begins after id, q, dq, O_T_EE: 8 + 8 * (7 + 7 + 16) = 248; 0.5 is 3FE0000000000000.
    datagram[248:256] = bytes.fromhex("000000000000e03f")
    datagram[313] = 1
    command = codec.decode_command(bytes(datagram))
    assert command.message_id == 0x102
    assert command.O_dP_EE == (0.5, 0, 0, 0, 0, 0)
    assert (command.has_elbow, command.finished, command.torque_finished) == (False, True, False)


def test_golden_state_fields_are_at_the_offsets_of_the_header_file() -> None:
    state = codec.RobotState(message_id=258, mode=codec.Mode.REFLEX, generator=codec.Generator.CARTESIAN_VELOCITY)
    state["q"] = np.arange(1.0, 8.0)
    state["O_dP_EE_c"] = (0.5, 0, 0, 0, 0, 0)
    state.errors[7] = 1
    wire = state.encode()
    assert wire[:8] == bytes.fromhex("0201000000000000")
    # Before q: six matrices, two loads of 13, two elbows, three torques = 96 + 26 + 4 + 21 = 147 floats.
    assert struct.unpack_from("<7f", wire, 8 + 4 * 147) == (1, 2, 3, 4, 5, 6, 7)
    # From the end: f32 rate, u8 mode, 2 x 41 flags, two enumerations, 36 accelerometer and 14 motor floats, 12 twists.
    tail = len(wire) - 4 - 1 - 82 - 2
    assert struct.unpack_from("<f", wire, tail - 4 * (36 + 14 + 6 + 6)) == (0.5,)
    assert wire[tail] == 4
    assert wire[tail + 2 + 7] == 1
    assert wire[-5] == 4


@given(commands)
def test_command_round_trip(command: codec.MotionCommand) -> None:
    assert codec.decode_command(codec.encode_command(command)) == command


@given(
    st.integers(0, 2**64 - 1),
    st.lists(st.floats(width=32, allow_nan=False), min_size=7, max_size=7),
    flags,
    flags,
    st.sampled_from(codec.Mode),
    st.sampled_from(codec.Generator),
)
def test_state_round_trip(
    message_id: int, q: list[float], errors: bytes, reflex: bytes, mode: codec.Mode, generator: codec.Generator
) -> None:
    state = codec.RobotState(
        message_id, errors=bytearray(errors), reflex_reason=bytearray(reflex), mode=mode, generator=generator
    )
    state["q"] = q
    back = codec.decode_state(state.encode())
    assert back.encode() == state.encode()
    assert back["q"].tolist() == q
    assert (back.message_id, back.mode, back.generator, back.errors) == (message_id, mode, generator, errors)


@given(st.lists(st.sampled_from(codec.Request), min_size=1, max_size=5), st.data())
def test_requests_are_decoded_for_any_fragmentation_of_the_stream(
    requests: list[codec.Request], data: st.DataObject
) -> None:
    stream = b"".join(
        codec.encode_request(request, i, bytes(codec.PAYLOAD_SIZE[request])) for i, request in enumerate(requests)
    )
    cut = data.draw(st.integers(0, len(stream)))
    first, rest = codec.split_requests(stream[:cut])
    second, rest = codec.split_requests(rest + stream[cut:])
    assert [message.request for message in first + second] == requests
    assert [message.command_id for message in first + second] == list(range(len(requests)))
    assert rest == b""


@given(st.binary(max_size=200))
def test_any_bytes_are_decoded_or_refused(stream: bytes) -> None:
    try:
        messages, rest = codec.split_requests(stream)
    except CorruptMessage:
        return
    again = b"".join(codec.encode_request(m.request, m.command_id, m.payload) for m in messages) + rest
    assert again == stream


@given(st.integers(0, codec.STATE_SIZE - 1), st.integers(0, 255))
def test_a_mutated_state_is_refused_or_decoded_faithfully(position: int, value: int) -> None:
    wire = bytearray(codec.RobotState(message_id=5).encode())
    wire[position] = value
    try:
        state = codec.decode_state(bytes(wire))
    except CorruptMessage:
        return
    assert max(state.errors + state.reflex_reason) <= 1
    assert state.encode() == bytes(wire)


@given(st.integers(0, 400).filter(lambda size: size != codec.COMMAND_SIZE))
def test_commands_of_another_size_are_refused(size: int) -> None:
    with pytest.raises(CorruptMessage):
        codec.decode_command(bytes(size))


@pytest.mark.parametrize("position", [312, 313, 370])
def test_flags_other_than_0_and_1_are_refused(position: int) -> None:
    datagram = bytearray(codec.COMMAND_SIZE)
    datagram[position] = 2
    with pytest.raises(CorruptMessage):
        codec.decode_command(bytes(datagram))


@pytest.mark.parametrize(("controller", "generator"), [(3, 0), (0, 5), (2**32 - 1, 0)])
def test_unknown_motions_are_refused(controller: int, generator: int) -> None:
    with pytest.raises(CorruptMessage):
        codec.decode_move(struct.pack("<II", controller, generator) + bytes(105))
