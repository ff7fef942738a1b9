"""The OpenCV fallback driver, in programs that see the emulated camera through the preloaded shim.

A program reports in lines of JSON and waits for a line where the test changes the state of the camera.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from touchcell.drivers.core.spec import DRIVERS
from touchcell.drivers.v4l2.shim import environment
from touchcell.testing.emulation.process import EmulatorProcess

PRELUDE = """
import json, sys, threading
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.device import OperatorToken
from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.camera import UnsupportedSetting
from touchcell.drivers.opencv.driver import OpencvCamera, OpencvCameraConfig

def make(**settings):
    defaults = {"device": "/dev/video0", "rate_hz": 60, "exposure_us": 15700, "gain": 10}
    return OpencvCamera("tip", MonotonicClock(), OpencvCameraConfig.model_validate(defaults | settings))

def ready(**settings):
    camera = make(**settings)
    camera.connect()
    camera.configure()
    return camera

def read(camera, frames):
    got = [camera.latest()]
    while len(got) < frames:
        got.append(camera.next(got[-1].seq, 2.0))
    return got

def until(camera, reading, least):
    for _ in range(600):
        camera.next(camera.latest().seq, 2.0)
        if camera.health().get(reading, 0) >= least:
            break
    return camera.health()

def say(answer):
    print(json.dumps(answer), flush=True)

def wait():
    sys.stdin.readline()
"""


class Program:
    """A running Python program."""

    def __init__(self, folder: Path, code: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PRELUDE + code],
            env=os.environ | environment(folder),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def last_reply(self) -> Any:
        """Its next answer."""
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def go_on(self) -> None:
        """Let it continue."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.communicate()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("camera")


@pytest.fixture(scope="module")
def emulator(folder: Path) -> Iterator[EmulatorProcess]:
    with EmulatorProcess("v4l2", "--folder", str(folder)) as running:
        yield running


@pytest.fixture
def run(folder: Path, emulator: EmulatorProcess) -> Iterator[Callable[[str], Program]]:
    programs: list[Program] = []

    def start(code: str) -> Program:
        programs.append(Program(folder, code))
        return programs[-1]

    yield start
    for program in programs:
        program.end()
    emulator.wait_for(clients=0)


def test_the_driver_is_found_by_name() -> None:
    assert DRIVERS.load("opencv_camera").capabilities.kind == "camera"


def test_connecting_changes_no_control(run: Callable[[str], Program], emulator: EmulatorProcess) -> None:
    controls = emulator.state()["controls"]
    program = run("camera = make(); camera.connect(); say(camera.state.value); wait()")
    assert program.last_reply() == "passive"
    state = emulator.state()
    assert (state["controls"], state["energising"]) == (controls, 0)


def test_frames_are_stamped_in_order_and_the_thread_ends_with_the_camera(run: Callable[[str], Program]) -> None:
    program = run("""
camera = ready()
say([[f.seq, f.t_ns, f.value.image.shape, f.quality.value, f.value.gain] for f in read(camera, 10)])
say(camera.health())
say([thread.name for thread in threading.enumerate()])
camera.disconnect()
say([thread.name for thread in threading.enumerate()])
""")
    seqs, stamps, shapes, qualities, gains = zip(*program.last_reply(), strict=True)
    assert list(seqs) == sorted(set(seqs))
    assert list(stamps) == sorted(set(stamps))
    assert {tuple(shape) for shape in shapes} == {(480, 640)}
    assert (set(qualities), set(gains)) == ({"good"}, {10.0})
    health = program.last_reply()
    assert (health["sequence_numbers"], health["exposure_us"], health["frames_bad"]) == (False, 15700, 0)
    assert program.last_reply() == ["MainThread", "tip reader"]
    assert program.last_reply() == ["MainThread"]


@pytest.mark.parametrize("pixel_format", ["YUYV", "GREY"])
def test_raw_formats_decode_too(run: Callable[[str], Program], pixel_format: str) -> None:
    program = run(f"""
image = ready(pixel_format={pixel_format!r}).latest().value.image
say([image.shape, int(image.min()), int(image.max())])
""")
    # Skin 24, pins 230 and noise up to 2, in 1.2 times the light.
    assert program.last_reply() == [[480, 640], 28, 255]


def test_refused_settings_are_named(run: Callable[[str], Program]) -> None:
    program = run("""
try:
    ready(width_px=700)
except UnsupportedSetting as refused:
    say([refused.setting, refused.requested, refused.given])
""")
    assert program.last_reply() == ["width_px", 700, 640]


def test_short_frames_are_refused_and_lost_ones_noticed(
    run: Callable[[str], Program], emulator: EmulatorProcess
) -> None:
    program = run("""
camera = ready()
say(camera.health())
wait()
say(until(camera, "frames_bad", 2))
wait()
say(until(camera, "frames_lost", 4))
""")
    assert program.last_reply()["frames_bad"] == 0
    emulator.fault("corrupt", 2)
    program.go_on()
    assert program.last_reply()["frames_bad_damaged"] == 2
    emulator.fault("drop", 4)
    program.go_on()
    assert program.last_reply()["frames_lost"] >= 4


def test_an_unplugged_camera_is_a_fault_until_recovered(
    run: Callable[[str], Program], emulator: EmulatorProcess
) -> None:
    program = run("""
camera, token = ready(), OperatorToken("test", 0)
say(camera.state.value)
try:
    read(camera, 100_000)
except DeviceGone:
    say(camera.state.value)
try:
    camera.recover(token)
except ConnectError:
    say(camera.state.value)
wait()
camera.recover(token)
say(len(read(camera, 3)))
""")
    assert program.last_reply() == "ready"
    emulator.fault("unplug")
    assert program.last_reply() == "faulted"
    assert program.last_reply() == "faulted"
    emulator.clear("unplug")
    program.go_on()
    assert program.last_reply() == 3
