"""Who may come in: the addresses that a browser may use, and the token."""

import ipaddress
import secrets
from dataclasses import dataclass

from starlette.datastructures import Headers, QueryParams
from starlette.types import ASGIApp as App
from starlette.types import Message, Receive, Scope, Send

HEADERS = {
    "content-security-policy": (
        "default-src 'self'; img-src 'self' blob: data:; media-src 'self' blob:; style-src 'self'; script-src 'self'; "
        "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
}


def is_loopback(host: str) -> bool:
    """Returns whether a host's name or address is this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Guard:
    """Says who may come in.

    Attributes:
        token: what a page must know; "" for a server that only this machine reaches.
    """

    token: str

    def wrong_host(self, headers: Headers) -> str:
        """Returns why a request's Host is refused, "" if it is not.

        Without a token, it must be a name of this machine: a page of another site, whose name was made to point here,
        sends its own.
        """
        host = headers.get("host", "")
        if not self.token and not is_loopback(_name(host)):
            return f"this server answers to localhost only, not to {host!r:.80}"
        return ""

    def wrong_origin(self, headers: Headers) -> str:
        """Returns why a socket's Origin is refused, "" if it is not; programs that are no browsers send none."""
        origin, host = headers.get("origin"), headers.get("host", "").lower()
        if origin is None or origin.lower() in (f"http://{host}", f"https://{host}"):
            return ""
        return f"pages of {origin!r:.80} cannot connect"

    def knows(self, query: QueryParams) -> bool:
        """Returns whether a request has the token."""
        given = query.get("token", "")
        return not self.token or secrets.compare_digest(given.encode(), self.token.encode())


class Guarded:
    """Refuses requests to other hosts, and adds headers to every answer."""

    def __init__(self, app: App, guard: Guard) -> None:
        self._app, self._guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def headed(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *own]}
            await send(message)

        if wrong := self._guard.wrong_host(Headers(scope=scope)):
            from starlette.responses import JSONResponse

            await JSONResponse({"error": "host", "message": wrong}, 403)(scope, receive, headed)
            return
        await self._app(scope, receive, headed)


def _name(host: str) -> str:
    """Returns a Host header without its port."""
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0]
