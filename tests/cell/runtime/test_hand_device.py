"""What an input device holds becomes jog messages, in which nothing moves without its dead-man control."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.cell.runtime.hand_device import HandPilot, devices_read, read_device
from touchcell.cell.runtime.jog_channel import JogChannel, JogSender
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.errors import DeviceGone
from touchcell.drivers.core.jog import Axes, HandState, JogButton, JogFrame, JogMode
from touchcell.errors import ConfigError

RIGHT: Axes = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 6),
    st.booleans(),
    st.lists(st.sampled_from(list(JogButton))),
    st.lists(st.sampled_from(list(JogButton))),
)
def test_nothing_moves_without_the_dead_man_control(
    axes: tuple[float, ...], retract: bool, before: list[JogButton], pressed: list[JogButton]
) -> None:
    x, y, z, a, b, c = axes
    pilot = HandPilot(["left", "right"])
    pilot.message(HandState(True, RIGHT, pressed=tuple(before)), 1)
    assert pilot.message(HandState(False, (x, y, z, a, b, c), retract, tuple(pressed)), 2).request is None


def test_a_deflection_is_passed_on_with_its_time_and_a_new_number_for_each_hold() -> None:
    pilot = HandPilot(["arm"])
    first = pilot.message(HandState(True, RIGHT), 10)
    again = pilot.message(HandState(True, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)), 20)
    pilot.message(HandState(True), 30)
    anew = pilot.message(HandState(True, RIGHT), 40)
    assert (first.held_ns, again.held_ns) == (10, 20)
    assert first.request is not None
    assert first.request.axes == RIGHT
    assert again.request is not None
    assert again.request.axes[0] == 0.5
    assert first.seq == again.seq < anew.seq


def test_buttons_change_what_the_next_deflection_does() -> None:
    pilot = HandPilot(["left", "right"])
    for button in (JogButton.FRAME, JogButton.NEXT_ARM, JogButton.UNTIL_TOUCH, JogButton.MORE):
        assert pilot.message(HandState(True, RIGHT, pressed=(button,)), 1).request is None
    request = pilot.message(HandState(True, RIGHT), 2).request
    assert request is not None
    assert (request.arm, request.frame, request.mode, request.share) == (
        "right",
        JogFrame.TOOL,
        JogMode.UNTIL_TOUCH,
        0.5,
    )


def test_a_stick_makes_one_step_for_each_time_that_it_is_pushed() -> None:
    pilot = HandPilot(["arm"])
    pilot.message(HandState(False, pressed=(JogButton.STEPS,)), 0)
    pushed = [pilot.message(HandState(True, (0.1, -x, 0.0, 0.0, 0.0, 0.0)), 1) for x in (0.4, 0.7, 1.0, 0.5)]
    assert [message.request and message.request.axes[1] for message in pushed] == [None, -1.0, -1.0, -1.0]
    assert pushed[1].seq == pushed[3].seq
    back = pilot.message(HandState(True, (0.0, -0.1, 0.0, 0.0, 0.0, 0.0)), 2)
    assert back.request is None
    assert pilot.message(HandState(True, (0.0, -0.9, 0.0, 0.0, 0.0, 0.0)), 3).seq > pushed[1].seq


def test_withdrawal_and_stop() -> None:
    pilot = HandPilot(["arm"])
    asked = pilot.message(HandState(True, RIGHT, retract=True), 0).request
    assert asked is not None
    assert asked.mode is JogMode.RETRACT
    assert pilot.message(HandState(False, pressed=(JogButton.STOP,)), 1).stop == "at once"


class Scripted:
    """A device that reports each of its states once, and is then unplugged."""

    def __init__(self, states: list[HandState]) -> None:
        self._states: Iterator[HandState] = iter(states)

    def read(self) -> HandState:
        try:
            return next(self._states)
        except StopIteration:
            raise DeviceGone("fake", "cannot be read") from None

    def close(self) -> None:
        pass


def test_a_device_is_read_until_it_is_unplugged_and_then_nothing_is_held(tmp_path: Path) -> None:
    now = [10**18]
    with JogChannel(tmp_path, StopRequest(), lambda arm, name: "", lambda: now[0]) as channel:
        sender = JogSender(tmp_path)
        with pytest.raises(DeviceGone):
            read_device(Scripted([HandState(True, RIGHT)] * 3), sender, ["arm"], lambda: True)
        [held] = channel.held(now[0]).values()
        assert held.value.axes == RIGHT
        sender.close()
        assert not channel.held(now[0])


def test_a_name_that_is_none_is_refused_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="gamepda") as caught, devices_read(["gamepda"], tmp_path, ["arm"]):
        pass
    assert "gamepad" in caught.value.hint
