"""``python -m benchmarks.jog_operator KIND RUN TIMES SEED ADDRESS``: an operator of ``benchmarks jog``, with times.

Each line of its output is what happened, and when on CLOCK_MONOTONIC: ``press`` or ``let go``. A process that reads an
input device is killed from outside while it holds; a page is closed from here.
"""

from __future__ import annotations

import json
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from http.cookiejar import CookieJar
from pathlib import Path
from random import Random
from typing import Any, Final

from touchcell.cell.runtime.hand_device import read_device
from touchcell.cell.runtime.jog_channel import JogSender
from touchcell.drivers.core.jog import AT_REST, Axes, HandState

HELD_S: Final = 0.35
_IDLE_S: Final = 0.45
_PERIOD_S: Final = 0.03
"""Of the page's messages, as in ``jog_pad.js``."""


def note(what: str) -> None:
    """Print what happens now."""
    print(what, time.monotonic_ns(), flush=True)


def _axes(up: bool) -> Axes:
    return (0.0, 0.0, 1.0 if up else -1.0, 0.0, 0.0, 0.0)


class FakeDevice:
    """An input device whose dead-man control is pressed and let go at random times.

    Args:
        times: how often.
        seed: of the times.
        ends_held: it is held for good at last.
    """

    def __init__(self, times: int, seed: int, *, ends_held: bool = False) -> None:
        random = Random(seed)
        at_s, self._changes = time.monotonic() + 0.6, list[tuple[float, bool]]()
        for _ in range(times):
            at_s += _IDLE_S + random.random() * 0.1
            self._changes.append((at_s, True))
            at_s += HELD_S
            if not ends_held:
                self._changes.append((at_s, False))
        self._held = self._up = False

    @property
    def ended(self) -> bool:
        """Whether it has nothing more to do."""
        return not self._changes and not self._held

    def read(self) -> HandState:
        if self._changes and time.monotonic() >= self._changes[0][0]:
            _, self._held = self._changes.pop(0)
            self._up ^= self._held
            note("press" if self._held else "let go")
        return HandState(self._held, _axes(self._up) if self._held else AT_REST)

    def close(self) -> None:
        pass


def hold_device(run: Path, times: int, seed: int, *, to_be_killed: bool) -> None:
    """Move the arm from a device's process, as ``touchcell jog --input`` does."""
    device = FakeDevice(times, seed, ends_held=to_be_killed)
    read_device(device, JogSender(run), ["arm"], lambda: not device.ended)


def hold_page(run: str, address: str, times: int, seed: int, *, closes: bool) -> None:
    """Move the arm from a page's WebSocket."""
    from websockets import Origin
    from websockets.sync.client import connect

    jar, random, up = CookieJar(), Random(seed), False
    urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar)).open(address, timeout=60).read()
    host = address.split("/")[2]
    cookie = "; ".join(f"{each.name}={each.value}" for each in jar)

    def opened(stack: ExitStack) -> Any:
        url = f"ws://{host}/jog/{run}"
        return stack.enter_context(
            connect(url, origin=Origin(f"http://{host}"), additional_headers={"Cookie": cookie}, open_timeout=60)
        )

    with ExitStack() as stack:
        page = opened(stack)
        said = _conversation(page)
        for seq in range(times):
            up = not up
            for _ in _ticks(_IDLE_S + 0.1 * random.random()):
                said(seq, None)
            note("press")
            request = {"arm": "arm", "mode": "free", "axes": _axes(up), "frame": "base", "share": 0.2}
            for _ in _ticks(HELD_S):
                said(seq, request)
            note("let go")
            if closes:
                page.socket.close()
                time.sleep(_IDLE_S)
                page = opened(stack)
                said = _conversation(page)
            else:
                said(seq, None)


def _ticks(duration_s: float) -> Iterator[None]:
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        yield
        time.sleep(_PERIOD_S)


def _conversation(page: Any) -> Any:
    """Return what sends one message, with the newest stamp, and reads what has come."""
    stamp: list[str | None] = [None]

    def said(seq: int, request: dict[str, Any] | None) -> None:
        page.send(json.dumps({"stamp": stamp[0], "seq": seq, "request": request}))
        try:
            while True:
                answer = json.loads(page.recv(timeout=0 if stamp[0] else 5.0))
                stamp[0] = answer.get("stamp", stamp[0])
        except TimeoutError:
            pass

    return said


if __name__ == "__main__":
    kind, folder, count, seed = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    if kind in ("device", "killed"):
        hold_device(folder, count, seed, to_be_killed=kind == "killed")
    else:
        hold_page(folder.name, sys.argv[5], count, seed, closes=kind == "closed")
