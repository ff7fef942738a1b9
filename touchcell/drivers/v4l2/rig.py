"""Test fixture: the V4L2 driver with an emulated camera."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

from touchcell.drivers.core.camera import CameraConfig
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.v4l2.driver import SPEC, V4l2Camera, V4l2Config
from touchcell.drivers.v4l2.shim import ShimCalls
from touchcell.testing.emulation.in_cell import EmulatedDriver
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

_RATE_HZ = 60.0
_PATIENCE_S = 2.0


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build a camera at /dev/video``address`` whose sockets are in ``folder``."""
    config = V4l2Config(
        device=f"/dev/v4l/by-id/usb-TacTip_{address:04d}-video-index0", rate_hz=_RATE_HZ, exposure_us=15700, gain=10
    )

    def start() -> EmulatorProcess:
        return EmulatorProcess("v4l2", "--folder", str(folder), "--minor", str(address)).start()

    def build(clock: Clock) -> Device:
        return V4l2Camera("tip", clock, config, ShimCalls(folder))

    return DeviceFixture(
        spec=SPEC,
        start=start,
        build=build,
        config=config,
        configured=lambda other, clock: V4l2Camera("tip", clock, other, ShimCalls(folder)),
        position=None,
        state_rate_hz=_RATE_HZ,
        faults={
            "drop": (2, "transient"),
            "corrupt": (2, "transient"),
            "error_flag": (2, "transient"),
            "out_of_order": (2, "transient"),
            "delay": (0.2, "stale"),
            "pause": (True, "fault"),
            "unplug": (True, "fault"),
            "restart": (0.2, "fault"),
        },
        notes=(
            "frame pacing, exposure latency and error frames of real uvcvideo cameras are known from documents only",
            "stamps of the emulated camera have no transport delay; a USB camera delivers about one frame time later",
        ),
    )


class CallsInStep(ShimCalls):
    """System calls on cameras that share the simulated time of a ``Lockstep`` world with the caller."""

    @property
    def _world(self) -> Lockstep:
        world = emulated_clock()
        assert isinstance(world, Lockstep)
        return world

    def open(self, path: str) -> int:
        return self._world.outside(lambda: ShimCalls.open(self, path))

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int32) -> None:
        self._world.outside(lambda: ShimCalls.ioctl(self, fd, request, argument))

    def poll(self, fd: int, timeout_s: float) -> int:
        self._world.wait_readable(fd, self._world.now_ns() + round(1e9 * max(timeout_s, 0.0)))
        return super().poll(fd, 0.0)


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same camera as ``rig`` on a simulated time, which the emulator shares with the driver."""
    fixture = rig(folder, address)
    world = Lockstep()
    arguments = ("--folder", str(folder), "--minor", str(address))

    def build(config: V4l2Config, clock: Clock) -> Device:
        return V4l2Camera("tip", clock, config, CallsInStep(folder))

    return replace(
        fixture,
        start=lambda: emulator_in_step(world, "v4l2", *arguments).start(),
        build=lambda clock: build(cast(V4l2Config, fixture.config), clock),
        configured=build,
        world=world,
        clock=lambda: world,
        reachable=False,
    )


def _settings(config: CameraConfig, folder: Path, number: int) -> Mapping[str, Any]:
    # Emulators share this machine's cores with the cell: a pause is no failure of theirs.
    stall_s = max(config.stall_s, _PATIENCE_S)
    return {"device": f"/dev/v4l/by-id/usb-TacTip_{number:04d}-video-index0", "stall_s": stall_s}


_FAULTS: Final[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {
    "frozen": ("freeze_frame", bool),
    "last_seq": ("pause", lambda _: True),
    "extra_latency_s": ("delay", float),
    "gain": ("gain", float),
}

EMULATED = EmulatedDriver("v4l2", _settings, faults=_FAULTS)
