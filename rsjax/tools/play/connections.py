"""Bounds what unfinished requests can take from the server: open connections, and seconds of waiting for a header."""

import asyncio
import resource

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_SECONDS = 10.0  # for which the header of a request may stay unfinished
EACH = 4  # connections per session: a page's socket, and what a browser loads side by side
SPARE = 64  # connections of pages without a session


def most_connections(sessions: int) -> int:
    """Returns the number of connections that a server with this many sessions keeps open at a time.

    It leaves half of the process's file descriptors to files and to JAX.
    """
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = EACH * sessions + SPARE
    if descriptors == resource.RLIM_INFINITY:
        return wanted
    return max(1, min(wanted, descriptors // 2))


def bounded(most: int, seconds: float = HEADER_SECONDS) -> type[H11Protocol]:
    """Returns uvicorn's HTTP protocol with both bounds.

    Args:
        most: open connections, sockets of pages included; further ones are closed at once.
        seconds: after its first byte, or after the connection began, the header of a request must be complete; or else
            the connection is closed.
    """

    class Bounded(H11Protocol):
        _timer: asyncio.TimerHandle | None = None
        _refused = False
        _upgraded = False

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            if len(self.connections) >= most:
                self._refused = True
                transport.abort()
                return
            super().connection_made(transport)
            self._timer = self.loop.call_later(seconds, self.transport.abort)

        def connection_lost(self, exc: Exception | None) -> None:
            self._rest()
            if not self._refused:
                super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self._refused:
                return
            super().data_received(data)
            answering = self.cycle is not None and not self.cycle.response_complete
            if answering or self._upgraded or self.transport.is_closing():
                self._rest()
            elif self._timer is None:
                self._timer = self.loop.call_later(seconds, self.transport.abort)

        def handle_websocket_upgrade(self, event: h11.Request) -> None:
            self._upgraded = True
            self._rest()
            super().handle_websocket_upgrade(event)

        def _rest(self) -> None:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

    return Bounded
