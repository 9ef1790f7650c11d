"""Bounds how many connections a server holds, so that idle ones cannot take all of the process's file descriptors."""

import struct
import time
from contextlib import suppress
from socket import SO_SNDTIMEO, SOL_SOCKET
from socket import socket as Socket
from typing import Any

PAUSE = 0.5  # seconds between two looks at a listener that was perhaps closed, or has no file descriptor to spare
SEND_SECONDS = 20


class BoundedListener(Socket):
    """A listening socket that closes connections beyond a number at once.

    Its ``accept`` raises only when the listener was closed, because websockets ends a server at any error of it.

    Args:
        listener: the socket that listens; this object takes it over.
        most: connections that are open at a time.
        send_seconds: seconds without progress after which the system gives up a send. An answer takes about three, and
            fails at the last. Without a limit, sending to a client that reads nothing would never end, and closing the
            connection would wait for it.
    """

    def __init__(self, listener: Socket, most: int, send_seconds: int = SEND_SECONDS) -> None:
        super().__init__(fileno=listener.detach())
        self.settimeout(PAUSE)
        self._most = most
        self._send_limit = struct.pack("ll", send_seconds, 0)  # seconds and microseconds
        self._accepted: list[Socket] = []

    def accept(self) -> tuple[Socket, Any]:
        """Returns the next connection that there is room for, and its address.

        Raises:
            OSError: the listener was closed.
        """
        while True:
            try:
                connection, address = super().accept()
            except TimeoutError:
                continue
            except OSError:
                if self.fileno() < 0:
                    raise
                time.sleep(PAUSE)  # no file descriptor is free: clients that leave, or time out, free theirs
                continue
            self._accepted = [each for each in self._accepted if each.fileno() >= 0]
            if len(self._accepted) < self._most:
                with suppress(OSError):  # the client may have left already
                    connection.setsockopt(SOL_SOCKET, SO_SNDTIMEO, self._send_limit)
                self._accepted.append(connection)
                return connection, address
            connection.close()
