"""Validate the emulator with the vendor's unmodified client: feetech-servo-sdk 1.0.0 (Unlicense)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.feetech.driver import FeetechSerialArm
from touchcell.drivers.feetech.rig import config
from touchcell.drivers.feetech.rig import emulator as emulated
from touchcell.testing.emulation.process import EmulatorProcess

scs = pytest.importorskip("scservo_sdk")

TORQUE, GOAL, POSITION, LOCK, OFFSET = 40, 42, 56, 55, 31


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("judges") / "servos"


@pytest.fixture(scope="module")
def process(link: Path) -> Iterator[EmulatorProcess]:
    with emulated(link) as process:
        yield process


@pytest.fixture
def servos(process: EmulatorProcess) -> EmulatorProcess:
    process.fault("reset")
    return process


@pytest.fixture
def port(link: Path, servos: EmulatorProcess) -> Iterator[Any]:
    port = scs.PortHandler(str(link))
    assert port.openPort()
    yield port
    port.closePort()


class PatientSdk:
    """Retry after a purge: the client times out after 34 ms and mistakes a late reply for the next one."""

    def __init__(self) -> None:
        self._handler = scs.PacketHandler(0)

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._handler, name)
        return self._patient(method) if name.endswith("TxRx") or name == "ping" else method

    def _patient(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(port: Any, *arguments: Any) -> Any:
            for _ in range(10):
                answer = method(port, *arguments)
                if scs.COMM_RX_TIMEOUT not in answer:
                    break
                time.sleep(0.05)
                port.ser.reset_input_buffer()
            return answer

        return call


@pytest.fixture
def sdk() -> Any:
    return PatientSdk()


def test_ping_finds_five_sts3215(port: Any, sdk: Any) -> None:
    assert [sdk.ping(port, number) for number in range(1, 6)] == [(777, scs.COMM_SUCCESS, 0)] * 5
    assert sdk.ping(port, 6)[1] == scs.COMM_RX_TIMEOUT


def test_reads_and_writes(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    ticks = servos.state()["ticks"]
    assert sdk.read2ByteTxRx(port, 2, POSITION) == (ticks[1], scs.COMM_SUCCESS, 0)
    assert sdk.write2ByteTxRx(port, 2, GOAL, ticks[1] + 100) == (scs.COMM_SUCCESS, 0)
    assert servos.state()["ticks"] == ticks
    assert sdk.write1ByteTxRx(port, 2, TORQUE, 1) == (scs.COMM_SUCCESS, 0)
    state = servos.wait_for(ticks=[ticks[0], ticks[1] + 100, *ticks[2:]])
    assert state["torque"] == [False, True, False, False, False]


def test_sync_read_and_sync_write(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    ticks = servos.state()["ticks"]
    reader = scs.GroupSyncRead(port, sdk, POSITION, 2)
    for number in range(1, 6):
        assert reader.addParam(number)
    while reader.txRxPacket() != scs.COMM_SUCCESS:
        time.sleep(0.05)
        port.ser.reset_input_buffer()
    assert [reader.getData(number, POSITION, 2) for number in range(1, 6)] == ticks
    writer = scs.GroupSyncWrite(port, sdk, GOAL, 2)
    for number, value in enumerate(ticks, start=1):
        assert writer.addParam(number, [(value + number) & 0xFF, (value + number) >> 8])
    assert writer.txPacket() == scs.COMM_SUCCESS
    servos.wait_for(goals=[value + number for number, value in enumerate(ticks, start=1)])


def test_prepared_writes_wait_for_the_action(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    for number in (1, 2):
        assert sdk.regWriteTxRx(port, number, GOAL, 2, [0xD0, 0x07]) == (scs.COMM_SUCCESS, 0)
    assert servos.state()["goals"][:2] == [0, 0]
    assert sdk.action(port, scs.BROADCAST_ID) == scs.COMM_SUCCESS
    servos.wait_for(goals=[2000, 2000, 0, 0, 0])


def test_the_error_byte_reports_an_overload(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    servos.fault("fault_bits", [2, 0x20])
    _, result, error = sdk.read2ByteTxRx(port, 3, POSITION)
    assert result == scs.COMM_SUCCESS
    assert sdk.getRxPacketError(error) == "[RxPacketError] Overload error!"
    assert sdk.read2ByteTxRx(port, 4, POSITION)[2] == 0


def test_a_strained_servo_overloads_by_itself(tmp_path: Path, sdk: Any) -> None:
    with emulated(tmp_path / "strained", "--protection-time-s", "0.1") as servos:
        port = scs.PortHandler(str(tmp_path / "strained"))
        assert port.openPort()
        servos.fault("block", 0)
        sdk.write2ByteTxRx(port, 1, GOAL, 3000)
        sdk.write1ByteTxRx(port, 1, TORQUE, 1)
        servos.wait_for(status=[0x20, 0, 0, 0, 0])
        assert sdk.read1ByteTxRx(port, 1, 65) == (0x20, scs.COMM_SUCCESS, 0x20)
        # Switching the torque off and on ends it.
        servos.clear("block")
        sdk.write1ByteTxRx(port, 1, TORQUE, 0)
        assert sdk.write1ByteTxRx(port, 1, TORQUE, 1) == (scs.COMM_SUCCESS, 0)
        port.closePort()


@pytest.mark.parametrize("fault", ["corrupt", "short"])
def test_corruption_is_detected_by_the_client(port: Any, sdk: Any, servos: EmulatorProcess, fault: str) -> None:
    # More than one: a reply that the client's machine delays beyond its timeout is spent.
    servos.fault(fault, 100)
    assert sdk.read2ByteTxRx(port, 1, POSITION)[1] == scs.COMM_RX_CORRUPT
    servos.clear(fault)
    port.ser.reset_input_buffer()
    assert sdk.read2ByteTxRx(port, 1, POSITION)[1] == scs.COMM_SUCCESS


def test_a_lost_answer_is_a_timeout(port: Any, servos: EmulatorProcess) -> None:
    servos.fault("drop", 1)
    assert scs.PacketHandler(0).read2ByteTxRx(port, 1, POSITION)[1] == scs.COMM_RX_TIMEOUT


def test_a_power_cycle_loses_unsaved_registers(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    sdk.write2ByteTxRx(port, 1, OFFSET, 85)
    servos.fault("restart")
    assert sdk.read2ByteTxRx(port, 1, OFFSET)[0] == 0
    sdk.write1ByteTxRx(port, 1, LOCK, 0)
    sdk.write2ByteTxRx(port, 1, OFFSET, 85)
    sdk.write1ByteTxRx(port, 1, TORQUE, 1)
    servos.fault("restart")
    assert sdk.read2ByteTxRx(port, 1, OFFSET)[0] == 85
    assert sdk.read1ByteTxRx(port, 1, TORQUE)[0] == 0


def test_calibrating_the_middle(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    energising = servos.state()["energising"]
    assert sdk.write1ByteTxRx(port, 4, TORQUE, 128) == (scs.COMM_SUCCESS, 0)
    assert sdk.read2ByteTxRx(port, 4, POSITION)[0] == 2048
    # A client whose machine delayed the reply writes again.
    assert servos.state()["energising"] > energising


def test_two_servos_that_were_given_one_id_cannot_be_read(port: Any, sdk: Any, servos: EmulatorProcess) -> None:
    sdk.write1ByteTxRx(port, 2, 5, 1)
    assert sdk.read2ByteTxRx(port, 1, POSITION)[1] != scs.COMM_SUCCESS
    assert sdk.ping(port, 2)[1] == scs.COMM_RX_TIMEOUT
    assert sdk.read2ByteTxRx(port, 3, POSITION)[1] == scs.COMM_SUCCESS


def test_driver_and_vendor_s_client_see_the_same(link: Path, sdk: Any, servos: EmulatorProcess) -> None:
    with FeetechSerialArm("arm", config(link), MonotonicClock()) as arm:
        arm.configure()
        arm.activate()
        lease = arm.acquire("judge")
        arm.go_to_joints(np.deg2rad([10.0, 5.0, 95.0, 75.0, -20.0]), lease, speed_fraction=0.5)
        deadline = time.monotonic() + 10.0
        while not arm.at_rest():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        servos.wait_for(still=True)
        seq = arm.joints().seq
        while arm.joints().seq < seq + 2:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        told = [arm.health()[f"{joint}_ticks"] for joint in ("pan", "lift", "elbow", "wrist", "roll")]
    port = scs.PortHandler(str(link))
    assert port.openPort()
    assert [sdk.read2ByteTxRx(port, number, POSITION)[0] for number in range(1, 6)] == told
    # By hand: servo 1 is at 2048 + 10 deg, servo 2 turns the other way from 2100.
    assert told[0] == round(2048 + 10 / 360 * 4096)
    assert told[1] == round(2100 - 5 / 360 * 4096)
    port.closePort()
