from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core.errors import CodecError, FaultClass, Remedy
from touchcell.drivers.feetech import codec
from touchcell.drivers.feetech.codec import Packet, Register

packets = st.builds(Packet, st.integers(0, 254), st.integers(0, 255), st.binary(max_size=40))


def test_ping_and_its_answer_golden() -> None:
    # Sum 01+02+01 = 04, inverted FB; sum 01+02+00 = 03, inverted FC.
    assert codec.encode(Packet(1, 1)) == bytes.fromhex("FFFF 01 02 01 FB")
    assert codec.split(bytes.fromhex("FFFF 01 02 00 FC")).packets == (Packet(1, 0),)


def test_read_golden() -> None:
    # Two bytes from 56 (0x38): 01+04+02+38+02 = 41, inverted BE.
    assert codec.read(1, Register.POSITION, 2) == bytes.fromhex("FFFF 01 04 02 38 02 BE")
    # 0x0518 = 1304 ticks, low byte first: 01+04+00+18+05 = 22, inverted DD.
    (answer,) = codec.split(bytes.fromhex("FFFF 01 04 00 18 05 DD")).packets
    assert codec.from_signed_word(answer.data) == 1304


def test_write_golden() -> None:
    # Torque on for servo 3: 03+04+03+28+01 = 33, inverted CC.
    assert codec.write(3, Register.TORQUE_ENABLE, b"\x01") == bytes.fromhex("FFFF 03 04 03 28 01 CC")


def test_sync_read_golden() -> None:
    # Eight bytes from 0x38 of servos 1 and 2: FE+06+82+38+08+01+02 = 1C9, low byte C9, inverted 36.
    assert codec.sync_read((1, 2), Register.POSITION, 8) == bytes.fromhex("FFFF FE 06 82 38 08 01 02 36")


def test_sync_write_golden() -> None:
    # Goals 2048 = 00 08 and 1000 = E8 03 at 0x2A; length 4 + 2 * 3 = 10.
    # FE+0A+83+2A+02+01+00+08+02+E8+03 = 2AD, low byte AD, inverted 52.
    goals = {1: codec.signed_word(2048), 2: codec.signed_word(1000)}
    wanted = bytes.fromhex("FFFF FE 0A 83 2A 02 01 0008 02 E803 52")
    assert codec.sync_write(Register.GOAL_POSITION, goals) == wanted


def test_signs_are_separate_bits() -> None:
    assert codec.signed_word(-100) == bytes.fromhex("6480")
    assert codec.from_signed_word(bytes.fromhex("6480")) == -100
    # Load: bit 10; homing offset: bit 11.
    assert codec.from_signed_word(codec.word(0x400 | 250), 10) == -250
    assert codec.from_signed_word(codec.word(0x800 | 85), 11) == -85


@given(st.integers(1, 15).flatmap(lambda bit: st.tuples(st.just(bit), st.integers(1 - 2**bit, 2**bit - 1))))
def test_signed_words_round_trip(case: tuple[int, int]) -> None:
    bit, value = case
    assert codec.from_signed_word(codec.signed_word(value, bit), bit) == value


def test_goal_golden() -> None:
    # 2048 ticks, no time, 150 units of speed: never 0, which is the fastest or none, as the servo likes.
    assert codec.goal(2048, 150) == bytes.fromhex("0008 0000 9600")
    with pytest.raises(CodecError):
        codec.goal(2048, 0)


@pytest.mark.parametrize("value", [32768, -32768, 10**9])
def test_what_does_not_fit_is_refused(value: int) -> None:
    with pytest.raises(CodecError):
        codec.signed_word(value)


def test_impossible_packets_are_refused() -> None:
    with pytest.raises(CodecError):
        codec.encode(Packet(255, 1))
    with pytest.raises(CodecError):
        codec.encode(Packet(1, 3, bytes(254)))
    with pytest.raises(CodecError):
        codec.sync_write(42, {1: b"\0\0", 2: b"\0"})


@given(st.lists(packets, max_size=5), st.integers(0, 300))
def test_packets_are_decoded_for_any_fragmentation_of_the_stream(sent: list[Packet], cut: int) -> None:
    stream = b"".join(codec.encode(packet) for packet in sent)
    first = codec.split(stream[:cut])
    second = codec.split(first.rest + stream[cut:])
    assert list(first.packets + second.packets) == sent
    assert (first.damaged, second.damaged, second.rest) == (0, 0, b"")


@given(packets, st.data())
def test_a_corrupt_packet_never_passes_for_the_expected_reply(packet: Packet, data: st.DataObject) -> None:
    good = codec.encode(packet)
    at = data.draw(st.integers(0, len(good) - 1))
    wrong = good[:at] + bytes([good[at] ^ data.draw(st.integers(1, 255))]) + good[at + 1 :]
    for found in codec.split(wrong).packets:
        # A damaged length may cut out a piece whose checksum fits: its length betrays it.
        assert (found.servo, len(found.data)) != (packet.servo, len(packet.data))


@given(st.binary(max_size=200))
def test_any_bytes_are_packets_with_a_right_checksum_or_nothing(noise: bytes) -> None:
    found = codec.split(noise)
    for packet in found.packets:
        assert codec.encode(packet) in noise
    assert noise.endswith(found.rest)


@given(packets, st.binary(max_size=10).filter(lambda noise: b"\xff" not in noise))
def test_noise_before_a_packet_is_skipped_and_counted(packet: Packet, noise: bytes) -> None:
    found = codec.split(noise + codec.encode(packet))
    assert found.packets == (packet,)
    assert found.damaged == bool(noise)


