"""Who may see the operator's page: a browser on this machine that has its token, from the page's own address.

The page listens on the loopback interface only. Other users of the machine, and pages of other sites in the operator's
own browser, can reach that too: the token keeps out the first, Host and Origin the second (DNS rebinding, cross-site
requests and WebSockets).
"""

from __future__ import annotations

import hmac
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final, TypeAlias
from urllib.parse import parse_qs, urlencode

Scope: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

TOKEN: Final = "token"
COOKIE: Final = "touchcell"
MOST_CLIENTS: Final = 16
"""WebSockets that are open at the same time; a page has one, and one more where it moves an arm."""
_LONGEST: Final = 256
_logger = logging.getLogger(__name__)


class Access:
    """ASGI middleware that refuses every request but those of the page's own clients.

    Args:
        app: what is protected.
        token: secret of this server; in the address once, then in a cookie.
        hosts: values of the Host header that are this server, as "127.0.0.1:8177".
        most_clients: WebSockets that may be open at the same time.
    """

    def __init__(self, app: App, *, token: str, hosts: frozenset[str], most_clients: int = MOST_CLIENTS) -> None:
        self._app = app
        self._token = token
        self._hosts = hosts
        self._most_clients = most_clients
        self._clients = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, refuse, or exchange the token for a cookie."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        given = query.pop(TOKEN, [""])[0]
        if headers.get("host", "") not in self._hosts:
            await _refuse(scope, send, 421, "this is not the host that the address names")
        elif not self._is_own(headers, scope["type"]):
            await _refuse(scope, send, 403, "the request comes from another site")
        elif scope["type"] == "http" and self._is_token(given):
            await self._exchange(scope, send, query)
        elif not self._is_token(_cookie(headers.get("cookie", ""))):
            await _refuse(scope, send, 401, "open the address that `touchcell ui` has printed: it has the token")
        elif scope["type"] == "websocket":
            await self._count(scope, receive, send)
        elif query.get("transport") == ["polling"]:
            await _refuse(scope, send, 403, "only WebSockets are served")
        else:
            await self._serve(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on; what is raised after the client has gone is nothing to report."""
        gone = False

        async def noted() -> MutableMapping[str, Any]:
            nonlocal gone
            message = await receive()
            gone = gone or message["type"] in ("http.disconnect", "websocket.disconnect")
            return message

        try:
            await self._app(scope, noted, send)
        except Exception:
            if not gone:
                raise
            _logger.debug("a client went away", exc_info=True)

    def _is_own(self, headers: MutableMapping[str, str], kind: str) -> bool:
        origin = headers.get("origin")
        if origin is None:
            # Browsers name it with every WebSocket and every request that changes anything.
            return kind == "http"
        scheme, _, host = origin.partition("://")
        return scheme == "http" and host in self._hosts

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text[:_LONGEST].encode(), self._token.encode())

    async def _exchange(self, scope: Scope, send: Send, query: MutableMapping[str, list[str]]) -> None:
        """Set the cookie and show the address without the token, so that neither history nor a referrer keeps it."""
        rest = urlencode(query, doseq=True)
        place = scope.get("path", "/") + (f"?{rest}" if rest else "")
        cookie = f"{COOKIE}={self._token}; Path=/; HttpOnly; SameSite=Strict"
        headers = [(b"location", place.encode("latin-1")), (b"set-cookie", cookie.encode("latin-1"))]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})

    async def _count(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._clients >= self._most_clients:
            await _refuse(scope, send, 503, "too many pages are open")
            return
        self._clients += 1
        try:
            await self._serve(scope, receive, send)
        finally:
            self._clients -= 1


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


async def _refuse(scope: Scope, send: Send, status: int, reason: str) -> None:
    if scope["type"] == "websocket":
        # Before it is accepted, this ends the handshake with status 403.
        await send({"type": "websocket.close", "code": 1008})
        return
    body = f"{reason}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
