"""``touchcell ui``: serves the operator's page to browsers on this machine."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.ui.access import TOKEN, Access, App
from touchcell.cell.ui.runs import Runs
from touchcell.errors import ConfigError

HOST: Final = "127.0.0.1"
NICE: Final = 10
"""A page never competes with the run that it shows."""
_BACKLOG: Final = 64
_WATCH_S: Final = 0.5
_EXTRA: Final = "pip install 'touchcell[ui]'"


def serve_page(
    root: Path,
    port: int,
    ready: Callable[[str], None],
    *,
    run: str | None = None,
    token: str | None = None,
    until: Callable[[], bool] | None = None,
    nice: int = NICE,
) -> None:
    """Serve the page until the process is interrupted.

    Args:
        root: where runs leave their folders.
        port: TCP port on the loopback interface; 0 for any that is free.
        ready: called with the address to open, which has the token.
        run: name of the run that the address shows; None for the list.
        token: secret of this server; None makes one.
        until: asked twice a second; the page ends when it returns True.
        nice: added to this process's niceness.

    Raises:
        ConfigError: NiceGUI is not installed, or the port is taken.
    """
    try:
        import uvicorn
    except ModuleNotFoundError:
        raise ConfigError("needs nicegui, which is not installed", key="touchcell ui", hint=_EXTRA) from None
    runs = Runs(root.absolute(), Path.cwd())
    token = secrets.token_urlsafe(24) if token is None else token
    with _listening(port) as listener:
        port = listener.getsockname()[1]
        hosts = frozenset({f"{HOST}:{port}", f"localhost:{port}"})
        app = Access(page_app(runs), token=token, hosts=hosts)
        config = uvicorn.Config(app, log_level="warning", access_log=False, ws="auto", timeout_graceful_shutdown=1)
        _quiet_about_clients()
        path = "/" if run is None else f"/run/{run}"
        ready(f"http://{HOST}:{port}{path}?{TOKEN}={token}")
        os.nice(nice)
        try:
            asyncio.run(_serve(uvicorn.Server(config), listener, until))
        except KeyboardInterrupt:
            pass
        finally:
            runs.close()


async def _serve(server: Any, listener: socket.socket, until: Callable[[], bool] | None) -> None:
    async def watch() -> None:
        while until is not None and not until():
            await asyncio.sleep(_WATCH_S)
        server.should_exit = until is not None

    watching = asyncio.create_task(watch())
    await server.serve(sockets=[listener])
    watching.cancel()


def page_app(runs: Runs) -> App:
    """Return the page as an ASGI application, without protection. Raises ConfigError if NiceGUI is not installed."""
    try:
        from fastapi import FastAPI, Response, WebSocket
        from nicegui import ui
    except ModuleNotFoundError:
        raise ConfigError("needs nicegui, which is not installed", key="touchcell ui", hint=_EXTRA) from None
    from touchcell.cell.ui.jog_relay import JogRelay
    from touchcell.cell.ui.page import build_list, build_run
    from touchcell.cell.ui.stl import stl
    from touchcell.geometry.solids import triangulated

    app = FastAPI(openapi_url=None)
    relay = JogRelay()

    async def jog(socket: WebSocket, name: str) -> None:
        await relay.serve(socket, runs.folder(name))

    def part(name: str, number: int) -> Response:
        view = runs.view(name)
        if view is None or view.scene is None or not 0 <= number < len(view.scene.parts):
            return Response(status_code=404)
        return Response(stl(triangulated(view.scene.parts[number].solid, around=24)), media_type="model/stl")

    def index() -> None:
        build_list(runs)

    def run(name: str, source: str = RECORDING) -> None:
        build_run(runs, name, source)

    # FastAPI reads the type of a parameter from its annotation, which is local here.
    jog.__annotations__["socket"] = WebSocket
    app.add_api_websocket_route("/jog/{name}", jog)
    app.add_api_route("/part/{name}/{number}.stl", part)
    ui.page("/", title="touchcell")(index)
    ui.page("/run/{name}", title="touchcell")(run)
    ui.page("/run/{name}/{source}", title="touchcell")(run)
    # A browser that draws without a GPU answers late; held buttons have a connection with a deadline of its own.
    ui.run_with(app, show_welcome_message=False, reconnect_timeout=10.0)
    found: App = app
    return found


def _listening(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        # A browser that follows the address at once is answered a little later, not refused.
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise ConfigError(
            f"cannot serve a page: {error.strerror}", key="--port", value=port, hint="--port 0 takes a free one"
        ) from None
    return listener


def _quiet_about_clients() -> None:
    """A browser that goes away, or a client that speaks nonsense, is no event that an operator has to read of."""
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    for name in ("engineio.server", "socketio.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
