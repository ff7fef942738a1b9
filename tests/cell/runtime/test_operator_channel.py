"""Requests from other shells: by a socket that only this user may open, and nothing that comes in harms the run."""

from __future__ import annotations

import getpass
import json
import shutil
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from touchcell.cell.runtime import operator_channel
from touchcell.cell.runtime.operator_channel import (
    MAX_BYTES,
    SOCKET,
    OperatorChannel,
    OperatorRequest,
    Request,
    ask_run,
    is_waiting,
    operator_name,
)

DEADLINE_S = 60.0


@pytest.fixture
def channel(tmp_path: Path) -> Iterator[OperatorChannel]:
    channel = OperatorChannel(tmp_path)
    channel.open()
    yield channel
    channel.close()


def connected(folder: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.settimeout(DEADLINE_S)
    client.connect(str(folder / SOCKET))
    return client


def asked(folder: Path, channel: OperatorChannel, ask: OperatorRequest, done: bool, reply: str) -> tuple[bool, str]:
    """Ask from another thread, as another shell would, and answer from this one."""
    answers: list[tuple[bool, str]] = []
    other = threading.Thread(target=lambda: answers.append(ask_run(folder, ask, "bob", DEADLINE_S)))
    other.start()
    taken: Request | None = None
    while taken is None:
        taken = channel.take()
    assert (taken.ask, taken.operator) == (ask, "bob")
    channel.answer(taken, done, reply)
    other.join()
    return answers[0]


@pytest.mark.parametrize("ask", OperatorRequest)
@pytest.mark.parametrize("done", [False, True])
def test_a_request_is_taken_and_answered(
    tmp_path: Path, channel: OperatorChannel, ask: OperatorRequest, done: bool
) -> None:
    assert asked(tmp_path, channel, ask, done, "as it is") == (done, "as it is")
    assert channel.last_reply == "as it is"


def test_the_socket_is_there_while_the_run_waits_and_only_for_its_user(tmp_path: Path) -> None:
    channel = OperatorChannel(tmp_path)
    assert not is_waiting(tmp_path)
    channel.open()
    assert is_waiting(tmp_path)
    mode = (tmp_path / SOCKET).stat().st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600
    channel.close()
    assert not is_waiting(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "message",
    [
        b"\x00",
        b"\xff\xfe",
        b"{",
        b"[]",
        b"3",
        b"null",
        b'"reset"',
        b"{}",
        b'{"ask": "reset"}',
        b'{"ask": "move", "operator": "eve"}',
        b'{"ask": ["reset"], "operator": "eve"}',
        b'{"ask": Infinity, "operator": "eve"}',
        b'{"ask": "reset", "operator": 7}',
        b'{"ask": "reset", "operator": ""}',
        b'{"ask": "reset", "operator": "a\\nb"}',
        b'{"ask": "reset", "operator": "%s"}' % (b"x" * 65),
        b"[" * MAX_BYTES,
        b'{"ask": "reset", "operator": "eve"}' + b" " * MAX_BYTES,
    ],
)
def test_what_is_malformed_is_dropped_and_the_next_request_is_taken(
    tmp_path: Path, channel: OperatorChannel, message: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with connected(tmp_path) as client:
        client.send(message)
        assert channel.take() is None
        assert client.recv(MAX_BYTES) == b""
    assert "dropped" in caplog.text
    assert asked(tmp_path, channel, OperatorRequest.RESET, True, "reset") == (True, "reset")


def test_clients_that_say_nothing_block_nobody(tmp_path: Path, channel: OperatorChannel) -> None:
    clients = []
    for _ in range(30):
        clients.append(connected(tmp_path))
        assert channel.take() is None
    assert asked(tmp_path, channel, OperatorRequest.RESUME, True, "resumed") == (True, "resumed")
    for client in clients:
        client.close()
    assert channel.take() is None


def test_a_request_whose_sender_has_gone_is_not_done(tmp_path: Path, channel: OperatorChannel) -> None:
    with connected(tmp_path) as client:
        client.send(json.dumps({"ask": "reset", "operator": "bob"}).encode())
    assert channel.take() is None


def test_a_sender_that_goes_before_its_answer_harms_nothing(tmp_path: Path, channel: OperatorChannel) -> None:
    with connected(tmp_path) as client:
        client.send(json.dumps({"ask": "reset", "operator": "bob"}).encode())
        request = channel.take()
    assert request is not None
    channel.answer(request, True, "reset")


def test_another_user_is_refused(
    tmp_path: Path, channel: OperatorChannel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(operator_channel, "peer_uid", lambda connection: 12345)
    with connected(tmp_path) as client:
        client.send(json.dumps({"ask": "reset", "operator": "eve"}).encode())
        assert channel.take() is None
        with pytest.raises(OSError, match="reset"):
            client.recv(MAX_BYTES)
    assert "12345" in caplog.text


def test_a_socket_left_by_a_crash_is_no_waiting_run_and_is_replaced(tmp_path: Path) -> None:
    left = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    left.bind(str(tmp_path / SOCKET))
    left.close()
    assert not is_waiting(tmp_path)
    channel = OperatorChannel(tmp_path)
    channel.open()
    assert asked(tmp_path, channel, OperatorRequest.RESET, True, "reset") == (True, "reset")
    channel.close()


def test_a_link_in_the_place_of_the_socket_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_text("kept")
    target.chmod(0o644)
    (tmp_path / SOCKET).symlink_to(target)
    channel = OperatorChannel(tmp_path)
    channel.open()
    assert is_waiting(tmp_path)
    channel.close()
    assert target.read_text() == "kept"
    assert stat.S_IMODE(target.stat().st_mode) == 0o644


def test_a_run_folder_may_have_any_length(tmp_path: Path) -> None:
    folder = tmp_path / ("a" * 100) / ("b" * 100)
    folder.mkdir(parents=True)
    channel = OperatorChannel(folder)
    channel.open()
    assert asked(folder, channel, OperatorRequest.RESET, True, "reset") == (True, "reset")
    channel.close()


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_folder_that_vanishes_harms_nothing(tmp_path: Path, when: str) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    channel = OperatorChannel(folder)
    if when == "before":
        shutil.rmtree(folder)
    channel.open()
    if when == "after":
        shutil.rmtree(folder)
    assert channel.take() is None
    channel.ask(OperatorRequest.RESET, "ada")
    assert channel.take() == Request(OperatorRequest.RESET, "ada")
    assert not is_waiting(folder)
    assert ask_run(folder, OperatorRequest.RESET, "bob", 1.0)[0] is False
    channel.close()


@pytest.mark.parametrize("error", [KeyError("getpwuid(): uid not found"), OSError("No username set"), ImportError()])
def test_a_user_without_a_name_has_a_number(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def nameless() -> str:
        raise error

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert operator_name().startswith("uid ")


def test_requests_made_before_it_opens_do_not_count(tmp_path: Path) -> None:
    channel = OperatorChannel(tmp_path)
    channel.ask(OperatorRequest.RESET, "ada")
    channel.open()
    assert channel.take() is None
    channel.close()
