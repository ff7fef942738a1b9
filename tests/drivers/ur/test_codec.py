"""RTDE packets against vectors written from the guide by hand, round trips, and damage."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core.errors import CorruptMessage
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.codec import Packet, PacketType, Recipe

# size u16 = header 3 + payload; type is the ASCII code of a letter: V 0x56, v 0x76, O 0x4f, I 0x49, S 0x53, U 0x55.
GOLDEN = [
    (ur_codec.version_request(), "0005 56 0002"),
    (ur_codec.accepted(PacketType.REQUEST_PROTOCOL_VERSION, True), "0004 56 01"),
    (Packet(PacketType.GET_URCONTROL_VERSION), "0003 76"),
    (ur_codec.controller_version(5, 11, 1, 108249), "0013 76 00000005 0000000b 00000001 0001a6d9"),
    # 500.0 as float64: sign 0, exponent 8 + 1023 = 0x407, mantissa 500/256 - 1 = 0xf4 << 44.
    (ur_codec.setup_outputs(500.0, ["timestamp"]), "0014 4f 407f400000000000 74696d657374616d70"),
    (ur_codec.setup_inputs(["a", "b"]), "0006 49 61 2c 62"),
    (ur_codec.recipe_answer(PacketType.SETUP_INPUTS, 7, ["INT32", "BOOL"]), "000e 49 07 494e543332 2c 424f4f4c"),
    (Packet(PacketType.START), "0003 53"),
    (ur_codec.accepted(PacketType.PAUSE, False), "0004 50 00"),
]


@pytest.mark.parametrize(("packet", "wire"), GOLDEN)
def test_golden_vectors_both_ways(packet: Packet, wire: str) -> None:
    assert ur_codec.encode(packet) == bytes.fromhex(wire)
    assert ur_codec.split(bytes.fromhex(wire)) == ([packet], b"")


def test_golden_data_packet() -> None:
    recipe = Recipe(1, ("timestamp", "robot_mode", "joint_mode", "flag"), ("DOUBLE", "INT32", "VECTOR6INT32", "BOOL"))
    values = {"timestamp": 0.5, "robot_mode": -1, "joint_mode": (1, 2, 3, 4, 5, 253), "flag": True}
    wire = "01 3fe0000000000000 ffffffff 00000001 00000002 00000003 00000004 00000005 000000fd 01"
    assert recipe.pack(values) == bytes.fromhex(wire)
    assert recipe.unpack(bytes.fromhex(wire)) == values


def test_parsers_decode_the_vendors_encoding() -> None:
    assert ur_codec.parse_version_request(ur_codec.version_request().payload) == 2
    assert ur_codec.parse_accepted(ur_codec.accepted(PacketType.START, True).payload) is True
    assert ur_codec.parse_controller_version(ur_codec.controller_version(5, 11, 1, 9).payload) == (5, 11, 1, 9)
    assert ur_codec.parse_setup_outputs(ur_codec.setup_outputs(125.0, ["a", "b"]).payload) == (125.0, ("a", "b"))
    granted = ur_codec.recipe_answer(PacketType.SETUP_OUTPUTS, 1, ["DOUBLE"])
    assert ur_codec.parse_recipe_answer(granted.payload, ["timestamp"]) == Recipe(1, ("timestamp",), ("DOUBLE",))


@pytest.mark.parametrize("refusal", ["NOT_FOUND", "IN_USE", "DOUBLE,DOUBLE", ""])
def test_a_refused_or_short_setup_gives_no_recipe(refusal: str) -> None:
    with pytest.raises(CorruptMessage):
        ur_codec.parse_recipe_answer(b"\1" + refusal.encode(), ["timestamp"])


@pytest.mark.parametrize("rate_hz", [math.nan, math.inf, 0.0, -1.0, 501.0])
def test_absurd_rates_are_refused(rate_hz: float) -> None:
    with pytest.raises(CorruptMessage):
        ur_codec.parse_setup_outputs(struct.pack(">d", rate_hz) + b"timestamp")


def test_wrong_recipe_size_or_number_is_refused() -> None:
    recipe = Recipe(2, ("timestamp",), ("DOUBLE",))
    good = recipe.pack({"timestamp": 1.0})
    for bad in (good[:-1], good + b"\0", b"\3" + good[1:], b""):
        with pytest.raises(CorruptMessage):
            recipe.unpack(bad)
    with pytest.raises(CorruptMessage):
        recipe.pack({})
    with pytest.raises(CorruptMessage):
        Recipe(1, ("x",), ("INT32",)).pack({"x": 2**31})


_VALUES = {
    "BOOL": st.booleans(),
    "UINT8": st.integers(0, 2**8 - 1),
    "UINT32": st.integers(0, 2**32 - 1),
    "UINT64": st.integers(0, 2**64 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "DOUBLE": st.floats(allow_nan=False),
    "VECTOR3D": st.tuples(*[st.floats(allow_nan=False)] * 3),
    "VECTOR6D": st.tuples(*[st.floats(allow_nan=False)] * 6),
    "VECTOR6INT32": st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6),
    "VECTOR6UINT32": st.tuples(*[st.integers(0, 2**32 - 1)] * 6),
}


def test_every_type_has_a_round_trip_below() -> None:
    assert set(_VALUES) == ur_codec.TYPE_NAMES


@given(st.data(), st.integers(1, 255), st.lists(st.sampled_from(sorted(_VALUES)), min_size=1, max_size=8))
def test_data_round_trip(data: st.DataObject, number: int, types: list[str]) -> None:
    names = tuple(f"v{i}" for i in range(len(types)))
    recipe = Recipe(number, names, tuple(types))
    values = {name: data.draw(_VALUES[kind]) for name, kind in zip(names, types, strict=True)}
    assert recipe.unpack(recipe.pack(values)) == values


@given(st.lists(st.tuples(st.sampled_from(PacketType), st.binary(max_size=40)), max_size=6), st.integers(0, 60))
def test_streams_split_the_same_wherever_they_are_cut(parts: list[tuple[PacketType, bytes]], cut: int) -> None:
    packets = [Packet(kind, payload) for kind, payload in parts]
    stream = b"".join(map(ur_codec.encode, packets))
    first, rest = ur_codec.split(stream[:cut])
    second, left = ur_codec.split(rest + stream[cut:])
    assert first + second == packets
    assert left == b""


@given(st.integers(0, len(GOLDEN) - 1), st.integers(0, 40), st.integers(0, 255))
def test_damaged_bytes_never_crash_and_never_change_the_framing(which: int, at: int, value: int) -> None:
    wire = bytearray(ur_codec.encode(GOLDEN[which][0]))
    wire[at % len(wire)] = value
    try:
        packets, rest = ur_codec.split(bytes(wire))
    except CorruptMessage:
        return
    # No checksum: what passes is exactly what was on the wire.
    assert b"".join(map(ur_codec.encode, packets)) + rest == bytes(wire)
    parsers = (
        ur_codec.parse_version_request,
        ur_codec.parse_accepted,
        ur_codec.parse_controller_version,
        ur_codec.parse_setup_outputs,
        ur_codec.parse_names,
        lambda payload: ur_codec.parse_recipe_answer(payload, ["a", "b"]),
    )
    for packet in packets:
        for parse in parsers:
            try:
                parse(packet.payload)
            except CorruptMessage:
                continue


def test_too_long_packets_are_refused() -> None:
    with pytest.raises(CorruptMessage):
        ur_codec.encode(Packet(PacketType.TEXT_MESSAGE, bytes(65536)))
