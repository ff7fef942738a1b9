"""The emulated gripper, judged by an unmodified public client: pymodbus."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from touchcell.drivers.robotiq.rig import TCP_PORT, host_of
from touchcell.testing.emulation.process import EmulatorProcess

client = pytest.importorskip("pymodbus.client", reason="pip install pymodbus")
ADDRESSES = itertools.count(700_000 + os.getpid() % 30_000 * 16)


@pytest.fixture(params=["tcp", "rtu"])
def connected(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Any, EmulatorProcess]]:
    """A connected client of the emulator, over a network and over a serial line."""
    if request.param == "tcp":
        host = host_of(next(ADDRESSES))
        arguments: tuple[str, ...] = ("--host", host, "--tcp-port", str(TCP_PORT))
        made = client.ModbusTcpClient(host, port=TCP_PORT)
    else:
        arguments = ("--link", str(tmp_path / "gripper"))
        made = client.ModbusSerialClient(str(tmp_path / "gripper"), baudrate=115_200, timeout=2.0)
    with EmulatorProcess("robotiq", *arguments) as hand:
        assert made.connect()
        yield made, hand
        made.close()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_pymodbus_activates_moves_and_grips(connected: tuple[Any, EmulatorProcess]) -> None:
    modbus, hand = connected

    def status() -> list[int]:
        return list(modbus.read_input_registers(0x07D0, count=3, device_id=9).registers)

    assert status()[0] >> 8 == 0
    assert not modbus.write_registers(0x03E8, [0x0100, 0, 0], device_id=9).isError()
    until(lambda: status()[0] >> 12 & 3 == 3)
    hand.fault("object", 30.0)
    modbus.write_registers(0x03E8, [0x0900, 0x00FF, 0xFFFF], device_id=9)
    until(lambda: status()[0] >> 14 == 2)
    assert hand.state()["width_mm"] == pytest.approx(30.0)
    modbus.write_registers(0x03E8, [0x0900, 0x0000, 0xFFFF], device_id=9)
    until(lambda: status()[0] >> 14 == 3)
    assert list(modbus.read_holding_registers(0x07D0, count=3, device_id=9).registers) == status()


def test_what_is_not_there_is_refused(connected: tuple[Any, EmulatorProcess]) -> None:
    modbus, _ = connected
    assert modbus.read_input_registers(0x0100, count=1, device_id=9).exception_code == 2
    assert modbus.write_registers(0x0100, [1], device_id=9).exception_code == 2
    assert modbus.read_coils(0, count=1, device_id=9).exception_code == 1