def test_a_damaged_length_does_not_swallow_the_next_packet() -> None:
    first, second = codec.encode(Packet(1, 0, bytes(15))), codec.encode(Packet(2, 0, bytes(15)))
    damaged = first[:3] + b"\x80" + first[4:]
    assert codec.split(damaged + second, longest=15).packets == (Packet(2, 0, bytes(15)),)


def state_block(start: int) -> bytes:
    """A servo at 3000 ticks with torque, goal 3001, speed -50, load -0.25, 12.1 V, 31 C, overload, 65 mA."""
    table = bytearray(128)
    table[40] = 1
    table[42:44] = (3001).to_bytes(2, "little")
    table[48:50] = (600).to_bytes(2, "little")
    table[56:58] = (3000).to_bytes(2, "little")
    table[58:60] = (0x8000 | 50).to_bytes(2, "little")
    table[60:62] = (0x400 | 250).to_bytes(2, "little")
    table[62], table[63], table[65] = 121, 31, 0x20
    table[69:71] = (10).to_bytes(2, "little")
    return bytes(table[start:71])


@pytest.mark.parametrize("start", codec.STATE_STARTS)
def test_every_state_block_decodes_to_the_same_state(start: int) -> None:
    data = state_block(start)
    assert len(data) == codec.state_length(start)
    state = codec.decode_state(data)
    assert state == codec.ServoState(1, 3001, 600, 3000, -50, -0.25, 12.1, 31, 0x20, pytest.approx(0.065))


def test_state_blocks_have_sixteen_lengths_that_no_other_reply_has() -> None:
    assert sorted(codec.state_length(start) for start in codec.STATE_STARTS) == list(range(31, 47))
    assert codec.IDENTITY_LENGTH not in range(31, 47)


@pytest.mark.parametrize("position", [8192, 32767, 0x9000])
def test_positions_more_than_a_turn_out_of_range_are_refused(position: int) -> None:
    data = bytearray(state_block(40))
    data[16:18] = position.to_bytes(2, "little")
    with pytest.raises(CodecError) as caught:
        codec.decode_state(bytes(data))
    assert caught.value.field == "position"


@pytest.mark.parametrize(("raw", "position"), [(0x8014, -20), (4100, 4100)])
def test_a_homing_offset_may_move_the_count_out_of_one_turn(raw: int, position: int) -> None:
    data = bytearray(state_block(40))
    data[16:18] = raw.to_bytes(2, "little")
    assert codec.decode_state(bytes(data)).position == position


@given(st.binary(max_size=50))
def test_any_block_is_a_state_within_bounds_or_refused(data: bytes) -> None:
    try:
        state = codec.decode_state(data)
    except CodecError:
        return
    assert 31 <= len(data) <= 46
    assert -4096 < state.position < 8192
    assert -1.024 < state.load < 1.024


def test_identity_golden() -> None:
    table = bytearray(50)
    table[3:5] = b"\x09\x03"  # 777
    table[5], table[7], table[8], table[18], table[33] = 4, 250, 1, 0x0C, 0
    table[9:11], table[11:13] = (100).to_bytes(2, "little"), (4000).to_bytes(2, "little")
    table[31:33] = (0x800 | 85).to_bytes(2, "little")
    identity = codec.decode_identity(bytes(table))
    assert (identity.model, identity.servo, identity.return_delay_s) == (777, 4, pytest.approx(500e-6))
    assert (identity.min_ticks, identity.max_ticks, identity.homing_offset_ticks) == (100, 4000, -85)
    assert (identity.acknowledges, identity.multi_turn, identity.speed_unit_ticks_s) == (True, False, 1)
    table[18] = 0x18
    identity = codec.decode_identity(bytes(table))
    assert (identity.multi_turn, identity.speed_unit_ticks_s) == (True, 50)
    with pytest.raises(CodecError):
        codec.decode_identity(bytes(40))


def test_every_bit_of_the_status_is_a_known_fault() -> None:
    # Feetech's memory table, address 65: 0 voltage, 1 encoder, 2 heat, 3 current, 5 overload.
    assert set(codec.FAULT_BITS) == set(range(8))
    assert codec.faults(0) == ()
    assert [bit.fault_class for bit in codec.faults(0b101111)] == [
        FaultClass.ELECTRICAL,
        FaultClass.INTERNAL,
        FaultClass.THERMAL,
        FaultClass.OVERLOAD,
        FaultClass.OVERLOAD,
    ]
    assert [codec.FAULT_BITS[bit].name for bit in (4, 6, 7)] == ["reserved bit 4", "reserved bit 6", "reserved bit 7"]
    assert all(bit.hint and bit.needs is not Remedy.NOTHING for bit in codec.FAULT_BITS.values())


@given(st.integers(-100_000, 100_000), st.floats(0, 4095))
def test_unwrapping_finds_the_count_nearest_to_the_middle(true: int, centre: float) -> None:
    found = codec.unwrap(true % 4096, centre)
    assert (found - true) % 4096 == 0
    assert abs(found - centre) <= 2048


def test_a_cycle_of_five_servos_on_the_wire() -> None:
    # Goals 8 + 35, request 8 + 5, answers 5 * (6 + 46) bytes at 10 us each, and five times 500 us of waiting.
    assert codec.cycle_time_s(5, 1_000_000, 2.5e-3) == pytest.approx(316 * 10e-6 + 2.5e-3)
