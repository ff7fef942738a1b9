"""Errors keep their type and attributes between processes."""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    Rejection,
    Remedy,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.hosting import wire
from touchcell.drivers.hosting.layouts import ANSWER, ARM, RecordReader, RecordWriter, close_fd, create_block
from touchcell.drivers.hosting.memory import BlockMismatch
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.errors import ConfigError, TouchcellError

ERRORS = [
    CommandRejected("left", Rejection.EXPIRED, "too old", value=0.2, limit=0.03, hint="hurry"),
    CommandRejected("left", Rejection.SHAPE, "wrong", value=(5,), limit=(6,)),
    CommandRejected("left", Rejection.NON_FINITE, "not finite", value=np.array([1.0, np.inf])),
    LifecycleError("left", "move", "ready", ["active"]),
    DeviceFault("left", "hot", vendor_code=17, fault_class=FaultClass.THERMAL, needs=Remedy.OPERATOR, hint="wait"),
    StaleData("cam", 0.2, 0.1, 8),
    TransportTimeout("left", "state", 0.5),
    ConnectError("left", "no arm", [DeviceGone("left", "unplugged"), ConfigError("bad", key="port", value=3)]),
    ConfigError("unknown", file="cell.yaml", line=3, key="arms.left", value=None),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_every_attribute_arrives(error: TouchcellError) -> None:
    arrived = wire.decode_error(json.loads(json.dumps(wire.encode_error(error))), "left")
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived).keys() == vars(error).keys()
    for name, value in vars(error).items():
        if name == "causes":
            assert [str(cause) for cause in arrived.causes] == [str(cause) for cause in value]  # type: ignore[attr-defined]
        else:
            np.testing.assert_equal(getattr(arrived, name), value)


def test_a_driver_specific_error_arrives_as_its_base_type() -> None:
    class ReflexFault(DeviceFault):
        pass

    arrived = wire.decode_error(wire.encode_error(ReflexFault("arm", "reflex", vendor_code="cartesian")), "arm")
    assert type(arrived) is DeviceFault
    assert arrived.vendor_code == "cartesian"


def test_a_programming_error_arrives_too() -> None:
    arrived = wire.decode_error(wire.encode_error(ZeroDivisionError("division by zero")), "arm")
    assert type(arrived) is DeviceError
    assert arrived.device == "arm"
    assert "ZeroDivisionError" in str(arrived)


@settings(max_examples=30)
@given(st.text(max_size=3000), st.integers(200, 2048))
def test_a_note_fits(text: str, longest: int) -> None:
    note = wire.error_note(CommandRejected("left", Rejection.LIMIT, text, value=text), longest)
    assert len(note) <= longest
    assert type(wire.decode_note(note, "left")) is CommandRejected


@given(
    st.lists(
        st.builds(Adjustment, st.text(max_size=30), st.floats(allow_nan=False), st.floats(allow_nan=False)), max_size=4
    )
)
def test_adjustments_arrive(adjustments: list[Adjustment]) -> None:
    assert wire.decode_adjustments(wire.encode_adjustments(tuple(adjustments))) == tuple(adjustments)


def test_a_closed_socket_gives_no_message() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        wire.send(ours, {"call": "activate"})
        assert wire.receive(theirs) == {"call": "activate"}
        ours.close()
        assert wire.receive(theirs) is None


def test_a_record_arrives_with_its_tail_and_only_for_its_own_layout() -> None:
    fd = create_block("arm", ARM)
    with RecordWriter(fd, ARM) as writer, RecordReader(fd, ARM) as reader:
        assert reader.read()["seq"] == 0
        writer.value["seq"], writer.value["twist"] = 7, np.arange(6.0)
        writer.publish(b"note")
        number, record, note = reader.read_all()
        assert (number, int(record["seq"]), note) == (1, 7, b"note")
        np.testing.assert_array_equal(record["twist"], np.arange(6.0))
        writer.value["seq"] = 8
        assert reader.read()["seq"] == 7, "fields are visible only once published"
    with pytest.raises(BlockMismatch):
        RecordReader(fd, ANSWER)
    close_fd(fd)


def plain(value: Any) -> Any:
    return wire._decoded_value(json.loads(json.dumps(wire._plain(value))))


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.sampled_from(Rejection),
        lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner),
        max_leaves=8,
    )
)
def test_values_are_preserved(value: Any) -> None:
    assert plain(value) == value
