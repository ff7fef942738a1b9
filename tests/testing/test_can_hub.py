from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core import can_errors
from touchcell.testing.emulation.can_hub import Hub, pack, unpack


class Running:
    """A hub in an event loop of its own."""

    def __init__(self, path: Path) -> None:
        self.loop = asyncio.new_event_loop()
        self.heard: list[can.Message] = []
        self.hub = Hub(path, self.heard.append)
        self.thread = threading.Thread(target=self.loop.run_forever)

    def call(self, function, *arguments):  # type: ignore[no-untyped-def]
        async def run():  # type: ignore[no-untyped-def]
            return function(*arguments)

        return asyncio.run_coroutine_threadsafe(run(), self.loop).result(5.0)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    running = Running(tmp_path / "bus")
    running.thread.start()
    running.call(running.hub.open)
    yield running
    running.call(running.hub.close)
    running.loop.call_soon_threadsafe(running.loop.stop)
    running.thread.join()
    running.loop.close()


def bus(tmp_path: Path, **options: object) -> can.BusABC:
    return can.Bus(interface="touchcell_hub", channel=str(tmp_path / "bus"), **options)


messages = st.builds(
    can.Message,
    arbitration_id=st.integers(0, 0x7FF),
    is_extended_id=st.just(False),
    data=st.binary(max_size=8),
)
fd_messages = st.builds(
    can.Message,
    arbitration_id=st.integers(0, 0x1FFFFFFF),
    is_extended_id=st.just(True),
    is_fd=st.just(True),
    bitrate_switch=st.booleans(),
    data=st.sampled_from([0, 1, 8, 12, 48, 64]).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
)


@given(st.one_of(messages, fd_messages))
def test_frames_are_preserved_by_packing(message: can.Message) -> None:
    assert unpack(pack(message)).equals(message, timestamp_delta=None, check_channel=False)


def test_the_layout_is_socketcan_s() -> None:
    # struct can_frame: u32 id (native), u8 length, 3 padding, 8 data.
    frame = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02")
    assert pack(frame) == bytes.fromhex("23010000 02 000000 0102000000000000")
    # struct canfd_frame: u32 id with EFF bit 31, u8 length, u8 flags (FDF 4, BRS 1), 2 reserved, 64 data.
    frame = can.Message(arbitration_id=0x123, is_extended_id=True, is_fd=True, bitrate_switch=True, data=b"\x07")
    assert pack(frame) == bytes.fromhex("23010080 01 05 0000 07") + bytes(63)


@given(st.one_of(st.binary(max_size=80), st.binary(min_size=16, max_size=16), st.binary(min_size=72, max_size=72)))
def test_any_packet_is_a_frame_or_refused(packet: bytes) -> None:
    try:
        message = unpack(packet)
    except ValueError:
        return
    assert len(message.data) <= 64
    assert message.arbitration_id <= 0x1FFFFFFF


def test_clients_hear_each_other_in_order_but_not_themselves(running: Running, tmp_path: Path) -> None:
    with bus(tmp_path) as one, bus(tmp_path) as two:
        for number in range(50):
            one.send(can.Message(arbitration_id=number, is_extended_id=False, data=[number]))
        assert [two.recv(5.0).arbitration_id for _ in range(50)] == list(range(50))
        assert one.recv(0.0) is None
    assert [message.arbitration_id for message in running.heard] == list(range(50))


def test_filters_work(running: Running, tmp_path: Path) -> None:
    only_five = [{"can_id": 5, "can_mask": 0x7FF, "extended": False}]
    with bus(tmp_path) as one, bus(tmp_path, can_filters=only_five) as two:
        for number in (4, 5):
            one.send(can.Message(arbitration_id=number, is_extended_id=False))
        assert two.recv(5.0).arbitration_id == 5


def test_an_unplugged_adapter_is_an_error_both_ways(running: Running, tmp_path: Path) -> None:
    with bus(tmp_path) as one:
        one.send(can.Message(arbitration_id=1, is_extended_id=False))
        running.call(running.hub.close)
        with pytest.raises(can.CanOperationError):
            one.recv(5.0)
        with pytest.raises(can.CanOperationError):
            one.send(can.Message(arbitration_id=1, is_extended_id=False))
    with pytest.raises(can.CanInitializationError):
        bus(tmp_path)


def test_error_frames_change_the_bus_state(running: Running, tmp_path: Path) -> None:
    with bus(tmp_path) as one:
        one.send(can.Message(arbitration_id=1, is_extended_id=False))
        for error, data, state in (
            (can_errors.CONTROLLER, b"\x00\x10\x00\x00\x00\x00\x00\x00", can.BusState.PASSIVE),
            (can_errors.BUS_OFF, bytes(8), can.BusState.ERROR),
            (can_errors.RESTARTED, bytes(8), can.BusState.ACTIVE),
        ):
            frame = can.Message(arbitration_id=error, is_error_frame=True, is_extended_id=False, dlc=8, data=data)
            running.call(running.hub.send, frame)
            received = one.recv(5.0)
            assert received.is_error_frame
            assert one.state is state
    assert can_errors.describe(can_errors.BUS_OFF | can_errors.CONTROLLER) == "controller problem, bus-off"
