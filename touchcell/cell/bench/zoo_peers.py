"""Public clients of the emulated wires, as people use them, for ``touchcell bench zoo --peers``.

Each is an unmodified library in a process of its own: a short loop that reads, commands, and stops at the first
exception or failure code, as a careful program of its users would.
"""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from touchcell.drivers.v4l2.shim import environment

_START_S = 20.0
_PERIOD = "0.02"

_UR = """
import rtde_control, rtde_receive
receive = rtde_receive.RTDEReceiveInterface(address)
control = rtde_control.RTDEControlInterface(address)
def step():
    receive.getActualTCPPose()
    if not control.speedL([0, 0, 0.002, 0, 0, 0], 0.25, 0.02):
        raise RuntimeError("speedL returned False")
"""
_FRANKA = """
import franky
robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
robot.relative_dynamics_factor = 0.05
def step():
    twist = franky.Twist([0, 0, 0.002], [0, 0, 0])
    robot.move(franky.CartesianVelocityMotion(twist, duration=franky.Duration(200)), asynchronous=True)
    robot.poll_motion()
"""
_DAMIAO = """
import logging, warnings
warnings.simplefilter("ignore")
import damiao_motor
controller = damiao_motor.DaMiaoController(channel=address, bustype="touchcell_hub")
for number in range(1, 7):
    controller.add_motor(number, number + 0x10, "4340" if number <= 3 else "4310")
motors = controller.all_motors()
for motor in motors:
    motor.get_register(21)
controller.enable_all()
time.sleep(0.3)
start = [motor.get_states().get("pos", 0.0) for motor in motors]
def step():
    for motor, q in zip(motors, start):
        motor.send_cmd_mit(q, 0.0, 60.0, 2.0, 0.0)
    for motor in motors:
        status = motor.get_states().get("status")
        if status != "ENABLED":
            raise RuntimeError(f"status {status}")
"""
_FEETECH = """
import scservo_sdk as scs
port, sdk = scs.PortHandler(address), scs.PacketHandler(0)
if not (port.openPort() and port.setBaudRate(1_000_000)):
    raise RuntimeError("the port does not open")
reader, ids = scs.GroupSyncRead(port, sdk, 56, 2), range(1, 6)
for number in ids:
    model, result, error = sdk.ping(port, number)
    if result != scs.COMM_SUCCESS:
        raise RuntimeError(sdk.getTxRxResult(result))
    if error:
        raise RuntimeError(sdk.getRxPacketError(error))
    sdk.write1ByteTxRx(port, number, 40, 1)
    reader.addParam(number)
def step():
    result = reader.txRxPacket()
    if result != scs.COMM_SUCCESS:
        raise RuntimeError(sdk.getTxRxResult(result))
"""
_OPENCV = """
import cv2
camera = cv2.VideoCapture(address, cv2.CAP_V4L2)
if not camera.isOpened():
    raise RuntimeError("VideoCapture does not open")
camera.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*"MJPG"))
camera.set(cv2.CAP_PROP_FPS, 60)
camera.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
camera.set(cv2.CAP_PROP_EXPOSURE, 157)
if not camera.read()[0]:
    raise RuntimeError("read returned False")
def step():
    if not camera.read()[0]:
        raise RuntimeError("read returned False")
"""
_LOOP = f"""
print("ready", flush=True)
import select, sys
while not select.select([sys.stdin], [], [], {_PERIOD})[0]:
    step()
"""


@dataclass(frozen=True, slots=True)
class Peer:
    """A public client.

    Attributes:
        name: of the library.
        module: what it is imported as.
        package: what it is installed as.
        program: the loop: connects to ``address`` and defines ``step``.
        address: where it finds the emulator, from the configuration of our driver.
        preloads: whether it needs the shim of emulated cameras.
    """

    name: str
    module: str
    package: str
    program: str
    address: Callable[[Any], str]
    preloads: bool = False

    @property
    def installed(self) -> bool:
        """Whether the library is installed here."""
        return find_spec(self.module) is not None

    @property
    def version(self) -> str:
        """Version of the library; empty if it is not installed."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return ""


PEER_CLIENTS: Final[Mapping[str, Peer]] = {
    "ur": Peer("ur-rtde", "rtde_control", "ur-rtde", _UR, lambda config: str(config.host)),
    "franka": Peer("franky", "franky", "franky-control", _FRANKA, lambda config: str(config.host)),
    "damiao_can": Peer("damiao-motor", "damiao_motor", "damiao-motor", _DAMIAO, lambda config: str(config.channel)),
    "feetech_serial": Peer(
        "feetech-servo-sdk", "scservo_sdk", "feetech-servo-sdk", _FEETECH, lambda config: str(config.port)
    ),
    "v4l2": Peer("OpenCV", "cv2", "opencv-python-headless", _OPENCV, lambda config: str(config.device), preloads=True),
}
"""Clients by the driver that speaks the same wire."""


class PeerProcess:
    """One client in a process of its own.

    Args:
        peer: which.
        config: configuration of our driver for the same emulator.
        folder: of emulated cameras.
    """

    def __init__(self, peer: Peer, config: Any, folder: Path) -> None:
        program = f"import time\naddress = {peer.address(config)!r}\n{peer.program}{_LOOP}"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | (environment(folder) if peer.preloads else {}),
        )

    def started(self) -> str | None:
        """Wait until it is in its loop; return None, or why it is not."""
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            deadline_s = time.monotonic() + _START_S
            while time.monotonic() < deadline_s and selector.select(deadline_s - time.monotonic()):
                line = self._process.stdout.readline()
                if line.strip() == b"ready":
                    return None
                if not line:
                    return self._last_words()
        return f"does not start within {_START_S:g} s"

    def trouble_within(self, seconds: float) -> str | None:
        """Return the error that ends it within ``seconds``, or None if it continues."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        return self._last_words()

    def _last_words(self) -> str:
        assert self._process.stderr is not None
        lines = self._process.stderr.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"ended with {self._process.wait()}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
