"""Validate the emulator with an unmodified third-party client: damiao-motor 1.0.6 (MIT)."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Iterator
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
        # What the client keeps is of the last answer that it has read.
        while abs(np.rad2deg((seen := controller.get_motor(1).get_states())["pos"]) - 10.0) > 1.0:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    assert seen["status"] == "ENABLED"
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


def settle(motor: Any, send: Callable[[], None], reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not reached():
        assert time.monotonic() < deadline
        send()
        time.sleep(0.005)


def fresh(motor: Any, register: int) -> float | int:
    """Read a register again: the client keeps what it has once read, also after its own write."""
    with motor.registers_lock:
        motor.registers.clear()
    return motor.get_register(register)  # type: ignore[no-any-return]


def set_mode(motor: Any, mode: int) -> None:
    motor.write_register(10, mode)
    assert fresh(motor, 10) == mode


def test_it_moves_a_motor_in_every_mode(controller: Any, emulator: EmulatorProcess) -> None:
    motor = controller.get_motor(1)

    def angle() -> float:
        return float(emulator.state()["q_rad"][0])

    def fastest() -> float:
        return float(emulator.state()["dq_rad_s"][0])

    set_mode(motor, 2)
    motor.enable()
    settle(motor, lambda: motor.send_cmd_pos_vel(0.2, 0.5), lambda: abs(angle() - 0.2) < 5e-3)
    set_mode(motor, 3)
    settle(motor, lambda: motor.send_cmd_vel(-0.3), lambda: abs(fastest() + 0.3) < 0.02)
    set_mode(motor, 4)
    settle(motor, lambda: motor.send_cmd_force_pos(0.1, 0.5, 0.5), lambda: abs(angle() - 0.1) < 5e-3)
    # In another mode it hears nothing on this id, and stands.
    before = angle()
    for _ in range(20):
        motor.send_cmd_pos_vel(1.0, 1.0)
        time.sleep(0.002)
    assert abs(angle() - before) < 5e-3


def test_a_scale_that_it_changes_is_that_of_the_frames_and_lasts_only_when_stored(
    controller: Any, emulator: EmulatorProcess
) -> None:
    motor = controller.get_motor(2)
    motor.write_register(21, 6.25)
    assert fresh(motor, 21) == 6.25
    motor.request_motor_feedback()
    deadline = time.monotonic() + 5.0
    # The client still decodes with the old scale, which is twice as large.
    while abs(np.rad2deg(motor.get_states().get("pos", 0.0)) - 2 * START_DEG[1]) > 0.5:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    emulator.fault("restart")
    assert fresh(motor, 21) == 12.5
    motor.write_register(21, 6.25)
    motor.store_parameters()
    assert fresh(motor, 21) == 6.25
    emulator.fault("restart")
    assert fresh(motor, 21) == 6.25


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
