"""A SpaceMouse at the boundary of ``pyspacemouse``."""

from __future__ import annotations

import inspect
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.jog import HAND_DEVICES, HandDevice, JogButton
from touchcell.drivers.spacemouse.driver import SpaceMouse, connect


def state(t: float, buttons: tuple[int, ...] = (0, 0), **axes: float) -> Any:
    return SimpleNamespace(
        t=t, buttons=list(buttons), **{name: axes.get(name, 0.0) for name in ("x", "y", "z", "roll", "pitch", "yaw")}
    )


class FakeMouse:
    """What ``pyspacemouse.SpaceMouseDevice`` is to the driver: the newest state, again where nothing has come."""

    def __init__(self) -> None:
        self.reports: deque[Any] = deque()
        self.newest = state(-1.0)
        self.unplugged = False

    def read(self) -> Any:
        if self.unplugged:
            raise RuntimeError("device disconnected")
        if self.reports:
            self.newest = self.reports.popleft()
        return self.newest

    def close(self) -> None:
        pass


def test_its_first_button_is_the_dead_man_control() -> None:
    fake = FakeMouse()
    mouse = SpaceMouse(fake)
    assert isinstance(mouse, HandDevice)
    fake.reports.append(state(1.0, x=1.0))
    assert not mouse.read().held
    fake.reports.append(state(2.0, (1, 0), x=1.0))
    assert mouse.read().held
    fake.reports.append(state(3.0, (0, 0), x=1.0))
    assert not mouse.read().held


def test_all_reports_that_have_come_are_read() -> None:
    fake = FakeMouse()
    mouse = SpaceMouse(fake)
    fake.reports += [state(k, (1, 0), z=0.05 * k) for k in range(1, 11)]
    fake.reports.append(state(11.0, (1, 0), yaw=-1.0))
    found = mouse.read()
    assert found.held
    assert found.axes == pytest.approx((0.0, 0.0, 0.0, 0.0, 0.0, -1.0))


def test_a_cap_at_rest_moves_nothing_and_no_number_is_none() -> None:
    fake = FakeMouse()
    fake.reports.append(state(1.0, (1, 0), x=0.05, y=float("nan"), z=3.0))
    assert SpaceMouse(fake).read().axes == (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def test_the_second_button_changes_the_frame_once() -> None:
    fake = FakeMouse()
    mouse = SpaceMouse(fake)
    fake.reports.append(state(1.0, (0, 1)))
    assert mouse.read().pressed == (JogButton.FRAME,)
    fake.reports.append(state(2.0, (0, 1), x=0.5))
    assert mouse.read().pressed == ()


def test_an_unplugged_one_is_a_gone_device() -> None:
    fake = FakeMouse()
    fake.unplugged = True
    with pytest.raises(DeviceGone, match="disconnected"):
        SpaceMouse(fake).read()


def test_without_one_it_says_what_to_do() -> None:
    def none() -> Any:
        raise RuntimeError("No supported devices found")

    with pytest.raises(ConnectError, match="No supported devices") as caught:
        connect(none)
    assert "udev" in caught.value.hint


def test_it_is_found_by_its_entry_point() -> None:
    assert HAND_DEVICES.load("spacemouse").extra == "spacemouse"


def test_the_library_has_what_is_called() -> None:
    pyspacemouse = pytest.importorskip("pyspacemouse", exc_type=Exception)
    assert {"nonblocking", "axis_convention"} <= set(inspect.signature(pyspacemouse.open).parameters)
    assert pyspacemouse.AxisConvention.ROS
    assert {"x", "y", "z", "roll", "pitch", "yaw", "t", "buttons"} <= set(dir(pyspacemouse.SpaceMouseState()))
