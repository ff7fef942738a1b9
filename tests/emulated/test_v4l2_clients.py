"""Unmodified programs judge the emulated camera: v4l2-compliance, v4l2-ctl, OpenCV, linuxpy, PyAV.

And the driver's own system calls go through the same preloaded shim, as they would through the kernel.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.v4l2.shim import environment
from touchcell.testing.emulation.process import EmulatorProcess

NODE = "/dev/video0"
STABLE = "/dev/v4l/by-id/usb-TacTip_0000-video-index0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("camera")


@pytest.fixture(scope="module")
def emulator(folder: Path) -> Iterator[EmulatorProcess]:
    with EmulatorProcess("v4l2", "--folder", str(folder)) as running:
        yield running


def output(folder: Path, *command: str, check: bool = True) -> str:
    done = subprocess.run(
        command, env=os.environ | environment(folder), capture_output=True, text=True, timeout=60, check=False
    )
    if check:
        assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def client(folder: Path, code: str, *arguments: str) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(output(folder, sys.executable, "-c", code, *arguments).splitlines()[-1])
    return answer


@pytest.mark.skipif(shutil.which("v4l2-compliance") is None, reason="needs v4l-utils")
def test_v4l2_compliance_finds_nothing_wrong_but_event_polling(folder: Path, emulator: EmulatorProcess) -> None:
    printed = output(folder, "v4l2-compliance", "-d", NODE, "-s20", check=False).replace("\r", "\n")
    total = re.search(r"Total for .*: (\d+), Succeeded: (\d+), Failed: (\d+)", printed)
    assert total is not None, printed
    failed = re.findall(r"test (.*): FAIL", printed)
    # Control events cannot be waited for: the frame socket has no exceptional condition that select could report. And
    # "blocking wait" gives a thread 100 ms, which a busy machine may not grant to the emulator's process.
    assert set(failed) - {"blocking wait"} == {"VIDIOC_(UN)SUBSCRIBE_EVENT/DQEVENT"}, printed
    assert int(total[1]) >= 54
    for word in ("MMAP (no poll)", "MMAP (select)", "MMAP (epoll)", "VIDIOC_G/S/TRY_EXT_CTRLS"):
        assert re.search(rf"test {re.escape(word)}: OK\n", printed), word


@pytest.mark.skipif(shutil.which("v4l2-ctl") is None, reason="needs v4l-utils")
def test_v4l2_ctl_sets_and_streams(folder: Path, emulator: EmulatorProcess) -> None:
    output(folder, "v4l2-ctl", "-d", STABLE, "--set-ctrl", "auto_exposure=1,exposure_time_absolute=250,gain=7")
    printed = output(folder, "v4l2-ctl", "-d", STABLE, "--get-ctrl", "exposure_time_absolute,gain")
    assert sorted(printed.splitlines()) == ["exposure_time_absolute: 250", "gain: 7"]
    formats = output(folder, "v4l2-ctl", "-d", NODE, "--list-formats-ext")
    assert all(f"'{name}'" in formats for name in ("MJPG", "YUYV", "GREY"))
    raw = folder / "frame.raw"
    output(
        folder,
        "v4l2-ctl",
        "-d",
        NODE,
        "--set-fmt-video=width=320,height=240,pixelformat=GREY",
        "--stream-mmap",
        "--stream-count=3",
        f"--stream-to={raw}",
    )
    assert raw.stat().st_size == 3 * 320 * 240


OPENCV = """
import json, sys, time, cv2
capture = cv2.VideoCapture(sys.argv[1], cv2.CAP_V4L2)
capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*"MJPG"))
capture.set(cv2.CAP_PROP_FPS, 60)
capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
answer = {"opened": capture.isOpened(), "backend": capture.getBackendName(), "fps": capture.get(cv2.CAP_PROP_FPS)}
answer["exposure"] = [capture.set(cv2.CAP_PROP_EXPOSURE, 157), capture.get(cv2.CAP_PROP_EXPOSURE)]
answer["gamma"] = capture.set(cv2.CAP_PROP_GAMMA, 3)
stamps = []
for _ in range(10):
    good, image = capture.read()
    stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC))
