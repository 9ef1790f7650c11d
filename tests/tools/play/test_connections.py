"""Unfinished requests: they end after a while, and cannot keep others out for longer."""

import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import uvicorn
from starlette.types import Receive, Scope, Send

from rsjax.tools.play.connections import bounded, most_connections
from tests.waiting import wait_until

SECONDS = 0.4
HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: "
WHOLE = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"


async def hello(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})


@contextmanager
def serving(most: int) -> Iterator[int]:
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(hello, log_level="critical", http=bounded(most, SECONDS), lifespan="off")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_until(lambda: server.started)
    try:
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()


def connected(port: int, payload: bytes) -> socket.socket:
    link = socket.create_connection(("127.0.0.1", port), timeout=20)
    link.sendall(payload)
    return link


def answer(link: socket.socket) -> bytes:
    """Returns what comes next; b"" if the server has ended the connection."""
    with suppress(ConnectionError):
        return link.recv(4096)
    return b""


def test_unfinished_headers_end_and_do_not_keep_others_out() -> None:
    with serving(most=4) as port:
        slow = [connected(port, HALF) for _ in range(12)]
        wait_until(lambda: answer(connected(port, WHOLE)).startswith(b"HTTP/1.1 200"))
        assert [answer(link) for link in slow] == [b""] * len(slow)


def test_bytes_one_by_one_and_a_second_request_are_headers_too() -> None:
    with serving(most=4) as port:
        trickle = connected(port, HALF)
        began = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - began < 20:
                trickle.sendall(b"x")
                time.sleep(SECONDS / 8)
        assert time.monotonic() - began < 20
        again = connected(port, WHOLE)
        assert answer(again).startswith(b"HTTP/1.1 200")
        again.sendall(HALF)
        while rest := answer(again):
            assert b"200" in rest or rest == b"ok"
        whole = connected(port, WHOLE[:-2])
        time.sleep(SECONDS / 8)
        whole.sendall(b"\r\n")
        assert answer(whole).startswith(b"HTTP/1.1 200")


def test_half_of_the_descriptors_stay_free() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        for limit, expected in ((256, 96), (100, 50)):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
            assert most_connections(8) == expected
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
