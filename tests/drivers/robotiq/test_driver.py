"""The Robotiq driver beside its emulator, on one simulated time; its wire format by the manual's examples."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.helpers.bus_arms import CLOCK, TOKEN, in_step, pause, wait
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CodecError, CommandRejected, ConnectError, DeviceFault, Rejection
from touchcell.drivers.robotiq import codec, driver, modbus
from touchcell.drivers.robotiq import emulator as robotiq_emulator
from touchcell.drivers.robotiq.codec import Action
from touchcell.drivers.robotiq.driver import RobotiqConfig, RobotiqGripper
from touchcell.drivers.robotiq.rig import TCP_PORT, host_of, rig_in_step
from touchcell.testing.emulation.lockstep import EmulatorInStep, Lockstep, emulator_in_step
from touchcell.testing.emulation.serial_line import SocketLine, SocketPort

ADDRESSES = itertools.count(os.getpid() % 30_000 * 16)


@pytest.fixture
def address() -> int:
    return next(ADDRESSES)


@pytest.fixture
def hand(address: int, tmp_path: Path) -> Iterator[EmulatorInStep]:
    yield from in_step(rig_in_step(tmp_path, address))


@pytest.fixture
def gripper(hand: EmulatorInStep, address: int) -> Iterator[RobotiqGripper]:
    made = RobotiqGripper("gripper", RobotiqConfig(host=host_of(address), tcp_port=TCP_PORT), CLOCK)
    yield made
    made.disconnect()


def activated(gripper: RobotiqGripper) -> RobotiqGripper:
    gripper.connect()
    gripper.configure()
    gripper.activate()
    return gripper


def test_the_examples_of_the_manual() -> None:
    opened = modbus.write(9, codec.OUTPUT, codec.encode_action(Action(True, True, 0, 255, 255)))
    assert modbus.encode_rtu(opened).hex(" ") == "09 10 03 e8 00 03 06 09 00 00 00 ff ff 72 19"
    modbus.decode_written(modbus.decode_rtu(bytes.fromhex("0910 03E8 0003 0130")), codec.OUTPUT, 3)
    reply = modbus.decode_rtu(bytes.fromhex("0904 06F9 0000 000D 0017 AA"))
    status = codec.decode_status(modbus.decode_registers(reply, 3))
    assert (status.activated, status.going, status.met) == (True, True, codec.ObjectStatus.AT_GOAL)
    assert (status.position, status.fault) == (13, 0)
    assert codec.encode_status(status) == modbus.decode_registers(reply, 3)


@given(st.binary(max_size=40))
def test_any_bytes_are_a_message_or_a_codec_error(data: bytes) -> None:
    for decode in (modbus.decode_rtu, modbus.split_tcp, lambda d: modbus.rtu_length(d, is_request=True)):
        try:
            decode(data)  # type: ignore[operator]
        except CodecError:
            continue


def test_connecting_and_configuring_move_nothing(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    gripper.connect()
    gripper.configure()
    pause(0.5)
    assert (hand.state()["commands"], hand.state()["activation"]) == (0, "reset")
    gripper.activate()
    assert hand.state()["activation"] == "activated"


def test_it_goes_to_an_opening(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    activated(gripper).apply({"width_mm": 40.0, "speed_mm_s": 100.0})
    wait(lambda: gripper.read().value["moving"] == 0.0 and abs(gripper.read().value["width_mm"] - 40.0) < 0.5)
    assert hand.state()["width_mm"] == pytest.approx(40.0, abs=0.2)
    assert gripper.read().value["holding"] == 0.0


def test_it_holds_an_object_and_tells_when_it_is_lost(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    activated(gripper)
    hand.fault("object", 30.0)
    gripper.apply({"width_mm": 0.0, "force_n": 50.0})
    wait(lambda: gripper.read().value["holding"] == 1.0, 6.0)
    assert gripper.read().value["width_mm"] == pytest.approx(30.0, abs=0.5)
    assert gripper.health()["dropped"] == 0
    hand.clear("object")
    wait(lambda: gripper.health()["dropped"] == 1, 6.0)
    assert gripper.read().value["holding"] == 0.0


def test_disconnecting_keeps_what_it_holds(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    activated(gripper)
    hand.fault("object", 30.0)
    gripper.apply({"width_mm": 0.0})
    wait(lambda: gripper.read().value["holding"] == 1.0, 6.0)
    gripper.disconnect()
    activated(gripper)
    pause(0.2)
    assert (hand.state()["met"], hand.state()["energising"]) == ("held_closing", 1)


def test_a_setting_is_sent_once(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    activated(gripper)
    before = hand.state()["commands"]
    for _ in range(20):
        gripper.apply({"width_mm": 40.0})
        pause(0.02)
    assert hand.state()["commands"] == before + 1


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ({"width_mm": 90.0}, Rejection.LIMIT),
        ({"width_mm": -1.0}, Rejection.LIMIT),
        ({"width_mm": 40.0, "force_n": 1000.0}, Rejection.LIMIT),
        ({"width_mm": float("nan")}, Rejection.NON_FINITE),
        ({"speed_mm_s": 50.0}, Rejection.SHAPE),
        ({"width": 40.0}, Rejection.SHAPE),
    ],
)
def test_impossible_settings_are_refused(
    gripper: RobotiqGripper, hand: EmulatorInStep, setting: dict[str, float], reason: Rejection
) -> None:
    activated(gripper)
    before = hand.state()["commands"]
    with pytest.raises(CommandRejected) as refused:
        gripper.apply(setting)
    assert refused.value.reason is reason
    pause(0.1)
    assert hand.state()["commands"] == before


def test_before_activation_nothing_is_sent(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    gripper.connect()
    with pytest.raises(CommandRejected) as refused:
        gripper.apply({"width_mm": 40.0})
    assert refused.value.reason is Rejection.MODE


def test_a_latched_fault_is_recovered_by_a_person(gripper: RobotiqGripper, hand: EmulatorInStep) -> None:
    activated(gripper)
    hand.fault("fault", 0x0E)
    wait(lambda: gripper.state is Lifecycle.FAULTED)
    assert isinstance(gripper.fault, DeviceFault)
    assert gripper.fault.vendor_code == 0x0E
    gripper.recover(TOKEN)
    assert gripper.state is Lifecycle.READY
    gripper.activate()
    assert hand.state()["activation"] == "activated"


def test_a_gripper_that_waits_with_a_fault_is_faulted_from_the_start(
    gripper: RobotiqGripper, hand: EmulatorInStep
) -> None:
    hand.fault("fault", 0x0D)
    gripper.connect()
    assert gripper.state is Lifecycle.FAULTED
    gripper.recover(TOKEN)
    assert gripper.state is Lifecycle.READY


def test_a_gripper_that_lost_its_power_is_not_activated_by_itself(
    gripper: RobotiqGripper, hand: EmulatorInStep
) -> None:
    activated(gripper)
    hand.fault("restart")
    wait(lambda: gripper.state is Lifecycle.FAULTED)
    assert "no longer activated" in str(gripper.fault)
    gripper.recover(TOKEN)
    pause(0.2)
    assert hand.state()["activation"] == "reset"


def test_a_second_unit_does_not_answer(hand: EmulatorInStep, address: int) -> None:
    other = RobotiqGripper("other", RobotiqConfig(host=host_of(address), tcp_port=TCP_PORT, unit=3), CLOCK)
    with pytest.raises(ConnectError, match="no gripper answers"):
        other.connect()


def test_over_a_serial_line_it_does_the_same(tmp_path: Path) -> None:
    port = tmp_path / "gripper"
    with Lockstep([driver]) as world:

        def build(arguments: Any) -> robotiq_emulator.RobotiqHand:
            return robotiq_emulator.RobotiqHand(SocketLine(port, 115_200), None)

        hand = emulator_in_step(world, "robotiq", "--link", str(port), build=build).start()
        gripper = RobotiqGripper("gripper", RobotiqConfig(port=str(port)), world, lambda: SocketPort(str(port)))
        activated(gripper).apply({"width_mm": 20.0, "speed_mm_s": 150.0})
        wait(lambda: abs(hand.state()["width_mm"] - 20.0) < 0.5)
        hand.fault("corrupt", 2)
        pause(0.3)
        assert gripper.health()["corrupt"] == 2
        assert gripper.state is Lifecycle.ACTIVE
        gripper.disconnect()
        hand.stop()


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"port": "/dev/ttyUSB0", "host": "192.168.1.11"},
        {"port": "/dev/ttyUSB0", "closed_count": 2},
        {"port": "/dev/ttyUSB0", "force_range_n": (50, 20)},
    ],
)
def test_wrong_configurations_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        RobotiqConfig(**wrong)
