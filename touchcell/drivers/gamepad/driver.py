"""Gamepad by ``evdev`` (extra ``gamepad``), in the layout that Linux gives every pad (its input/gamepad.rst).

Right shoulder (BTN_TR) is the dead-man control. Left stick moves along x and y, the right stick up and down along z and
turns about z; with the left shoulder (BTN_TL) held, both sticks turn about x and y instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.jog import Axes, HandDeviceSpec, HandState, JogButton

NAME: Final = "gamepad"
_EV_KEY, _EV_ABS = 0x01, 0x03
_ABS_X, _ABS_Y, _ABS_Z, _ABS_RX, _ABS_RY, _ABS_RZ = range(6)
_BTN_SOUTH, _BTN_EAST, _BTN_NORTH, _BTN_WEST = 0x130, 0x131, 0x133, 0x134
_BTN_TL, _BTN_TR = 0x136, 0x137
_BTN_SELECT, _BTN_START, _BTN_MODE = 0x13A, 0x13B, 0x13C
_BUTTONS: Final[Mapping[int, JogButton]] = MappingProxyType(
    {
        _BTN_EAST: JogButton.STOP,
        _BTN_NORTH: JogButton.FRAME,
        _BTN_WEST: JogButton.UNTIL_TOUCH,
        _BTN_SELECT: JogButton.NEXT_ARM,
        _BTN_START: JogButton.STEPS,
    }
)
_HAT_UP_DOWN: Final = 0x11
_DEAD_ZONE: Final = 0.15
"""Share of a stick's way that a worn one may rest beside its middle."""


@dataclass(frozen=True, slots=True)
class _Range:
    """Of an absolute axis: its middle, and the way from there to either end."""

    middle: float
    half: float

    def share(self, value: float) -> float:
        """Return the deflection from -1 to 1; 0 in the dead zone, and continuous at its edge."""
        raw = (value - self.middle) / self.half
        beyond = min(max(abs(raw) - _DEAD_ZONE, 0.0) / (1.0 - _DEAD_ZONE), 1.0)
        return beyond if raw > 0.0 else -beyond


@dataclass
class Gamepad:
    """One pad; see ``touchcell.drivers.core.jog.HandDevice``.

    Args:
        device: an ``evdev.InputDevice``, opened without blocking.
    """

    device: Any
    _ranges: dict[int, _Range] = field(init=False)
    _axes: dict[int, float] = field(init=False)
    _down: set[int] = field(init=False)

    def __post_init__(self) -> None:
        infos = dict(self.device.capabilities().get(_EV_ABS, ()))
        self._ranges = {
            code: _Range(0.5 * (info.min + info.max), max(0.5 * (info.max - info.min), 1.0))
            for code, info in infos.items()
            if code in range(6)
        }
        # What is held while the pad is opened sends no event.
        self._axes = {code: self._ranges[code].share(infos[code].value) for code in self._ranges}
        self._down = set(self.device.active_keys())

    def read(self) -> HandState:
        """Return what is held now. Raises DeviceGone when the pad has been unplugged."""
        pressed: list[JogButton] = []
        try:
            while (event := self.device.read_one()) is not None:
                pressed += self._take(event)
        except OSError as error:
            raise DeviceGone(NAME, f"cannot be read: {error.strerror or error}", hint="plug it in again") from None
        return HandState(_BTN_TR in self._down, self._deflection(), _BTN_SOUTH in self._down, tuple(pressed))

    def _take(self, event: Any) -> Iterable[JogButton]:
        if event.type == _EV_ABS and event.code in self._ranges:
            self._axes[event.code] = self._ranges[event.code].share(event.value)
        elif event.type == _EV_ABS and event.code == _HAT_UP_DOWN and event.value:
            yield JogButton.MORE if event.value < 0 else JogButton.LESS
        elif event.type == _EV_KEY and event.value == 0:
            self._down.discard(event.code)
        elif event.type == _EV_KEY and event.value == 1:
            self._down.add(event.code)
            if event.code in _BUTTONS:
                yield _BUTTONS[event.code]

    def _deflection(self) -> Axes:
        # Away from the hand is negative in the kernel's convention, and along +x here; left is +y.
        right = (_ABS_RX, _ABS_RY) if _ABS_RX in self._ranges else (_ABS_Z, _ABS_RZ)
        forward, left = -self._axes.get(_ABS_Y, 0.0), -self._axes.get(_ABS_X, 0.0)
        up, turn = -self._axes.get(right[1], 0.0), -self._axes.get(right[0], 0.0)
        if _BTN_TL in self._down:
            # As if the left stick were the tool's handle: to push it away turns it about +y.
            return 0.0, 0.0, 0.0, -left, forward, turn
        return forward, left, up, 0.0, 0.0, turn

    def close(self) -> None:
        """Give the pad back."""
        self.device.close()


def connect(paths: Callable[[], Iterable[str]] | None = None, opened: Callable[[str], Any] | None = None) -> Gamepad:
    """Open the first pad of this machine.

    Args:
        paths: of input devices; None for those of this machine.
        opened: opens one; None for ``evdev``.

    Raises:
        ConnectError: ``evdev`` is not installed, or there is no pad that this user may read.
    """
    if paths is None or opened is None:
        try:
            import evdev
        except ModuleNotFoundError:
            raise ConnectError(
                NAME, "needs evdev, which is not installed", hint="pip install 'touchcell[gamepad]'"
            ) from None
        paths, opened = evdev.list_devices, evdev.InputDevice
    for path in sorted(paths()):
        try:
            device = opened(path)
        except OSError:
            continue
        if is_gamepad(device.capabilities()):
            return Gamepad(device)
        device.close()
    hint = "plug one in; this user has to be in the group `input` to read /dev/input"
    raise ConnectError(NAME, "there is none", hint=hint)


def is_gamepad(capabilities: Mapping[int, Any]) -> bool:
    """Whether an input device is a pad by the kernel's rule, BTN_SOUTH, and has a dead-man button and a stick."""
    keys = set(capabilities.get(_EV_KEY, ()))
    axes = {code for code, _ in capabilities.get(_EV_ABS, ())}
    return {_BTN_SOUTH, _BTN_TR} <= keys and {_ABS_X, _ABS_Y} <= axes


SPEC = HandDeviceSpec(NAME, "gamepad by evdev; right shoulder is the dead-man control", connect, "gamepad")
