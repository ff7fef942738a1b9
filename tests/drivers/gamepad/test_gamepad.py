"""A gamepad at the boundary of ``evdev``: events in, deflections out, and its dead-man button."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.jog import HAND_DEVICES, HandDevice, JogButton
from touchcell.drivers.gamepad.driver import Gamepad, connect, is_gamepad

KEY, ABS = 1, 3
X, Y, RX, RY, HAT = 0x00, 0x01, 0x03, 0x04, 0x11
SOUTH, EAST, NORTH, TL, TR, SELECT = 0x130, 0x131, 0x133, 0x136, 0x137, 0x13A


def info(value: int = 0, low: int = -32768, high: int = 32767) -> Any:
    return SimpleNamespace(value=value, min=low, max=high, fuzz=16, flat=128, resolution=0)


class FakePad:
    """What ``evdev.InputDevice`` is to the driver. Events are those that the kernel's documentation gives a pad."""

    def __init__(
        self, keys: tuple[int, ...] = (SOUTH, EAST, NORTH, TL, TR, SELECT), held: tuple[int, ...] = ()
    ) -> None:
        self.events: deque[Any] = deque()
        self.unplugged = False
        self.closed = False
        self._keys = keys
        self._held = held

    def capabilities(self) -> dict[int, Any]:
        return {0: [0, 1, 3], KEY: list(self._keys), ABS: [(code, info()) for code in (X, Y, RX, RY, HAT)]}

    def active_keys(self) -> list[int]:
        return list(self._held)

    def read_one(self) -> Any:
        if self.unplugged:
            raise OSError(19, "No such device")
        return self.events.popleft() if self.events else None

    def send(self, kind: int, code: int, value: int) -> None:
        self.events.append(SimpleNamespace(type=kind, code=code, value=value, sec=0, usec=0))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def fake() -> FakePad:
    return FakePad()


@pytest.fixture
def pad(fake: FakePad) -> Gamepad:
    return Gamepad(fake)


def test_the_shoulder_is_the_dead_man_control(fake: FakePad, pad: Gamepad) -> None:
    assert isinstance(pad, HandDevice)
    fake.send(ABS, Y, -32768)
    assert not pad.read().held
    fake.send(KEY, TR, 1)
    assert pad.read().held
    fake.send(KEY, TR, 2)
    assert pad.read().held
    fake.send(KEY, TR, 0)
    assert not pad.read().held


def test_sticks_move_along_x_y_and_z_and_turn_about_z(fake: FakePad, pad: Gamepad) -> None:
    fake.send(ABS, Y, -32768)
    assert pad.read().axes == pytest.approx((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-3)
    fake.send(ABS, Y, 0)
    fake.send(ABS, X, 32767)
    assert pad.read().axes == pytest.approx((0.0, -1.0, 0.0, 0.0, 0.0, 0.0), abs=1e-3)
    fake.send(ABS, X, 0)
    fake.send(ABS, RY, -32768)
    fake.send(ABS, RX, -32768)
    assert pad.read().axes == pytest.approx((0.0, 0.0, 1.0, 0.0, 0.0, 1.0), abs=1e-3)


def test_with_the_left_shoulder_the_left_stick_turns(fake: FakePad, pad: Gamepad) -> None:
    fake.send(KEY, TL, 1)
    fake.send(ABS, Y, -32768)
    assert pad.read().axes == pytest.approx((0.0, 0.0, 0.0, 0.0, 1.0, 0.0), abs=1e-3)


@pytest.mark.parametrize("value", [4000, -4000, 0])
def test_a_stick_that_rests_beside_its_middle_moves_nothing(fake: FakePad, pad: Gamepad, value: int) -> None:
    fake.send(ABS, X, value)
    assert pad.read().axes == (0.0,) * 6


def test_buttons_are_reported_once(fake: FakePad, pad: Gamepad) -> None:
    fake.send(KEY, EAST, 1)
    fake.send(KEY, NORTH, 1)
    fake.send(ABS, HAT, -1)
    assert pad.read().pressed == (JogButton.STOP, JogButton.FRAME, JogButton.MORE)
    assert pad.read().pressed == ()
    fake.send(KEY, SOUTH, 1)
    assert pad.read().retract


def test_what_is_held_while_it_is_opened_is_known() -> None:
    assert Gamepad(FakePad(held=(TR,))).read().held


def test_an_unplugged_pad_is_a_gone_device(fake: FakePad, pad: Gamepad) -> None:
    fake.send(KEY, TR, 1)
    assert pad.read().held
    fake.unplugged = True
    with pytest.raises(DeviceGone, match="No such device"):
        pad.read()


def test_the_first_pad_is_taken_and_other_devices_are_left() -> None:
    keyboard, pad = FakePad(keys=(30, 31)), FakePad()
    devices = {"/dev/input/event0": keyboard, "/dev/input/event1": pad}

    def opened(path: str) -> FakePad:
        if path.endswith("9"):
            raise PermissionError(13, "Permission denied")
        return devices[path]

    found = connect(lambda: ["/dev/input/event9", *devices], opened)
    assert found.device is pad
    assert keyboard.closed
    found.close()
    assert pad.closed


def test_without_a_pad_it_says_what_to_do() -> None:
    with pytest.raises(ConnectError, match="there is none") as caught:
        connect(lambda: [], lambda path: FakePad())
    assert "input" in caught.value.hint


def test_a_pad_needs_its_dead_man_button() -> None:
    assert is_gamepad(FakePad().capabilities())
    assert not is_gamepad(FakePad(keys=(SOUTH,)).capabilities())


def test_it_is_found_by_its_entry_point() -> None:
    assert HAND_DEVICES.load("gamepad").extra == "gamepad"


def test_codes_are_those_of_evdev() -> None:
    evdev = pytest.importorskip("evdev")
    codes = evdev.ecodes
    assert (SOUTH, EAST, NORTH) == (codes.BTN_SOUTH, codes.BTN_EAST, codes.BTN_NORTH)
    assert (TL, TR, SELECT) == (codes.BTN_TL, codes.BTN_TR, codes.BTN_SELECT)
    assert (X, Y, RX, RY, HAT) == (codes.ABS_X, codes.ABS_Y, codes.ABS_RX, codes.ABS_RY, codes.ABS_HAT0Y)
    names = {"capabilities", "active_keys", "read_one", "close"}
    assert names <= set(dir(evdev.InputDevice))
    assert {"value", "min", "max"} <= set(evdev.AbsInfo._fields)
