"""Jog input from other processes: what they hold, how old it is, and that silence of any kind lets go."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from touchcell.cell.runtime import jog_channel, local_socket
from touchcell.cell.runtime.jog_channel import SOCKET, JogChannel, JogInputs, JogMessage, JogSender, parsed
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.jog import JogFrame, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped

MS = 1_000_000
RIGHT = JogRequest("arm", JogMode.FREE, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), JogFrame.TOOL, 0.5)


class Machine:
    """The machine's monotonic clock, on which clients stamp; the cell's own is 5 s ahead."""

    def __init__(self) -> None:
        self.ns = 1_000 * MS

    def now_ns(self) -> int:
        return self.ns

    @property
    def cell_ns(self) -> int:
        return self.ns + 5_000 * MS


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def stop() -> StopRequest:
    return StopRequest()


@pytest.fixture
def saved() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def channel(tmp_path: Path, machine: Machine, stop: StopRequest, saved: list[tuple[str, str]]) -> Iterator[JogChannel]:
    def save(arm: str, name: str) -> str:
        saved.append((arm, name))
        return f"saving {name}"

    with JogChannel(tmp_path, stop, save, machine.now_ns) as channel:
        yield channel


def only(channel: JogChannel, machine: Machine) -> Stamped[JogRequest] | None:
    held = list(channel.held(machine.cell_ns).values())
    return held[0] if held else None


def test_what_is_held_is_as_old_as_its_sender_knows_it(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns - 40 * MS, RIGHT, seq=3))
    held = only(channel, machine)
    assert held == Stamped(RIGHT, machine.cell_ns - 40 * MS, 3)
    machine.ns += 70 * MS
    held = only(channel, machine)
    assert held is not None
    assert machine.cell_ns - held.t_ns == 110 * MS
    sender.close()


def test_to_let_go_counts_in_the_next_cycle(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, RIGHT))
    assert only(channel, machine) is not None
    sender.send(JogMessage(machine.ns))
    assert only(channel, machine) is None
    sender.close()


def test_an_ended_connection_counts_as_letting_go(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, RIGHT))
    assert only(channel, machine) is not None
    sender.close()
    assert only(channel, machine) is None


@pytest.mark.parametrize(
    "packet",
    [
        b"nonsense",
        b"[]",
        b"{}",
        b'{"held_ns": "x"}',
        json.dumps({"held_ns": 10**18, "request": None}).encode(),
        json.dumps({"held_ns": 1, "request": {"arm": "arm", "mode": "free", "axes": [1, 2]}}).encode(),
        b'{"held_ns": 1, "request": {"arm": "arm", "mode": "free", "axes": [NaN, 0, 0, 0, 0, 0]}}',
        json.dumps({"held_ns": 1, "request": {"arm": "arm", "mode": "fly", "axes": [0] * 6}}).encode(),
        json.dumps({"held_ns": 1, "stop": "maybe"}).encode(),
        json.dumps({"held_ns": 1, "save": "x" * 400}).encode(),
    ],
)
def test_what_is_malformed_ends_its_connection_and_moves_nothing(
    channel: JogChannel, machine: Machine, tmp_path: Path, packet: bytes
) -> None:
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, RIGHT))
    sender._connection.send(packet)
    assert only(channel, machine) is None
    with pytest.raises(EOFError):
        sender.shown()
    sender.close()


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.binary(max_size=300))
def test_no_packet_raises_in_the_loop(channel: JogChannel, machine: Machine, tmp_path: Path, packet: bytes) -> None:
    sender = JogSender(tmp_path)
    if packet:
        sender._connection.send(packet)
    channel.held(machine.cell_ns)
    sender.close()
    assert only(channel, machine) is None


@settings(max_examples=100)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 6),
    st.sampled_from(JogMode),
    st.sampled_from(JogFrame),
    st.floats(0.0, 1.0),
    st.integers(0, 2**62),
)
def test_a_message_comes_out_as_it_went_in(
    axes: tuple[float, ...], mode: JogMode, frame: JogFrame, share: float, held_ns: int
) -> None:
    x, y, z, a, b, c = axes
    message = JogMessage(
        held_ns, JogRequest("left", mode, (x, y, z, a, b, c), frame, share, 0.001, 0.01), 7, "end", "p", "left"
    )
    assert parsed(message.encoded()) == message


def test_stop_and_save(
    channel: JogChannel, machine: Machine, stop: StopRequest, saved: list[tuple[str, str]], tmp_path: Path
) -> None:
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, save="start", save_arm="arm"))
    channel.held(machine.cell_ns)
    assert saved == [("arm", "start")]
    assert channel.message == "saving start"
    assert not stop.orderly
    sender.send(JogMessage(machine.ns, stop="end"))
    channel.held(machine.cell_ns)
    assert stop.orderly
    assert not stop.at_once
    sender.send(JogMessage(machine.ns, stop="at once"))
    channel.held(machine.cell_ns)
    assert stop.at_once
    sender.close()


def test_the_first_that_is_held_keeps_the_arm_until_it_lets_go(
    channel: JogChannel, machine: Machine, tmp_path: Path
) -> None:
    inputs = JogInputs(None, channel)
    first, second = JogSender(tmp_path), JogSender(tmp_path)
    left = JogRequest("arm", JogMode.FREE, (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    first.send(JogMessage(machine.ns, RIGHT, 1))
    one = inputs.request(machine.cell_ns)
    machine.ns += 10 * MS
    first.send(JogMessage(machine.ns, RIGHT, 1))
    second.send(JogMessage(machine.ns, left, 1))
    two = inputs.request(machine.cell_ns)
    first.send(JogMessage(machine.ns))
    three = inputs.request(machine.cell_ns)
    assert [each and each.value for each in (one, two, three)] == [RIGHT, RIGHT, left]
    assert one is not None
    assert two is not None
    assert three is not None
    assert one.seq == two.seq < three.seq
    first.close()
    second.close()


def test_an_input_that_hangs_loses_the_arm(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    inputs = JogInputs(None, channel)
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, RIGHT, 1))
    assert inputs.request(machine.cell_ns) is not None
    machine.ns += 400 * MS
    assert inputs.request(machine.cell_ns) is None
    sender.close()


def test_at_most_four_are_connected(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    senders = [JogSender(tmp_path) for _ in range(4)]
    channel.held(machine.cell_ns)
    more = JogSender(tmp_path)
    channel.held(machine.cell_ns)
    with pytest.raises(EOFError):
        more.shown()
    for sender in (*senders, more):
        sender.close()


def test_another_user_is_refused(
    channel: JogChannel, machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jog_channel, "peer_uid", lambda connection: id(connection))
    sender = JogSender(tmp_path)
    sender.send(JogMessage(machine.ns, RIGHT))
    assert only(channel, machine) is None
    sender.close()


def test_the_socket_is_this_users_alone_and_goes_with_the_run(
    tmp_path: Path, machine: Machine, stop: StopRequest
) -> None:
    with JogChannel(tmp_path, stop, lambda arm, name: "", machine.now_ns):
        assert (tmp_path / SOCKET).stat().st_mode & 0o777 == 0o600
    assert not (tmp_path / SOCKET).exists()
    with pytest.raises(OSError, match=r".*"):
        local_socket.connect(tmp_path, SOCKET, 0.1)


def test_what_is_shown_reaches_every_client(channel: JogChannel, machine: Machine, tmp_path: Path) -> None:
    sender = JogSender(tmp_path)
    channel.held(machine.cell_ns)
    assert sender.shown() is None
    channel.show({"state": "idle"})
    channel.show({"state": "moving"})
    assert sender.shown() == {"state": "moving"}
    for _ in range(2000):
        # A client that never reads costs nothing.
        channel.show({"state": "x" * 1000})
    sender.close()