answer |= {"good": good, "shape": image.shape, "bright": float((image > 200).mean()), "stamps_ms": stamps}
answer["now_ms"] = time.monotonic() * 1e3
print(json.dumps(answer))
"""


def test_opencv_reads_pins_and_kernel_timestamps(folder: Path, emulator: EmulatorProcess) -> None:
    seen = client(folder, OPENCV, NODE)
    assert seen["opened"]
    assert (seen["backend"], seen["fps"], seen["exposure"], seen["gamma"]) == ("V4L2", 60.0, [True, 157.0], False)
    assert seen["good"]
    assert seen["shape"] == [480, 640, 3]
    assert 0.05 < seen["bright"] < 0.2
    stamps_ms = seen["stamps_ms"]
    assert sorted(set(stamps_ms)) == stamps_ms
    assert 0.0 < seen["now_ms"] - stamps_ms[-1] < 1000.0
    assert emulator.wait_for(clients=0)["streaming"] is False


UNPLUGGED = """
import json, sys, cv2
capture = cv2.VideoCapture(sys.argv[1], cv2.CAP_V4L2)
assert capture.read()[0]
print("streaming", flush=True)
while capture.read()[0]:
    pass
print(json.dumps({"reopened": cv2.VideoCapture(sys.argv[1], cv2.CAP_V4L2).isOpened()}))
"""


def test_opencv_loses_an_unplugged_camera(folder: Path, emulator: EmulatorProcess) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", UNPLUGGED, NODE],
        env=os.environ | environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"streaming\n"
        emulator.fault("unplug")
        try:
            assert json.loads(program.stdout.readline()) == {"reopened": False}
            assert program.wait() == 0
        finally:
            emulator.clear("unplug")
            program.kill()


LINUXPY = """
import json, sys
from linuxpy.video.device import Device, VideoCapture
with Device(sys.argv[1]) as camera:
    capture = VideoCapture(camera)
    capture.set_format(640, 480, "GREY")
    capture.set_fps(60)
    numbers, sizes = [], []
    with capture:
        for frame in capture:
            numbers.append(frame.frame_nb)
            sizes.append(len(bytes(frame)))
            if len(numbers) == 10:
                break
    names = sorted(control.name for control in camera.controls.values())
print(json.dumps({"card": camera.info.card, "numbers": numbers, "sizes": sizes, "controls": names}))
"""


def test_linuxpy_counts_the_same_frames(folder: Path, emulator: EmulatorProcess) -> None:
    pytest.importorskip("linuxpy")
    seen = client(folder, LINUXPY, NODE)
    assert seen["card"] == "TacTip emulated"
    assert seen["numbers"] == sorted(set(seen["numbers"]))
    assert set(seen["sizes"]) == {640 * 480}
    assert "Exposure Time, Absolute" in seen["controls"]


PYAV = """
import json, sys, av
with av.open(sys.argv[1], format="v4l2", options={"video_size": "320x240", "input_format": "yuyv422"}) as camera:
    frames = [frame for frame, _ in zip(camera.decode(video=0), range(5))]
sizes = [[frame.width, frame.height] for frame in frames]
print(json.dumps({"sizes": sizes, "stamps": [frame.pts for frame in frames]}))
"""


def test_pyav_decodes_it(folder: Path, emulator: EmulatorProcess) -> None:
    pytest.importorskip("av")
    seen = client(folder, PYAV, NODE)
    assert seen["sizes"] == [[320, 240]] * 5
    assert seen["stamps"] == sorted(set(seen["stamps"]))


def test_without_a_compiler_the_shim_raises_a_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConnectError, match="no C compiler"):
        environment(tmp_path)


DRIVER = """
import json, sys
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.v4l2.driver import V4l2Camera, V4l2Config
camera = V4l2Camera("tip", MonotonicClock(), V4l2Config(device=sys.argv[1], rate_hz=60, exposure_us=15700, gain=10))
with camera:
    camera.configure()
    frames = [camera.latest()]
    while len(frames) < 10:
        frames.append(camera.next(frames[-1].seq, 1.0))
    health = camera.health()
print(json.dumps({"seqs": [frame.seq for frame in frames], "shape": frames[0].value.image.shape, "health": health}))
"""


def test_the_driver_works_through_real_system_calls(folder: Path, emulator: EmulatorProcess) -> None:
    seen = client(folder, DRIVER, STABLE)
    assert seen["seqs"] == sorted(set(seen["seqs"]))
    assert seen["shape"] == [480, 640]
    health = seen["health"]
    assert (health["exposure_us"], health["gain"], health["kernel_stamps"]) == (15700, 10, True)
    assert (health["frames_bad"], health["frames_lost"]) == (0, 0)
    assert emulator.wait_for(clients=0)["buffers"] == 0
