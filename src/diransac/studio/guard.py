"""`Guard`: what every request must pass before the application sees it, and the headers of every answer."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from starlette.exceptions import HTTPException

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_LARGEST_BODY, _TOO_LARGE = 1 << 20, "the body is too large"
_HEADERS = {
    # Nothing from elsewhere, no script within a page.
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Application behind a token that begins every path.

    A request without the token, of another host (a name that an attacker rebinds to this machine) or of a page from
    elsewhere is refused with 403, a large body with 413.

    Parameters
    ----------
    app : ASGI application
        It sees the path without the token.
    token : str
    hosts : iterable of str
        Names of this server, with the port.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: Iterable[str]) -> None:
        self._app, self._token, self._hosts = app, token, frozenset(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal:
            await _refuse(scope, receive, send, *refusal)
            return
        inner = {**scope, "path": scope["path"][len(self._token) + 1 :], "raw_path": None, "root_path": ""}

        async def answer(message: Message) -> None:
            await send(_with_headers(message))

        await self._app(inner, _limited(receive), answer)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and reason for which a request is refused; None where it passes."""
        headers: dict[bytes, list[bytes]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name, []).append(value)
        if scope["type"] != "http":
            return 403, "there is nothing but HTTP here"
        if [x.decode("latin-1") for x in headers.get(b"host", [])] not in [[host] for host in self._hosts]:
            return 403, "this is the server of another name"
        origins = {x.decode("latin-1") for x in headers.get(b"origin", [])}
        site = set(headers.get(b"sec-fetch-site", []))
        # The address itself may be typed or clicked anywhere; what it loads is of this page alone.
        is_visit = headers.get(b"sec-fetch-mode") == [b"navigate"] and scope["method"] == "GET"
        if not origins <= {f"http://{host}" for host in self._hosts}:
            return 403, "the request is that of another page"
        if not site <= {b"same-origin", b"none"} and not is_visit:
            return 403, "the request is that of another page"
        given, slash, _ = scope["path"][1:].partition("/")
        if not slash or not secrets.compare_digest(given.encode(), self._token.encode()):
            return 403, "the address lacks its token: open the one that diransac studio has printed"
        lengths = headers.get(b"content-length", [b"0"])
        if not lengths[0].isdigit() or int(lengths[0][:12]) > _LARGEST_BODY:
            return 413, _TOO_LARGE
        return None


def _limited(receive: Receive) -> Receive:
    """The body of a request, up to its largest size."""
    size = 0

    async def within() -> Message:
        nonlocal size
        message = await receive()
        size += len(message.get("body", b""))
        if size > _LARGEST_BODY:
            raise HTTPException(413, _TOO_LARGE)
        return message

    return within


def _with_headers(message: Message) -> Message:
    if message["type"] != "http.response.start":
        return message
    own = {name for name, _ in message.get("headers", ())}
    added = [(n.encode(), x.encode()) for n, x in _HEADERS.items() if n.encode() not in own]
    return {**message, "headers": [*message.get("headers", ()), *added]}


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    """Answer with a sentence, or close what is no request."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    headers: list[Any] = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    await send(_with_headers({"type": "http.response.start", "status": status, "headers": headers}))
    await send({"type": "http.response.body", "body": f"{why}\n".encode()})
