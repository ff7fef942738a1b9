"""SpaceMouse by ``pyspacemouse`` (extra ``spacemouse``); its first button is the dead-man control.

The second button changes the frame. Axes are those of REP 103, x away from the operator, y to the left and z up, taken
as those of the chosen frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.jog import HandDeviceSpec, HandState, JogButton

NAME: Final = "spacemouse"
_DEAD_ZONE: Final = 0.08
_MOST_REPORTS: Final = 32
"""Reports that are read at once; the device sends no more than 125 of them per second."""


@dataclass
class SpaceMouse:
    """One device; see ``touchcell.drivers.core.jog.HandDevice``.

    Args:
        device: a ``pyspacemouse.SpaceMouseDevice``, opened without blocking, with the axes of REP 103.
    """

    device: Any
    _was: tuple[bool, ...] = ()

    def read(self) -> HandState:
        """Return what is held now. Raises DeviceGone when it has been unplugged."""
        pressed: list[JogButton] = []
        try:
            state, before = self.device.read(), math.nan
            for _ in range(_MOST_REPORTS):
                pressed += self._buttons(state)
                if state.t == before:
                    break
                before, state = state.t, self.device.read()
        except Exception as error:
            # The library raises types of the HID binding that it happens to use.
            raise DeviceGone(NAME, f"cannot be read: {error}", hint="plug it in again") from error
        x, y, z, a, b, c = (
            _beyond(float(value)) for value in (state.x, state.y, state.z, state.roll, state.pitch, state.yaw)
        )
        held = bool(self._was) and self._was[0]
        return HandState(held, (x, y, z, a, b, c), pressed=tuple(pressed))

    def _buttons(self, state: Any) -> list[JogButton]:
        down = tuple(bool(each) for each in state.buttons)
        went_down = len(down) > 1 and down[1] and not (len(self._was) > 1 and self._was[1])
        self._was = down
        return [JogButton.FRAME] if went_down else []

    def close(self) -> None:
        """Give it back."""
        self.device.close()


def _beyond(value: float) -> float:
    """Return a deflection without the dead zone, from -1 to 1; 0 for what is no number."""
    if not math.isfinite(value):
        return 0.0
    return math.copysign(min(max(abs(value) - _DEAD_ZONE, 0.0) / (1.0 - _DEAD_ZONE), 1.0), value)


def connect(opened: Callable[[], Any] | None = None) -> SpaceMouse:
    """Open the first one of this machine.

    Args:
        opened: opens it; None for ``pyspacemouse``.

    Raises:
        ConnectError: ``pyspacemouse`` is not installed, or there is no device that this user may read.
    """
    if opened is None:
        try:
            import pyspacemouse
        except ModuleNotFoundError:
            hint = "pip install 'touchcell[spacemouse]'"
            raise ConnectError(NAME, "needs pyspacemouse, which is not installed", hint=hint) from None
        except Exception as error:
            # Its HID binding looks for libhidapi while it is imported.
            raise ConnectError(
                NAME, f"pyspacemouse cannot be used: {error}", hint="install libhidapi-hidraw0"
            ) from None

        def opened() -> Any:
            return pyspacemouse.open(nonblocking=True, axis_convention=pyspacemouse.AxisConvention.ROS)

    try:
        device = opened()
    except Exception as error:
        hint = "plug one in; a udev rule has to let this user read its hidraw node"
        raise ConnectError(NAME, f"there is none: {error}", hint=hint) from error
    return SpaceMouse(device)


SPEC = HandDeviceSpec(NAME, "3Dconnexion SpaceMouse; its first button is the dead-man control", connect, "spacemouse")
