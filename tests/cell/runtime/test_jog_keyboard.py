"""Keys of a terminal become requests, and silence or a lost terminal becomes none."""

from __future__ import annotations

import math

import pytest

from touchcell.cell.runtime.jog_keyboard import JogKeyboard
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.jog import Axes, JogFrame, JogMode

MS = 1_000_000


class Operator:
    """A keyboard whose keys the test presses."""

    def __init__(self, *arms: str) -> None:
        self.pending: bytes | None = b""
        self.stop = StopRequest()
        self.saved: list[tuple[str, str]] = []
        self.keyboard = JogKeyboard(self._read, arms or ("arm",), self.stop, save=self._save)
        self.now_ns = 0

    def _read(self) -> bytes | None:
        keys, self.pending = self.pending, b"" if self.pending is not None else None
        return keys

    def _save(self, arm: str, name: str) -> str:
        self.saved.append((arm, name))
        return f"saved {name}"

    def press(self, keys: bytes):
        self.pending = keys
        return self.later(10)

    def later(self, ms: int):
        self.now_ns += ms * MS
        return self.keyboard.request(self.now_ns)


@pytest.mark.parametrize(
    ("key", "axes"),
    [
        (b"u", (1, 0, 0, 0, 0, 0)),
        (b"j", (-1, 0, 0, 0, 0, 0)),
        (b"\x1b[A", (0, 1, 0, 0, 0, 0)),
        (b"\x1b[6~", (0, 0, -1, 0, 0, 0)),
        (b"L", (0, 0, 0, 0, 0, -1)),
    ],
)
def test_a_key_moves_along_or_about_an_axis(key: bytes, axes: Axes) -> None:
    operator = Operator()
    request = operator.press(key)
    assert request.value.axes == axes
    assert request.t_ns == operator.now_ns
    assert operator.stop.count == 0


def test_a_key_that_is_no_longer_repeated_keeps_its_old_stamp() -> None:
    operator = Operator()
    pressed_ns = operator.press(b"u").t_ns
    assert operator.later(500).t_ns == pressed_ns


def test_a_step_is_held_until_it_must_be_done_and_not_for_longer() -> None:
    operator = Operator()
    operator.press(b"m")
    step = operator.press(b"u")
    assert step.value.mode is JogMode.STEP
    assert (step.value.step_m, step.value.step_rad) == pytest.approx((0.001, math.radians(1.0)))
    later = operator.later(900)
    assert (later.t_ns, later.seq) == (operator.now_ns, step.seq)
    ended_ns = operator.now_ns
    assert operator.later(5000).t_ns == ended_ns
    assert operator.press(b"u").seq > step.seq


def test_every_other_key_lets_go() -> None:
    operator = Operator()
    operator.press(b"u")
    assert operator.press(b"f") is None
    assert operator.keyboard.settings.frame is JogFrame.TOOL


@pytest.mark.parametrize(("keys", "count"), [(b" ", 2), (b"\x1b", 2), (b"\x1b[15~", 2), (b"q", 1), (None, 2)])
def test_stops(keys: bytes | None, count: int) -> None:
    operator = Operator()
    operator.press(b"u")
    assert operator.press(keys) is None or keys in (b" ", b"\x1b", b"\x1b[15~")
    assert operator.stop.count == count


def test_a_terminal_that_has_gone_asks_for_nothing_ever_again() -> None:
    operator = Operator()
    operator.press(b"m")
    operator.press(b"u")
    assert operator.press(None) is None
    assert operator.later(10) is None


def test_a_name_is_typed_and_no_letter_of_it_moves_anything() -> None:
    operator = Operator("leader", "follower")
    operator.press(b"\t")
    assert operator.press(b"sqjoz") is None
    assert operator.keyboard.prompt == "save as: qjoz_"
    assert operator.press(b"x\x7f_2\r") is None
    assert operator.saved == [("follower", "qjoz_2")]
    assert operator.stop.count == 0
    operator.press(b"sab\x1b")
    assert operator.saved == [("follower", "qjoz_2")]
    assert operator.stop.count == 0


def test_until_touch_back_off_and_speed() -> None:
    operator = Operator()
    operator.press(b"t")
    assert operator.press(b"l").value.mode is JogMode.UNTIL_TOUCH
    assert operator.press(b"b").value.mode is JogMode.RETRACT
    before = operator.press(b"u").value.share
    operator.press(b"+")
    assert operator.press(b"u").value.share > before
    operator.press(b"------")
    assert 0.0 < operator.press(b"u").value.share < before
