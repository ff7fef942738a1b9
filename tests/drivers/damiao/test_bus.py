from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import can
import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.bus import Address, MotorBus
from touchcell.drivers.damiao.codec import Feedback, Ranges, Register
from touchcell.drivers.damiao.driver import DamiaoCanConfig, open_bus

RANGES = Ranges(12.5, 30.0, 10.0)
REGISTERS: dict[int, float | int] = {
    Register.PMAX: RANGES.position_rad,
    Register.VMAX: RANGES.velocity_rad_s,
    Register.TMAX: RANGES.torque_n_m,
    Register.MST_ID: 0x11,
}


class Adapter:
    """A python-can bus with one motor, whose ``send`` and ``recv`` fail on request."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.state = can.BusState.ACTIVE
        self.answers: list[can.Message] = []
        self.send_fails: Callable[[], Exception | None] = lambda: None
        self.recv_fails: Callable[[], Exception | None] = lambda: None

    def send(self, message: can.Message) -> None:
        if (error := self.send_fails()) is not None:
            raise error
        data = bytes(message.data)
        if message.arbitration_id == codec.PARAMETER_ID and data[2] == 0x33:
            answer = codec.encode_register_reply(1, data[3], REGISTERS[data[3]], write=False)
        else:
            answer = codec.encode_feedback(Feedback(1, codec.ENABLED, 0.5, 0.0, 0.0, 30, 30), RANGES)
        self.answers.append(can.Message(arbitration_id=0x11, is_extended_id=False, data=answer))

    def recv(self, timeout: float) -> can.Message | None:
        if (error := self.recv_fails()) is not None:
            raise error
        if self.answers:
            return self.answers.pop(0)
        self.clock.advance_s(timeout)
        return None

    def shutdown(self) -> None:
        pass


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def adapter(clock: VirtualClock) -> Adapter:
    return Adapter(clock)


@pytest.fixture
def bus(clock: VirtualClock, adapter: Adapter) -> MotorBus:
    bus = MotorBus("arm", [Address(1, 0x11)], lambda: adapter, clock, max_silence_s=0.1)
    bus.open()
    return bus


def exchange(bus: MotorBus, clock: VirtualClock) -> Any:
    return bus.exchange([None], clock.now_ns() + 3_000_000)[0]


PASSING = [
    can.CanOperationError("Transmit buffer full"),
    can.CanOperationError("Failed to transmit", errno.ENOBUFS),
    can.CanOperationError("The interface is down", errno.ENETDOWN),
    can.CanOperationError("The PCAN transmit queue is full", 0x00080),
    can.CanTimeoutError("The serial adapter did not take the frame"),
    OSError(errno.EAGAIN, "try again"),
    RuntimeError("a USB driver raised something of its own"),
]
FINAL = [
    can.CanOperationError("Failed to transmit", errno.ENODEV),
    OSError(errno.ENODEV, "no such device"),
    OSError(errno.EBADF, "bad file descriptor"),
]


@pytest.mark.parametrize("error", PASSING, ids=str)
def test_a_refused_send_is_counted_and_the_next_one_is_made(
    bus: MotorBus, adapter: Adapter, clock: VirtualClock, error: Exception
) -> None:
    adapter.send_fails = lambda: error
    assert exchange(bus, clock) is None
    assert bus.counters.not_sent > 0
    assert bus.last_error
    adapter.send_fails = lambda: None
    assert exchange(bus, clock).state.q == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("error", PASSING, ids=str)
def test_a_failed_read_is_counted_and_the_next_one_is_made(
    bus: MotorBus, adapter: Adapter, clock: VirtualClock, error: Exception
) -> None:
    adapter.recv_fails = lambda: error
    assert exchange(bus, clock) is None
    assert bus.counters.not_received > 0
    adapter.recv_fails = lambda: None
    assert exchange(bus, clock) is not None


@pytest.mark.parametrize("error", FINAL, ids=str)
def test_an_adapter_that_has_vanished_is_gone(
    bus: MotorBus, adapter: Adapter, clock: VirtualClock, error: Exception
) -> None:
    adapter.send_fails = lambda: error
    with pytest.raises(DeviceGone):
        exchange(bus, clock)


def test_the_cause_of_an_adapters_exception_counts_too(bus: MotorBus, adapter: Adapter, clock: VirtualClock) -> None:
    wrapped = can.CanOperationError("Could not read from serial device")
    wrapped.__cause__ = OSError(errno.ENODEV, "no such device")
    adapter.recv_fails = lambda: wrapped
    with pytest.raises(DeviceGone):
        exchange(bus, clock)


MOTORS = [{"esc_id": index + 1, "mst_id": index + 0x11} for index in range(6)]


def opened(monkeypatch: pytest.MonkeyPatch, **settings: Any) -> dict[str, Any]:
    """Return the options with which python-can is asked for a bus."""
    asked: dict[str, Any] = {}

    class Bus:
        protocol = can.CanProtocol.CAN_FD if settings.get("fd") else can.CanProtocol.CAN_20

        def __init__(self, **options: Any) -> None:
            asked.update(options)

    monkeypatch.setattr(can, "Bus", Bus)
    open_bus("arm", DamiaoCanConfig.model_validate({"motors": MOTORS} | settings))
    return asked


@pytest.mark.parametrize("interface", ["slcan", "gs_usb", "pcan"])
def test_an_adapter_that_python_can_opens_gets_the_bit_rates(monkeypatch: pytest.MonkeyPatch, interface: str) -> None:
    asked = opened(monkeypatch, interface=interface, fd=True)
    assert (asked["bitrate"], asked["data_bitrate"]) == (1_000_000, 5_000_000)
    assert "data_bitrate" not in opened(monkeypatch, interface=interface, rate_hz=200.0)
    assert opened(monkeypatch, interface=interface, bus_options={"bitrate": 500_000})["bitrate"] == 500_000


def test_the_kernels_interface_keeps_the_rate_set_by_ip_link(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "bitrate" not in opened(monkeypatch, interface="socketcan")


def test_an_adapter_without_can_fd_is_refused_for_a_bus_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    class Classic:
        protocol = can.CanProtocol.CAN_20

        def __init__(self, **options: Any) -> None:
            pass

        def shutdown(self) -> None:
            pass

    monkeypatch.setattr(can, "Bus", Classic)
    config = DamiaoCanConfig.model_validate({"motors": MOTORS, "interface": "slcan", "fd": True})
    with pytest.raises(ConnectError, match="CAN FD"):
        open_bus("arm", config)
