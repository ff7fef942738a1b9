"""Validate the emulator with an unmodified third-party client: damiao-motor 1.0.6 (MIT)."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchcell.drivers.damiao import codec
from touchcell.testing.emulation.process import EmulatorProcess

damiao_motor = pytest.importorskip("damiao_motor")
START_DEG = [0.0, 40.0, 90.0, 0.0, 50.0, 0.0]


@pytest.fixture(scope="module")
def channel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("judges") / "bus"


@pytest.fixture(scope="module")
def process(channel: Path) -> Iterator[EmulatorProcess]:
    with EmulatorProcess("damiao", str(channel)) as process:
        yield process


@pytest.fixture
def emulator(process: EmulatorProcess) -> EmulatorProcess:
    process.fault("reset")
    return process


@pytest.fixture
def controller(channel: Path, emulator: EmulatorProcess) -> Iterator[Any]:
    # The client still uses bustype=, which python-can 4 deprecates.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        controller = damiao_motor.DaMiaoController(channel=str(channel), bustype="touchcell_hub")
    for number in range(1, 7):
        controller.add_motor(number, number + 0x10, "4340" if number <= 3 else "4310")
    yield controller
    controller.shutdown()


class Holding:
    """Sends every motor its angle until stopped."""

    def __init__(self, controller: Any, angles_deg: list[float]) -> None:
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(controller, np.deg2rad(angles_deg)))

    def _run(self, controller: Any, angles: np.ndarray) -> None:
        while not self._stopped.wait(0.005):
            for motor, angle in zip(controller.all_motors(), angles, strict=True):
                motor.send_cmd_mit(float(angle), 0.0, 150.0, 3.0, 0.0)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()


def test_it_reads_the_registers(controller: Any) -> None:
    first, last = controller.get_motor(1), controller.get_motor(6)
    assert (first.get_register(7), first.get_register(8), first.get_register(9), first.get_register(10)) == (
        17,
        1,
        8000,
        1,
    )
    assert [first.get_register(rid) for rid in (21, 22, 23)] == [12.5, 10.0, 28.0]
    assert [last.get_register(rid) for rid in (21, 22, 23)] == [12.5, 30.0, 10.0]


def test_it_enables_and_moves_the_arm(controller: Any, emulator: EmulatorProcess) -> None:
    controller.enable_all()
    emulator.wait_for(enabled=6)
    goal = [10.0, *START_DEG[1:]]
    with Holding(controller, goal):
        deadline = time.monotonic() + 10.0
        while abs(np.rad2deg(emulator.state()["q_rad"][0]) - 10.0) > 0.3:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        seen = controller.get_motor(1).get_states()
    assert seen["status"] == "ENABLED"
    assert np.rad2deg(seen["pos"]) == pytest.approx(10.0, abs=1.0)
    assert (seen["t_mos"], seen["t_rotor"]) == (33.0, 35.0)
    controller.disable_all()
    emulator.wait_for(enabled=0)


def test_it_sets_the_timeout_and_detects_its_trip(controller: Any, emulator: EmulatorProcess) -> None:
    motor = controller.get_motor(2)
    controller.enable_all()
    motor.set_can_timeout(50)
    state = emulator.wait_for(watchdog_s=[0.4, 0.05, 0.4, 0.4, 0.4, 0.4])
    assert state["energising"] == 6
    emulator.wait_for(status=[13] * 6)
    motor.request_motor_feedback()
    deadline = time.monotonic() + 5.0
    while motor.get_states().get("status") != "LOST_COMM":
        assert time.monotonic() < deadline
        time.sleep(0.005)
    motor.clear_error()
    emulator.wait_for(status=[13, 0, 13, 13, 13, 13])


def test_it_decodes_injected_faults(controller: Any, emulator: EmulatorProcess) -> None:
    motor = controller.get_motor(5)
    for status, name in ((0xA, "OVER_CURRENT"), (0xE, "OVERLOAD"), (0x9, "UNDER_VOLTAGE")):
        emulator.fault("fault_bits", [4, status])
        motor.request_motor_feedback()
        deadline = time.monotonic() + 5.0
        while motor.get_states().get("status") != name:
            assert time.monotonic() < deadline
            time.sleep(0.005)


def test_our_bytes_are_its_bytes_within_a_step(controller: Any) -> None:
    rng = np.random.default_rng(2)
    motor, ranges = controller.get_motor(6), codec.Ranges(12.5, 30.0, 10.0)
    highest = np.array([12.5, 30.0, 500.0, 5.0, 10.0])
    lowest = np.array([-12.5, -30.0, 0.0, 0.0, -10.0])
    for _ in range(300):
        values = rng.uniform(lowest, highest)
        q, dq, kp, kd, tau = values
        theirs = codec.decode_mit(bytes(motor.encode_cmd_msg(q, dq, tau, kp, kd)), ranges)
        ours = codec.decode_mit(codec.encode_mit(codec.MitCommand(*values), ranges), ranges)
        steps = (highest - lowest) / np.array([65535, 4095, 4095, 4095, 4095])
        for field, step, value in zip(("q", "dq", "kp", "kd", "tau"), steps, values, strict=True):
            # It truncates, we round: its error may be a full step.
            assert abs(getattr(theirs, field) - getattr(ours, field)) <= step * 1.001
            assert abs(getattr(ours, field) - value) <= step * 0.501
