"""The Net F/T driver beside its emulator, on one simulated time, and the emulator as public clients use it."""

from __future__ import annotations

import itertools
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.bus_arms import CLOCK, TOKEN, in_step, pause, wait
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CodecError, ConnectError, DeviceFault, TransportTimeout
from touchcell.drivers.net_ft import codec
from touchcell.drivers.net_ft.driver import NetFt, NetFtConfig
from touchcell.drivers.net_ft.rig import host_of, rig_in_step
from touchcell.testing.emulation.lockstep import EmulatorInStep

ADDRESSES = itertools.count(os.getpid() % 30_000 * 16)
PUSHED = [1.5, -2.25, 30.0, 0.125, 0.0, -0.5]


@pytest.fixture
def address() -> int:
    return next(ADDRESSES)


@pytest.fixture
def box(address: int, tmp_path: Path) -> Iterator[EmulatorInStep]:
    yield from in_step(rig_in_step(tmp_path, address))


@pytest.fixture
def sensor(box: EmulatorInStep, address: int) -> Iterator[NetFt]:
    sensor = NetFt("ft", NetFtConfig(host=host_of(address)), CLOCK)
    yield sensor
    sensor.disconnect()


def test_force_and_torque_are_in_newtons_and_newton_metres(sensor: NetFt, box: EmulatorInStep) -> None:
    box.fault("wrench", PUSHED)
    sensor.connect()
    reading = sensor.read(0.05)
    np.testing.assert_allclose(list(reading.value.values())[:6], PUSHED, atol=1e-6)
    assert reading.value["force_z_n"] == pytest.approx(30.0)
    assert reading.value["force_n"] == pytest.approx(np.linalg.norm(PUSHED[:3]))
    assert sensor.health()["torque_nm"] == pytest.approx(np.linalg.norm(PUSHED[3:]))


def test_a_sample_is_never_older_than_its_stamp(sensor: NetFt, box: EmulatorInStep) -> None:
    sensor.connect()
    box.fault("delay", 0.004)
    pause(0.2)
    before_ns = CLOCK.now_ns()
    box.fault("wrench", PUSHED)
    wait(lambda: sensor.read().value["force_z_n"] == pytest.approx(30.0))
    # The first that shows the push was asked for, and so stamped, at most one way of the link before it.
    assert sensor.read().t_ns > before_ns - 10_000_000


def test_late_replies_are_not_taken_for_the_next_ones(sensor: NetFt, box: EmulatorInStep) -> None:
    sensor.connect()
    box.fault("delay", 0.03)
    pause(1.0)
    assert sensor.state is Lifecycle.PASSIVE
    assert sensor.read().age_s(CLOCK.now_ns()) >= 0.03


def test_a_status_is_a_fault_that_a_person_recovers_when_it_is_gone(sensor: NetFt, box: EmulatorInStep) -> None:
    sensor.connect()
    sensor.configure()
    sensor.activate()
    box.fault("status", 0x80020000)
    wait(lambda: sensor.state is Lifecycle.FAULTED)
    assert isinstance(sensor.fault, DeviceFault)
    assert sensor.fault.vendor_code == 0x80020000
    with pytest.raises(DeviceFault, match="0x80020000"):
        sensor.recover(TOKEN)
    box.clear("status")
    pause(0.05)
    sensor.recover(TOKEN)
    assert sensor.state is Lifecycle.READY


def test_one_sample_for_ever_is_a_fault(sensor: NetFt, box: EmulatorInStep) -> None:
    sensor.connect()
    box.fault("stuck")
    wait(lambda: sensor.state is Lifecycle.FAULTED)
    assert isinstance(sensor.fault, TransportTimeout)


def test_a_box_without_scales_or_without_samples_is_refused(sensor: NetFt, box: EmulatorInStep) -> None:
    box.fault("bad_calibration")
    with pytest.raises(ConnectError, match="no calibration"):
        sensor.connect()
    box.clear("bad_calibration")
    box.fault("drop", 1_000_000)
    with pytest.raises(ConnectError, match="no sample"):
        sensor.connect()
    assert sensor.state is Lifecycle.DISCONNECTED


def test_public_clients_read_a_stream_and_single_records(box: EmulatorInStep, address: int) -> None:
    # The bytes that public clients send (idealabasu/code_equipment, ros-drivers/ati_netft_ros_driver).
    box.fault("wrench", PUSHED)
    world = box.world
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect((host_of(address), 49152))
        client.setblocking(False)
        for count, wanted in ((1, 1), (5, 5), (0, 20)):
            client.send(struct.pack(">HHI", 0x1234, 2, count))
            for number in range(1, wanted + 1):
                assert world.wait_readable(client.fileno(), world.now_ns() + 1_000_000_000)
                rdt, _, status, *counts = struct.unpack(">IIIiiiiii", client.recv(64))
                assert (rdt, status) == (number, 0)
                np.testing.assert_allclose(np.array(counts) / 1e6, PUSHED)
        client.send(struct.pack(">HHI", 0x1234, 0, 0))
        wait(lambda: box.state()["streams"] == 0)


@given(st.integers(0, 2**32 - 1), st.integers(-(2**31) + 1, 2**31 - 1))
def test_sample_numbers_wrap(before: int, ahead: int) -> None:
    assert codec.step(before, (before + ahead) % 2**32) == ahead


@given(st.binary(max_size=64))
def test_any_bytes_are_a_record_or_a_codec_error(data: bytes) -> None:
    for decode in (codec.decode_record, codec.decode_calibration, codec.decode_request):
        try:
            decode(data)  # type: ignore[operator]
        except CodecError:
            continue


def test_units_of_the_box_are_converted() -> None:
    pounds = codec.decode_calibration(codec.encode_calibration(1, 2, 1000, 500))
    assert pounds.force_n == pytest.approx(4.4482216e-3)
    assert pounds.torque_nm == pytest.approx(1.3558179 / 500)
