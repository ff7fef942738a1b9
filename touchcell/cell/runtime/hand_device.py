"""``python -m touchcell.cell.runtime.hand_device NAME FOLDER``: reads an input device for a run, in its own process.

Whatever a vendor's library does, as to block or to crash, it does here: the run then hears nothing, and its arm stands.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from touchcell.cell.runtime.child_processes import end_all
from touchcell.cell.runtime.jog_channel import JogMessage, JogSender
from touchcell.cell.runtime.jog_settings import JogSettings
from touchcell.drivers.core.jog import AT_REST, HAND_DEVICES, Axes, HandDevice, HandState, JogButton, JogRequest
from touchcell.errors import TouchcellError

_PERIOD_S: Final = 0.005
_STEP_AT: Final = 0.6
_NEXT_STEP_AT: Final = 0.3
"""Deflections at which a step begins, and below which there may be another."""
_END_S: Final = 2.0


class HandPilot:
    """Turns what an input device reports into jog messages.

    Args:
        arms: roles of the arms, one of which is moved.

    Attributes:
        settings: how the next deflection moves.
    """

    def __init__(self, arms: Sequence[str]) -> None:
        self._arms = tuple(arms)
        self._seq = 0
        self._was_asked = False
        self._step: Axes | None = None
        self.settings = JogSettings(self._arms[0])

    def message(self, state: HandState, now_ns: int) -> JogMessage:
        """Return the message for a state that was read at ``now_ns``."""
        stop = "at once" if JogButton.STOP in state.pressed else ""
        for button in state.pressed:
            self.settings = self.settings.after(button, self._arms)
        request = None if state.pressed or not state.held else self._request(state)
        if request is not None and not self._was_asked:
            self._seq += 1
        self._was_asked = request is not None
        return JogMessage(now_ns, request, self._seq, stop)

    def _request(self, state: HandState) -> JogRequest | None:
        if state.retract:
            return self.settings.retraction()
        if self.settings.steps:
            return self._stepped(state.axes)
        return None if state.axes == AT_REST else self.settings.request(state.axes)

    def _stepped(self, axes: Axes) -> JogRequest | None:
        """One step along the axis that is deflected most, and no other before the stick has come back."""
        most = max(range(6), key=lambda k: abs(axes[k]))
        if abs(axes[most]) < _NEXT_STEP_AT:
            self._step = None
        elif self._step is None and abs(axes[most]) >= _STEP_AT:
            x, y, z, a, b, c = ((1.0 if axes[k] > 0.0 else -1.0) if k == most else 0.0 for k in range(6))
            self._step = (x, y, z, a, b, c)
        return None if self._step is None else self.settings.request(self._step)


def read_device(device: HandDevice, sender: JogSender, arms: Sequence[str], going: Callable[[], bool]) -> None:
    """Send what a device reports until the run ends.

    Raises:
        DeviceError: the device cannot be read any more.
    """
    pilot = HandPilot(arms)
    shown = pilot.settings
    try:
        while going() and sender.send(pilot.message(device.read(), time.monotonic_ns())):
            sender.shown()
            if pilot.settings != shown:
                shown = pilot.settings
                print(f"\r{shown.describe()}\r", file=sys.stderr)
            time.sleep(_PERIOD_S)
    except EOFError:
        pass


@contextmanager
def devices_read(names: Sequence[str], folder: Path, arms: Sequence[str]) -> Iterator[None]:
    """Read input devices for the run in ``folder``, each in a process of its own, within the context.

    Raises:
        ConfigError: there is no such input device.
    """
    for name in names:
        HAND_DEVICES.load(name)
    command = [sys.executable, "-m", "touchcell.cell.runtime.hand_device"]
    processes = [
        subprocess.Popen(
            [*command, name, str(folder.absolute()), *arms], stdin=subprocess.DEVNULL, start_new_session=True
        )
        for name in names
    ]
    try:
        yield
    finally:
        end_all(processes, _END_S)


def main() -> int:
    """Read until the parent has gone, the run has ended, or the device has."""
    name, folder, arms, parent = sys.argv[1], Path(sys.argv[2]), sys.argv[3:], os.getppid()
    try:
        device = HAND_DEVICES.load(name).connect()
        sender = JogSender(folder)
    except TouchcellError as error:
        print(f"no input from {name}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"no input from {name}: the run takes none: {error.strerror}", file=sys.stderr)
        return 1
    try:
        read_device(device, sender, arms, lambda: os.getppid() == parent)
    except TouchcellError as error:
        print(f"{error}: the arm stands", file=sys.stderr)
        return 1
    finally:
        sender.close()
        device.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
