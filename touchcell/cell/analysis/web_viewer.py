"""``touchcell view``: a run's contacts in a browser, live or replayed from its recording.

It follows the recording from its own process and does not affect the run.
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
    """A local web page that shows the newest image; a context manager.

    Args:
        port: 0 for any that is free.

    Raises:
        OSError: the port is in use.
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
                """Suppress the log line per image."""

        self._server = ThreadingHTTPServer((_ADDRESS, port), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)

    @property
    def url(self) -> str:
        """Address of the page."""
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
        RecordingError: the folder holds no recording, or one without images; or the port is in use.
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
    """Show the images of a run's sensors, no faster than they were recorded; return the number of images.

    For a live run its past images are shown as fast as they can be read, then the run is followed to its end.

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
        # The remaining messages are still to be read after the run has ended.
        over = await_end(folder, 0.0)
        clock.sleep_until_ns(clock.now_ns() + _LOOK_AGAIN_NS)
        return True

    for picture in contact_pictures(follow(folder / RECORDING, wait)):
        pictures += 1
        first_ns = picture.t_ns if first_ns is None else first_ns
        clock.sleep_until_ns(started_ns + picture.t_ns - first_ns)
        last = picture
        # A higher image rate than is visible would only take time from the run.
        if clock.now_ns() - drawn_ns >= _DRAWN_EVERY_NS:
            drawn_ns = clock.now_ns()
            rows[picture.role] = picture.drawn()
            show(_stacked(rows))
    if last is not None:
        rows[last.role] = last.drawn()
        show(_stacked(rows))
    return pictures


def _stacked(rows: dict[str, ImageArray]) -> ImageArray:
    """Stack one row per sensor, as wide as the widest."""
    width = max(row.shape[1] for row in rows.values())
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for _, row in sorted(rows.items())])
