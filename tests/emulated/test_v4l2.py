"""The V4L2 driver on an emulated camera in a process of its own, in real time."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.samples import Quality
from touchcell.drivers.v4l2.driver import V4l2Camera, V4l2Config
from touchcell.drivers.v4l2.shim import ShimCalls
from touchcell.testing.emulation.process import EmulatorProcess

NODE = "/dev/video7"


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[EmulatorProcess]:
    with EmulatorProcess("v4l2", "--folder", str(tmp_path), "--minor", "7") as running:
        yield running


CLIENT = """
import sys
from pathlib import Path
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.v4l2.shim import ShimCalls
from touchcell.drivers.v4l2.driver import V4l2Camera, V4l2Config
camera = V4l2Camera("tip", MonotonicClock(), V4l2Config(device=sys.argv[2]), ShimCalls(Path(sys.argv[1])))
camera.connect()
camera.configure()
print(camera.latest().seq, flush=True)
sys.stdin.read()
"""


def test_a_client_killed_while_streaming_leaves_the_camera_free(tmp_path: Path, emulator: EmulatorProcess) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CLIENT, str(tmp_path), NODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as client:
        assert client.stdout is not None
        assert int(client.stdout.readline()) >= 0
        assert emulator.state()["streaming"] is True
        client.kill()
    emulator.wait_for(clients=0, streaming=False)
    with V4l2Camera("tip", MonotonicClock(), V4l2Config(device=NODE), ShimCalls(tmp_path)) as camera:
        camera.configure()
        assert camera.latest().quality is Quality.GOOD
