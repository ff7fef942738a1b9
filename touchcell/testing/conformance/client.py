"""Client process that keeps an arm moving, to be killed without warning.

    python -m touchcell.testing.conformance.client FILE FUNCTION FOLDER ADDRESS SPEED_M_S

builds the device fixture FUNCTION of the module in FILE, moves, and prints the silence in s that should stop the
device.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import selectors
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, cast

import numpy as np

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.errors import DeviceGone, TransportTimeout
from touchcell.drivers.core.protocols import NativeWatchdog
from touchcell.testing.emulation.rig import FixtureFactory

_PERIOD_NS = 20_000_000
_WARM_UP = 20
_TTL_S = 0.5
_START_TIMEOUT_S = 20.0


class MovingClient:
    """The client process; a context manager that always ends it.

    Attributes:
        silence_s: silence after which the device should stop by itself: its watchdog, else the time-to-live.
    """

    def __init__(self, function: FixtureFactory, folder: Path, address: int, speed_m_s: float) -> None:
        source = inspect.getsourcefile(function)
        assert source is not None
        self._arguments = [source, function.__name__, str(folder), str(address), str(speed_m_s)]
        self._process: subprocess.Popen[str] | None = None
        self.silence_s = 0.0

    @property
    def pid(self) -> int:
        """Process id."""
        assert self._process is not None
        return self._process.pid

    def __enter__(self) -> Self:
        path = os.pathsep.join(entry for entry in sys.path if entry)
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", "touchcell.testing.conformance.client", *self._arguments],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path},
        )
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            line = self._process.stdout.readline() if selector.select(_START_TIMEOUT_S) else ""
        if not line:
            self._reap()
            raise TransportTimeout("client", "motion of the client process", _START_TIMEOUT_S)
        self.silence_s = float(line)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reap()

    def kill(self) -> None:
        """Send SIGKILL. Raises DeviceGone if it had already ended by itself."""
        process = self._process
        if process is None:
            return
        ended = process.poll()
        self._reap()
        if ended is not None:
            raise DeviceGone("client", f"ended by itself with code {ended} before it was killed")

    def _reap(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def main(arguments: Sequence[str]) -> None:
    """Move until killed."""
    file, function, folder, address, speed_m_s = arguments
    module_spec = importlib.util.spec_from_file_location("rig_of_the_client", file)
    assert module_spec is not None
    assert module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    module_spec.loader.exec_module(module)
    rig = cast(FixtureFactory, getattr(module, function))(Path(folder), int(address))
    clock = MonotonicClock()
    arm = cast(Arm, rig.build(clock))
    arm.connect()
    arm.configure()
    arm.activate()
    lease = arm.acquire("client to be killed")
    twist = float(speed_m_s) * np.eye(6)[rig.spec.capabilities.twist_axes.index(True)]
    count = 0
    while True:
        now_ns = clock.now_ns()
        arm.send_twist(TwistCommand(twist, TwistFrame.BASE, now_ns, _TTL_S), lease)
        count += 1
        if count == _WARM_UP:
            print(arm.watchdog_s() if isinstance(arm, NativeWatchdog) else _TTL_S, flush=True)
        clock.sleep_until_ns(now_ns + _PERIOD_NS)


if __name__ == "__main__":
    main(sys.argv[1:])
