"""Measure one client of one device, ours or the vendor's, in its own process.

    python -m touchcell.cell.bench.device_client ours|vendor NAME FOLDER ADDRESS

prints its figures as one line of JSON.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchcell.testing.emulation.rig import RIGS

_RATE_S = 1.0
_CYCLES = 100
_CYCLE_NS = 10_000_000
_TTL_S = 0.1
_SPEED_M_S = 0.005


def ours(name: str, folder: Path, address: int) -> dict[str, Any]:
    """Measure touchcell's driver on the device fixture ``name``."""
    from touchcell.drivers.core.clock import MonotonicClock
    from touchcell.drivers.core.commands import TwistCommand, TwistFrame

    rig = RIGS.load(name)(folder, address)
    clock = MonotonicClock()
    # An arm or a camera, as the rig says; which calls that allows is known only then.
    device: Any = rig.build(clock)
    start_s = time.perf_counter()
    device.connect()
    connect_s = time.perf_counter() - start_s
    device.configure()
    device.activate()
    row: dict[str, Any] = {"connect_s": connect_s, "active_s": time.perf_counter() - start_s}
    is_camera = rig.spec.capabilities.kind == "camera"
    read: Callable[[], Any] = device.latest if is_camera else device.tcp
    row["rate_hz"] = _rate(lambda: read().seq)
    ages_ms = []
    for _ in range(200):
        ages_ms.append((clock.now_ns() - read().t_ns) * 1e-6)
        # Not a multiple of any device's period.
        time.sleep(0.0037)
    row["age_ms"] = float(np.median(ages_ms))
    lease = None if is_camera else device.acquire("bench")
    axis = np.eye(6)[rig.spec.capabilities.twist_axes.index(True)]
    used_s = time.process_time()
    sequence = -1
    for cycle in range(_CYCLES):
        now_ns = clock.now_ns()
        if is_camera:
            sequence = device.next(sequence, 1.0).seq
        else:
            read()
            sign = 1.0 if cycle % 40 < 20 else -1.0
            device.send_twist(TwistCommand(sign * _SPEED_M_S * axis, TwistFrame.BASE, now_ns, _TTL_S), lease)
            clock.sleep_until_ns(now_ns + _CYCLE_NS)
    row["cycle_cpu_us"] = (time.process_time() - used_s) / _CYCLES * 1e6
    row["memory_mb"] = _memory_mb()
    device.disconnect()
    return row


def vendor(name: str, folder: Path, address: int) -> dict[str, Any]:
    """Measure the vendor's own client on the same emulator. Raises ImportError where it is not installed."""
    start_s = time.perf_counter()
    read = _VENDORS[name](folder, address)
    read()
    row: dict[str, Any] = {"connect_s": time.perf_counter() - start_s}
    if name not in _UNNUMBERED:
        row["rate_hz"] = _rate(read)
    return {**row, "memory_mb": _memory_mb()}


def _ur(folder: Path, address: int) -> Callable[[], Any]:
    from rtde_receive import RTDEReceiveInterface

    from touchcell.drivers.ur.rig import host_of

    receive = RTDEReceiveInterface(host_of(address), 500.0)
    return lambda: (receive.getTimestamp(), receive.getActualTCPPose())[0]


def _franka(folder: Path, address: int) -> Callable[[], Any]:
    import franky

    from touchcell.drivers.franka.rig import host_of

    robot = franky.Robot(host_of(address), realtime_config=franky.RealtimeConfig.Ignore)
    return lambda: robot.state.time.to_msec()


def _damiao(folder: Path, address: int) -> Callable[[], Any]:
    from damiao_motor import DaMiaoController

    controller = DaMiaoController(channel=str(folder / f"can-{address}"), bustype="touchcell_hub")
    motors = [controller.add_motor(number, 0x10 + number, "4340") for number in range(1, 7)]

    def read() -> None:
        # The client returns the latest data without a number or a stamp: its rate cannot be measured.
        for motor in motors:
            motor.request_motor_feedback()
        deadline_s = time.perf_counter() + 2.0
        while not all(motor.get_states() for motor in motors) and time.perf_counter() < deadline_s:
            time.sleep(0.001)

    return read


def _feetech(folder: Path, address: int) -> Callable[[], Any]:
    import scservo_sdk

    port = scservo_sdk.PortHandler(str(folder / f"servos-{address}"))
    port.openPort()
    reader = scservo_sdk.GroupSyncRead(port, scservo_sdk.PacketHandler(0), 56, 4)
    for number in range(1, 6):
        reader.addParam(number)
    count = [0]

    def read() -> int:
        reader.txRxPacket()
        count[0] += 1
        return count[0]

    return read


def _v4l2(folder: Path, address: int) -> Callable[[], Any]:
    import cv2

    capture = cv2.VideoCapture(f"/dev/video{address}", cv2.CAP_V4L2)
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    capture.set(cv2.CAP_PROP_FPS, 60)

    def read() -> float:
        capture.read()
        return capture.get(cv2.CAP_PROP_POS_MSEC)

    return read


_UNNUMBERED = ("damiao_can",)
_VENDORS: dict[str, Callable[[Path, int], Callable[[], Any]]] = {
    "ur": _ur,
    "franka": _franka,
    "damiao_can": _damiao,
    "feetech_serial": _feetech,
    "v4l2": _v4l2,
}


def _rate(read: Callable[[], Any]) -> float:
    """Return distinct samples per second."""
    seen = {read()}
    start_s = time.perf_counter()
    while (passed_s := time.perf_counter() - start_s) < _RATE_S:
        seen.add(read())
        time.sleep(0.0003)
    return (len(seen) - 1) / passed_s


def _memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(arguments: Sequence[str]) -> None:
    """Measure and print."""
    who, name, folder, address = arguments
    print(json.dumps((ours if who == "ours" else vendor)(name, Path(folder), int(address))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
    # Vendor threads may not end by themselves.
    os._exit(0)
