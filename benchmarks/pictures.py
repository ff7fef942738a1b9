"""Takes the screenshots of the documents anew, in headless Chromium: the operator's page, and Rerun's web viewer.

    python -m benchmarks pictures [--only NAME ...] [--into docs/pictures]

Needs Chromium and the extras ``ui``, ``rerun`` and ``dev``. Each picture is to be looked at before it is kept.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, Final

import yaml

from touchcell.cell.config.find import find_cell
from touchcell.paths import CHECKOUT

_DEADLINE_S: Final = 180.0
_PHONE: Final = {"width": 390, "height": 844}
_DESK: Final = {"width": 1280, "height": 900}
_WINDOW: Final = {"width": 1100, "height": 720}
_TALL: Final = {"width": 1280, "height": 1500}
_SLIDES_IN_S: Final = 3.0
_RERUN_SETTLES_S: Final = 100.0
"""Software draws Rerun's viewer here, and decodes the images meanwhile."""


def run(arguments: Sequence[str], out: Path) -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser("python -m benchmarks pictures", description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=sorted(_PICTURES), default=sorted(_PICTURES), metavar="NAME")
    parser.add_argument("--into", type=Path, default=CHECKOUT / "docs" / "pictures", help="default: %(default)s")
    options = parser.parse_args(arguments)
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        drawing = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=chromium, args=drawing)
        for name in options.only:
            place = Path(folder) / name
            place.mkdir()
            _PICTURES[name](browser, place, options.into.absolute() / f"{name}.png")
            print(options.into / f"{name}.png", flush=True)
        browser.close()


def _ui_run(browser: Any, folder: Path, picture: Path) -> None:
    _touchcell(
        folder, "run", "dual_push_sim.yaml", "--quiet", "--out", "runs/dual_push", "--set", "recording.frames=jpeg"
    )
    with _served(folder, "ui", "--port", "0") as address:
        page = _page(browser, address.replace("/?", "/run/dual_push?"), _TALL)
        slider = page.locator(".q-slider").first
        # Read to its end: the slider is there, and at the end.
        page.wait_for_function("/\\d s · done/.test(document.querySelector('.q-badge')?.innerText)")
        time.sleep(_SLIDES_IN_S)
        slider.click(position={"x": 0.75 * slider.bounding_box()["width"], "y": 10})
        page.wait_for_function("document.querySelector('.q-badge').innerText.startsWith('run')")
        page.locator("svg .present").first.wait_for(state="attached")
        page.locator("img").first.wait_for()
        _take(page, picture)


def _ui_phone(browser: Any, folder: Path, picture: Path) -> None:
    changes = {"on_trip": "wait_for_reset", "sensors": {"sensor": {"dropped": 0.8}}}
    cell = _cell(folder, "surface_follow_sim.yaml", time="real", rate_hz=25, **changes)
    with _served(folder, "run", str(cell), "--quiet", "--ui", "--out", "runs/surface_follow") as address:
        page = _page(browser, address, _PHONE)
        page.get_by_text("first cause", exact=False).first.wait_for()
        _take(page, picture)


def _ui_jog(browser: Any, folder: Path, picture: Path) -> None:
    with _served(
        folder, "jog", "surface_follow_sim.yaml", "--ui", "--out", "runs/jog", "--set", "recording.frames=jpeg"
    ) as address:
        page = _page(browser, address, _DESK)
        page.wait_for_function("document.querySelector('.text-mono')?.innerText.startsWith('idle')")
        page.locator("canvas").first.wait_for()
        page.locator("img").first.wait_for()
        box = page.locator("[data-jog='x+']").bounding_box()
        page.mouse.move(box["x"] + 8, box["y"] + 8)
        page.mouse.down()
        page.wait_for_function("/^(?!idle).* x -7/.test(document.querySelector('.text-mono')?.innerText)")
        _take(page, picture, settles_s=0.0)


def _rerun(browser: Any, folder: Path, picture: Path) -> None:
    _touchcell(folder, "run", "dual_push_sim.yaml", "--quiet", "--out", "dual_push", "--set", "recording.frames=jpeg")
    import rerun_cli

    _touchcell(folder, "open", "dual_push", "--rerun", "--to", "run.rrd")
    port = _free_port()
    # As a plain file: the viewer's own proxy takes a core of its own for minutes.
    with _files_served(folder) as files:
        command = [str(Path(rerun_cli.__file__).with_name("rerun")), f"{files}/run.rrd", "--serve-web"]
        command += ["--web-viewer-port", str(port), "--port", str(_free_port())]
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, env=os.environ | {"BROWSER": "true"}, **quiet) as viewer:
            try:
                _until(lambda: _listens(port))
                page = _page(browser, f"http://127.0.0.1:{port}/?url={files}/run.rrd&renderer=webgl", _WINDOW)
                page.locator("canvas").first.wait_for()
                _take(page, picture, settles_s=_RERUN_SETTLES_S)
            finally:
                viewer.terminate()


_PICTURES: Final[dict[str, Callable[[Any, Path, Path], None]]] = {
    "ui_run": _ui_run,
    "ui_phone": _ui_phone,
    "ui_jog": _ui_jog,
    "rerun": _rerun,
}


def _cell(folder: Path, name: str, **changes: Any) -> Path:
    data = yaml.safe_load(find_cell(Path(name)).read_text())
    for key, value in changes.items():
        if isinstance(value, dict):
            for inner, more in value.items():
                data[key][inner] |= more
        else:
            data[key] = value
    for interlock, limit_ms in (("stale_frame", 600), ("stale_arm", 600)):
        data["interlocks"][interlock]["limit_ms"] = limit_ms
    data["task"] |= {"max_state_age_ms": 800, "max_frame_age_ms": 800}
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def _touchcell(folder: Path, *arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "touchcell", *arguments], cwd=folder, check=True, capture_output=True, timeout=900
    )


@contextmanager
def _served(folder: Path, *arguments: str) -> Iterator[str]:
    """Run a command that serves the page; yields its address."""
    log = folder / "log.txt"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "touchcell", *arguments],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
    try:
        _until(lambda: "token=" in log.read_text() or process.poll() is not None)
        address = re.search(r"http://\S+", log.read_text())
        if address is None:
            raise RuntimeError(log.read_text())
        yield address[0]
    finally:
        # What it would still write and draw is thrown away.
        process.kill()
        process.wait()


@contextmanager
def _files_served(folder: Path) -> Iterator[str]:
    """Serve the files of a folder to pages of any origin; yields its address."""

    class Handler(SimpleHTTPRequestHandler):
        def end_headers(self) -> None:
            self.send_header("Access-Control-Allow-Origin", "*")
            super().end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def _page(browser: Any, address: str, size: dict[str, int]) -> Any:
    page = browser.new_page(viewport=size)
    page.set_default_timeout(1e3 * _DEADLINE_S)
    page.goto(address, wait_until="domcontentloaded")
    return page


def _take(page: Any, picture: Path, *, settles_s: float = 15.0) -> None:
    time.sleep(settles_s)
    page.screenshot(path=str(picture))
    page.close()


def _until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + _DEADLINE_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError("nothing answers")
        time.sleep(0.1)


def _listens(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
