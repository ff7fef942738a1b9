"""Only a browser that has the token, and comes from the page itself, sees anything."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from touchcell.cell.ui.access import Access, Receive, Scope, Send

HOST = "127.0.0.1:8177"
TOKEN = "secret"
COOKIE = f"touchcell={TOKEN}"


class Server:
    """The middleware around an application that answers everything, and holds WebSockets until they are let go."""

    def __init__(self, most_clients: int = 8) -> None:
        self.access = Access(self._app, token=TOKEN, hosts=frozenset({HOST}), most_clients=most_clients)
        self.served = 0
        self.let_go = asyncio.Event()

    async def _app(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.served += 1
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            await self.let_go.wait()
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def ask(self, kind: str = "http", *, query: str = "", **headers: str) -> list[dict[str, Any]]:
        sent: list[dict[str, Any]] = []

        async def send(message: Any) -> None:
            sent.append(dict(message))

        async def receive() -> Any:
            return {"type": f"{kind}.request"}

        scope = {
            "type": kind,
            "path": "/run/x",
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in {"host": HOST, **headers}.items()],
        }
        await self.access(scope, receive, send)
        return sent


def status(**request: str) -> int:
    async def asked() -> int:
        return int((await Server().ask(**request))[0]["status"])

    return asyncio.run(asked())


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ({}, 401),
        ({"cookie": "touchcell=wrong"}, 401),
        ({"cookie": "touchcell=sécret"}, 401),
        ({"cookie": ";;=;"}, 401),
        ({"query": "token=wrong"}, 401),
        ({"cookie": COOKIE}, 200),
        ({"cookie": COOKIE, "host": "evil.example"}, 421),
        ({"cookie": COOKIE, "host": "evil.example:8177"}, 421),
        ({"query": f"token={TOKEN}", "host": "evil.example"}, 421),
        ({"cookie": COOKIE, "origin": "http://evil.example"}, 403),
        ({"cookie": COOKIE, "origin": f"https://{HOST}"}, 403),
        ({"cookie": COOKIE, "origin": "null"}, 403),
        ({"cookie": COOKIE, "origin": f"http://{HOST}"}, 200),
        ({"cookie": COOKIE, "query": "transport=polling"}, 403),
    ],
)
def test_a_request_is_served_or_refused(request_: dict[str, str], answer: int) -> None:
    if any(not value.isascii() for value in request_.values()):
        request_ = {name: value.encode().decode("latin-1") for name, value in request_.items()}
    assert status(**request_) == answer


def test_the_token_becomes_a_cookie_and_leaves_the_address() -> None:
    async def asked() -> dict[bytes, bytes]:
        return dict((await Server().ask(query=f"token={TOKEN}&t=3"))[0]["headers"])

    headers = asyncio.run(asked())
    assert headers[b"location"] == b"/run/x?t=3"
    assert headers[b"set-cookie"] == b"touchcell=secret; Path=/; HttpOnly; SameSite=Strict"


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": f"http://{HOST}"},
        {"cookie": COOKIE},
        {"cookie": COOKIE, "origin": "http://evil.example"},
        {"cookie": COOKIE, "origin": f"http://{HOST}", "host": "evil.example"},
    ],
)
def test_a_foreign_websocket_is_closed_before_it_is_accepted(headers: dict[str, str]) -> None:
    async def asked() -> list[dict[str, Any]]:
        return await Server().ask("websocket", **headers)

    assert [message["type"] for message in asyncio.run(asked())] == ["websocket.close"]


def test_clients_are_bounded_and_one_that_goes_makes_room() -> None:
    async def run() -> list[str]:
        server, own = Server(most_clients=2), {"cookie": COOKIE, "origin": f"http://{HOST}"}
        open_ = [asyncio.create_task(server.ask("websocket", **own)) for _ in range(2)]
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        third = await server.ask("websocket", **own)
        open_[0].cancel()
        await asyncio.gather(*open_[:1], return_exceptions=True)
        server.let_go.set()
        fourth = await server.ask("websocket", **own)
        await open_[1]
        return [third[0]["type"], fourth[0]["type"]]

    assert asyncio.run(run()) == ["websocket.close", "websocket.accept"]


@pytest.mark.parametrize("gone", [False, True])
def test_an_error_after_the_client_has_gone_is_none(gone: bool) -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        raise RuntimeError("no response returned")

    async def ask() -> None:
        async def receive() -> Any:
            return {"type": "http.disconnect" if gone else "http.request"}

        async def send(message: Any) -> None:
            raise AssertionError(message)

        scope = {"type": "http", "path": "/", "headers": [(b"host", HOST.encode()), (b"cookie", COOKIE.encode())]}
        await Access(app, token=TOKEN, hosts=frozenset({HOST}))(scope, receive, send)

    if gone:
        asyncio.run(ask())
    else:
        with pytest.raises(RuntimeError):
            asyncio.run(ask())
