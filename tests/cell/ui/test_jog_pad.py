"""What a page holds is as old as the newest stamp that the server gave it, and is passed on to the run."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from touchcell.cell.runtime.jog_channel import JogChannel
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.ui.jog_relay import parsed_page_message
from touchcell.cell.ui.server import serve_page
from touchcell.drivers.core.jog import JogFrame, JogMode

pytest.importorskip("nicegui")
client = pytest.importorskip("websockets.sync.client")

# NiceGUI looks for its server among all objects of the process, and a deprecated one of PyTorch warns when looked at.
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")

MS = 1_000_000
NOW = 10_000 * MS
TOKEN = "secret"
HELD = {"arm": "arm", "mode": "free", "axes": [0, 1, 0, 0, 0, 0], "frame": "tool", "share": 0.2}


def page_says(stamp_ns: int | None, request: Any = HELD, **more: Any) -> str:
    return json.dumps({"stamp": None if stamp_ns is None else str(stamp_ns), "seq": 1, "request": request, **more})


def test_what_is_held_is_as_old_as_the_stamp_that_comes_back() -> None:
    message = parsed_page_message(page_says(NOW - 45 * MS), NOW)
    assert message.held_ns == NOW - 45 * MS
    assert message.request is not None
    assert (message.request.mode, message.request.frame) == (JogMode.FREE, JogFrame.TOOL)


@pytest.mark.parametrize("stamp_ns", [None, NOW + 1, NOW - 6_000 * MS, 0, -5])
def test_nothing_is_held_without_a_stamp_that_the_server_may_have_given(stamp_ns: int | None) -> None:
    assert parsed_page_message(page_says(stamp_ns), NOW).request is None


@pytest.mark.parametrize(
    "text", ["", "nonsense", "[]", "3", page_says(NOW, {"arm": "arm"}), page_says(NOW, "x"), " " * 5000]
)
def test_what_is_no_message_is_refused(text: str) -> None:
    with pytest.raises((ValueError, KeyError, TypeError, AttributeError)):
        parsed_page_message(text, NOW)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "first"
    folder.mkdir()
    (folder / "cell.yaml").touch()
    return folder


Connect = Callable[..., Any]


@pytest.fixture
def connect(tmp_path: Path) -> Iterator[Connect]:
    """Opens the WebSocket of a run's page: ``connect(name, cookie=..., origin=..., host=...)``."""
    done, ready = threading.Event(), threading.Event()
    addresses: list[str] = []

    def note(address: str) -> None:
        addresses.append(address.split("/")[2])
        ready.set()

    with ThreadPoolExecutor(1) as pool:
        serving = pool.submit(serve_page, tmp_path, 0, note, token=TOKEN, until=done.is_set, nice=0)
        ready.wait(60)
        [host] = addresses

        def connect(name: str, **changed: str) -> Any:
            headers = {"Cookie": changed.get("cookie", f"touchcell={TOKEN}")}
            headers |= {"Host": changed["host"]} if "host" in changed else {}
            origin = changed.get("origin", f"http://{host}")
            url = f"ws://{host}/jog/{name}"
            return client.connect(url, origin=origin, additional_headers=headers, open_timeout=30)

        try:
            yield connect
        finally:
            done.set()
            serving.result(30)


def stamp_of(page: Any) -> int:
    return int(json.loads(page.recv(timeout=30))["stamp"])


def held_after(channel: JogChannel, page: Any, text: str) -> list[Any]:
    page.send(text)
    stamp_of(page)
    return [each.value for each in channel.held(time.monotonic_ns()).values()]


def test_a_page_moves_a_run_and_letting_go_or_closing_it_ends_that(connect: Connect, folder: Path) -> None:
    with JogChannel(folder, StopRequest(), lambda arm, name: "") as channel:
        with connect("first") as page:
            page.send(page_says(None))
            stamp_ns = stamp_of(page)
            [request] = held_after(channel, page, page_says(stamp_ns))
            assert request.axes == (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
            assert held_after(channel, page, page_says(stamp_ns, None)) == []
            assert held_after(channel, page, page_says(stamp_ns)) != []
            # Another page is not served while this one is.
            with pytest.raises(Exception, match="HTTP 403"), connect("first"):
                pass
            assert held_after(channel, page, page_says(stamp_ns)) != []
            channel.show({"state": "moving"})
            assert json.loads(page.recv(timeout=30)) == {"shown": {"state": "moving"}}
        # A page that has gone holds nothing, and leaves room for the next.
        assert not let_go(channel)
        with connect("first") as page:
            page.send(page_says(None))
            assert stamp_of(page) >= stamp_ns


def let_go(channel: JogChannel) -> list[Any]:
    """What is held once the end of a connection has been passed on."""
    end_s = time.monotonic() + 30.0
    while (held := list(channel.held(time.monotonic_ns()).values())) and time.monotonic() < end_s:
        pass
    return held


@pytest.mark.parametrize(
    "changed",
    [{"cookie": ""}, {"cookie": "touchcell=other"}, {"origin": "http://evil.example"}, {"origin": "null"}],
)
def test_a_page_without_the_token_or_of_another_site_moves_nothing(
    connect: Connect, folder: Path, changed: dict[str, str]
) -> None:
    with JogChannel(folder, StopRequest(), lambda arm, name: "") as channel:
        with pytest.raises(Exception, match="HTTP 403"), connect("first", **changed):
            pass
        assert not channel.held(time.monotonic_ns())


@pytest.mark.parametrize("name", ["first", "nothing", "..", "%2e%2e"])
def test_a_run_that_takes_no_jog_input_is_not_served(connect: Connect, folder: Path, name: str) -> None:
    with pytest.raises(Exception, match=r"HTTP (403|404)"), connect(name):
        pass


@pytest.mark.parametrize("text", ["nonsense", page_says(1, {"arm": "arm", "mode": "fly", "axes": [0] * 6})])
def test_a_page_that_sends_what_is_no_message_is_closed(connect: Connect, folder: Path, text: str) -> None:
    with JogChannel(folder, StopRequest(), lambda arm, name: "") as channel, connect("first") as page:
        page.send(page_says(None))
        stamp_ns = stamp_of(page)
        assert held_after(channel, page, page_says(stamp_ns))
        page.send(text if text == "nonsense" else text.replace('"1"', f'"{stamp_ns}"'))
        with pytest.raises(Exception, match=r"1000|1005|1006"):
            page.recv(timeout=30)
        assert not let_go(channel)
