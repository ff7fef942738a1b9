"""What an operator holds on a page, passed on from its WebSocket to the run."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from touchcell.cell.runtime.jog_channel import SOCKET, JogMessage, JogSender, parsed_request

_CONNECT_S: Final = 2.0
_LONGEST: Final = 2048
_OLDEST_NS: Final = 5_000_000_000


def takes_jog(folder: Path) -> bool:
    """Whether the run in ``folder`` may be moved from a page."""
    return (folder / SOCKET).exists()


class JogRelay:
    """Passes on what pages hold; at most one page moves a run at a time."""

    def __init__(self) -> None:
        self._busy: set[Path] = set()

    async def serve(self, socket: Any, folder: Path | None) -> None:
        """Serve one WebSocket until its page, or the run, has gone.

        Every message of the page has the newest stamp that it was given, and counts as being as old as that, so that
        one that was under way for long is an old one.

        Args:
            socket: a Starlette WebSocket that has not been accepted.
            folder: the run folder; None for a run that there is not.
        """
        sender = None
        if folder is not None and folder not in self._busy and takes_jog(folder):
            with suppress(OSError):
                sender = JogSender(folder, _CONNECT_S)
        if sender is None or folder is None:
            await socket.close(1013)
            return
        self._busy.add(folder)
        try:
            await socket.accept()
            await _relay(socket, sender)
        finally:
            self._busy.discard(folder)
            sender.close()


async def _relay(socket: Any, sender: JogSender) -> None:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    sending: set[asyncio.Task[None]] = set()

    def show() -> None:
        try:
            status = sender.shown()
        except EOFError:
            ended.set()
            loop.remove_reader(sender.fileno())
            return
        # A page that does not read is not waited for.
        if status is not None and not sending:
            task = loop.create_task(_send(socket, {"shown": status}))
            sending.add(task)
            task.add_done_callback(sending.discard)

    loop.add_reader(sender.fileno(), show)
    receiving = loop.create_task(_receive(socket, sender))
    ending = loop.create_task(ended.wait())
    try:
        await asyncio.wait((receiving, ending), return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (receiving, ending, *sending):
            task.cancel()
        await asyncio.gather(receiving, ending, *sending, return_exceptions=True)
        loop.remove_reader(sender.fileno())
        with suppress(Exception):
            # It may have gone already.
            await socket.close()


async def _receive(socket: Any, sender: JogSender) -> None:
    """Pass on messages until the page goes, or sends what is none."""
    while True:
        event = await socket.receive()
        if event["type"] != "websocket.receive":
            return
        now_ns = time.monotonic_ns()
        try:
            message = parsed_page_message(event.get("text") or "", now_ns)
        except (ValueError, KeyError, TypeError, RecursionError, AttributeError):
            return
        if not sender.send(message):
            return
        await _send(socket, {"stamp": str(now_ns)})


async def _send(socket: Any, data: dict[str, Any]) -> None:
    # A page that has gone ends the receiving side.
    with suppress(RuntimeError, OSError):
        await socket.send_text(json.dumps(data))


def parsed_page_message(text: str, now_ns: int) -> JogMessage:
    """Return the message for the run that a page's message asks for.

    Args:
        text: JSON, see ``jog_pad.js``.
        now_ns: when it arrived.

    Raises:
        ValueError, KeyError, TypeError, RecursionError, AttributeError: it is none.
    """
    if len(text) > _LONGEST:
        raise ValueError("it is too long")
    data = json.loads(text)
    stop, save = str(data.get("stop", "")), str(data.get("save", ""))
    message = JogMessage(now_ns, None, int(data.get("seq", 0)), stop, save, str(data.get("save_arm", "")))
    if data.get("request") is None or data.get("stamp") is None:
        # Nothing moves before the page has had a first stamp.
        return message
    stamp_ns = int(data["stamp"])
    if not now_ns - _OLDEST_NS <= stamp_ns <= now_ns:
        return message
    return replace(message, held_ns=stamp_ns, request=parsed_request(data["request"]))
