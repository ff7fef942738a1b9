from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core.errors import CodecError, FaultClass
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.codec import Feedback, MitCommand, Ranges, Register

R4310 = Ranges(12.5, 30.0, 10.0)


def test_mit_golden_at_rest() -> None:
    # q 0 -> 0x8000, dq 0 -> 0x800, kp 50/500*4095 = 409.5 -> 0x19A, kd 1/5*4095 = 819 = 0x333, tau 0 -> 0x800.
    data = codec.encode_mit(MitCommand(0.0, 0.0, 50.0, 1.0, 0.0), R4310)
    assert data == bytes.fromhex("8000 8001 9A33 3800")


def test_mit_golden_at_the_ends() -> None:
    data = codec.encode_mit(MitCommand(12.5, -30.0, 500.0, 0.0, 10.0), R4310)
    assert data == bytes.fromhex("FFFF 000F FF00 0FFF")


def test_feedback_golden() -> None:
    # Status 1, id 1, q one half step over the middle, dq and tau likewise, 33 and 35 degrees Celsius.
    answer = codec.decode_feedback(bytes.fromhex("11 8000 800800 21 23"), 1, R4310)
    assert answer == Feedback(1, codec.ENABLED, answer.q, answer.dq, answer.tau, 33, 35)
    assert answer.q == pytest.approx(12.5 / 65535)
    assert answer.dq == pytest.approx(30.0 / 4095)
    assert answer.tau == pytest.approx(10.0 / 4095)


def test_register_golden() -> None:
    assert codec.read_register(1, Register.PMAX) == bytes.fromhex("0100 33 15 00000000")
    # 100 ms are 2000 ticks of 50 us: 0x7D0, little-endian.
    assert codec.write_register(1, Register.TIMEOUT, 2000) == bytes.fromhex("0100 55 09 D0070000")
    assert codec.request_feedback(0x107) == bytes.fromhex("0701 CC 0000000000")
    # 12.5 is 0x41480000.
    reply = codec.decode_register_reply(bytes.fromhex("0100 33 15 00004841"), 1, Register.PMAX)
    assert reply == codec.RegisterReply(1, 21, 12.5)
    reply = codec.decode_register_reply(bytes.fromhex("0100 55 09 D0070000"), 1, Register.TIMEOUT)
    assert reply == codec.RegisterReply(1, 9, 2000, written=True)


@given(
    st.builds(
        MitCommand,
        q=st.floats(-12.5, 12.5),
        dq=st.floats(-30, 30),
        kp=st.floats(0, 499),
        kd=st.floats(0, 5),
        tau=st.floats(-10, 10),
    )
)
def test_mit_round_trip_is_off_by_half_a_step_at_most(command: MitCommand) -> None:
    back = codec.decode_mit(codec.encode_mit(command, R4310), R4310)
    for field, step in (("q", 25 / 65535), ("dq", 60 / 4095), ("kp", 500 / 4095), ("kd", 5 / 4095), ("tau", 20 / 4095)):
        assert abs(getattr(back, field) - getattr(command, field)) <= step / 2 * (1 + 1e-9)


@given(st.sampled_from(["q", "dq", "kp", "kd", "tau"]), st.sampled_from([math.nan, math.inf, -math.inf, 1e9, -600.0]))
def test_nothing_impossible_is_encoded(field: str, value: float) -> None:
    values = {"q": 0.0, "dq": 0.0, "kp": 50.0, "kd": 1.0, "tau": 0.0} | {field: value}
    with pytest.raises(CodecError) as caught:
        codec.encode_mit(MitCommand(**values), R4310)
    assert caught.value.field == field


def test_no_command_reads_as_enable() -> None:
    tau = 10.0 - 3 * 20 / 4095
    with pytest.raises(CodecError, match="would be interpreted as enable"):
        codec.encode_mit(MitCommand(12.5, 30.0, 500.0, 5.0, tau), R4310)


@given(st.binary(max_size=12), st.integers(0, 127))
def test_any_bytes_are_a_finite_answer_of_that_motor_or_refused(data: bytes, motor: int) -> None:
    try:
        answer = codec.decode_feedback(data, motor, R4310)
    except CodecError:
        assert len(data) != 8 or data[0] & 0xF != motor & 0xF
        return
    assert answer.motor == motor & 0xF
    assert abs(answer.q) <= 12.5 * (1 + 1e-12)
    assert abs(answer.dq) <= 30.0 * (1 + 1e-12)
    assert abs(answer.tau) <= 10.0 * (1 + 1e-12)
    assert codec.encode_feedback(answer, R4310) == data


@given(st.integers(0, 7), st.integers(1, 255))
def test_a_corrupt_register_reply_is_never_mistaken_for_another(position: int, change: int) -> None:
    good = bytearray(codec.encode_register_reply(3, Register.VMAX, 30.0))
    good[position] ^= change
    try:
        reply = codec.decode_register_reply(bytes(good), 3, Register.VMAX)
    except CodecError:
        return
    if reply is None:
        return
    # Only the value may have changed, or a read reply become a write's.
    assert position >= 4 or (position, good[2]) == (2, 0x55)
    assert math.isfinite(reply.value)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_impossible_full_scales_are_refused(value: float) -> None:
    with pytest.raises(CodecError):
        Ranges(12.5, value, 10.0)


@pytest.mark.parametrize(("register", "value"), [(9, -1), (9, 2**32), (9, 1.5), (21, math.nan)])
def test_impossible_register_values_are_refused(register: int, value: float) -> None:
    with pytest.raises(CodecError):
        codec.write_register(1, register, value)


def test_every_status_is_normal_or_a_fault() -> None:
    assert codec.fault(codec.DISABLED) is None
    assert codec.fault(codec.ENABLED) is None
    # Damiao DM-J protocol: 8 OV, 9 UV, A OC, B MOS, C rotor, D lost communication, E overload; 5 and 6 are newer.
    assert set(codec.FAULTS) == {5, 6, 8, 9, 0xA, 0xB, 0xC, 0xD, 0xE}
    for status in range(2, 16):
        code = codec.fault(status)
        assert code is not None
        assert code.name
        assert code.hint
    undocumented = codec.fault(0xF)
    assert undocumented is not None
    assert undocumented.fault_class is FaultClass.INTERNAL


def test_bus_load_matches_published_figures_of_these_arms() -> None:
    # Published figures, seven motors: classic 1 Mbit/s at most 47 % at 250 Hz, 95 % at 500 Hz;
    # CAN FD 1M/5M 69-77 % at 1 kHz.
    assert codec.bus_load(7, 250, 1_000_000) == pytest.approx(0.47, abs=0.01)
    assert codec.bus_load(7, 500, 1_000_000) == pytest.approx(0.945, abs=0.01)
    assert 0.69 < codec.bus_load(7, 1000, 1_000_000, 5_000_000) < 0.80
