"""``touchcell view``: a run's contacts in a browser while it goes on, or played again from its recording.

It follows the recording from a process of its own and touches nothing of the run.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from touchcell.cell.analysis.contact_images import ContactPicture, contact_pictures
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import RECORDING, follow
from touchcell.cell.runtime.operator_input import await_end
from touchcell.drivers.core.clock import Clock, MonotonicClock
from touchcell.geometry.types import ImageArray

_ADDRESS: Final = "127.0.0.1"
_DRAWN_EVERY_NS: Final = 100_000_000
_LOOK_AGAIN_NS: Final = 50_000_000
_PAGE: Final = b"""<!doctype html><title>touchcell view</title>
<style>body{margin:0;background:#222;color:#ccc;font:14px sans-serif}img{display:block;max-width:100%}</style>
<img id=picture src=picture.jpg><p>left: markers, displaced since the first image; right: red where they crowd</p>
<script>setInterval(()=>{picture.src='picture.jpg?'+Date.now()},100)</script>"""


class Page:
    """A page on this machine that shows the newest picture; a context manager.

    Args:
        port: 0 for any that is free.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, port: int) -> None:
        self._newest = b""
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                picture = self.path.startswith("/picture.jpg")
                content = page._newest if picture else _PAGE
                self.send_response(200 if content else 404)
                self.send_header("Content-Type", "image/jpeg" if picture else "text/html")
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *arguments: object) -> None:
                """A line for every picture would tell nobody anything."""

        self._server = ThreadingHTTPServer((_ADDRESS, port), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)

    @property
    def url(self) -> str:
        """Where it is."""
        return f"http://{_ADDRESS}:{self._server.server_address[1]}/"

    def show(self, picture: ImageArray) -> None:
        """Make ``picture``, uint8 BGR, the newest."""
        self._newest = cv2.imencode(".jpg", picture)[1].tobytes()

    def __enter__(self) -> Page:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def view_run(folder: Path, port: int) -> None:
    """Show the run until it has ended and its recording has been played, or until Ctrl-C.

    Raises:
        RecordingError: the folder holds no recording, or one without images; or the port is taken.
    """
    try:
        page = Page(port)
    except OSError as error:
        reason = f"cannot be shown on port {port}: {error.strerror}"
        raise RecordingError(folder, reason, hint="choose another --port") from None
    with page:
        print(f"{page.url} shows {folder}; Ctrl-C ends", flush=True)
        pictures = play(folder, page.show, MonotonicClock())
    if not pictures:
        hint = "set `recording: {frames: jpeg}` in the cell file"
        raise RecordingError(folder / RECORDING, "holds no images", hint=hint)
    print(f"the recording has ended: {pictures} images")


def play(folder: Path, show: Callable[[ImageArray], None], clock: Clock) -> int:
    """Show what the sensors of a run see, no faster than it was recorded; returns the number of images.

    A run that still goes on is caught up with as fast as its images can be read, and then followed to its end.

    Raises:
        RecordingError: there is no recording.
    """
    started_ns = clock.now_ns()
    first_ns: int | None = None
    drawn_ns = started_ns - _DRAWN_EVERY_NS
    rows: dict[str, ImageArray] = {}
    pictures = 0
    last: ContactPicture | None = None
    over = False

    def wait() -> bool:
        nonlocal over
        if over:
            return False
        # What the run wrote before it ended is still to be read.
        over = await_end(folder, 0.0)
        clock.sleep_until_ns(clock.now_ns() + _LOOK_AGAIN_NS)
        return True

    for picture in contact_pictures(follow(folder / RECORDING, wait)):
        pictures += 1
        first_ns = picture.t_ns if first_ns is None else first_ns
        clock.sleep_until_ns(started_ns + picture.t_ns - first_ns)
        last = picture
        # More pictures than anybody sees would only take time from the run.
        if clock.now_ns() - drawn_ns >= _DRAWN_EVERY_NS:
            drawn_ns = clock.now_ns()
            rows[picture.role] = picture.drawn()
            show(_stacked(rows))
    if last is not None:
        rows[last.role] = last.drawn()
        show(_stacked(rows))
    return pictures


def _stacked(rows: dict[str, ImageArray]) -> ImageArray:
    """One row for each sensor, as wide as the widest."""
    width = max(row.shape[1] for row in rows.values())
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for _, row in sorted(rows.items())])
