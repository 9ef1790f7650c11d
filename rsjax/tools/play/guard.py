"""Decides which requests are allowed: by the addresses that a browser may use, and by the token."""

import ipaddress
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass

from starlette.datastructures import Headers
from starlette.types import ASGIApp as App
from starlette.types import Message, Receive, Scope, Send

# The value of a Host header: a name or an address, in brackets if it is one of IPv6, and a port.
_HOST = re.compile(r"(\[[^\[\]]+\]|[^\[\]:]+)(?::[0-9]{1,5})?")
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
    """Returns whether a host's name or address can only mean this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(re.sub(r"^\[(.*)\]$", r"\1", host)).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Guard:
    """Decides which requests are allowed.

    Attributes:
        token: the secret that a page must know; "" for a server that only this machine can reach.
    """

    token: str

    def wrong_host(self, headers: Headers) -> str:
        """Returns why a request's Host is refused, or "".

        Without a token, the Host must be a name of this machine. This stops DNS rebinding: a page of another site whose
        name was made to point to this machine sends that name as the Host.
        """
        host = headers.get("host", "")
        name = ""
        if match := _HOST.fullmatch(host):
            name = match[1]
        if not self.token and not is_loopback(name):
            return f"this server answers to localhost only, not to {host!r:.80}"
        return ""

    def wrong_origin(self, headers: Headers) -> str:
        """Returns why a socket's Origin is refused, or ""; programs that are not browsers send none."""
        origin = headers.get("origin")
        host = headers.get("host", "").lower()
        if origin is None or origin.lower() in (f"http://{host}", f"https://{host}"):
            return ""
        return f"pages of {origin!r:.80} cannot connect"

    def knows(self, query: Mapping[str, str]) -> bool:
        """Returns whether a request contains the token."""
        token = query.get("token", "")
        return not self.token or secrets.compare_digest(token.encode(), self.token.encode())


class Guarded:
    """Refuses requests for other hosts, and adds headers to every response."""

    def __init__(self, app: App, guard: Guard) -> None:
        self._app = app
        self._guard = guard

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
