"""A page without a browser: a server in a thread, and a client of its socket."""

import http.client
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import uvicorn
from websockets.sync.client import ClientConnection, connect

from rsjax.tools.play.connections import bounded, most_connections
from rsjax.tools.play.guard import Guard
from rsjax.tools.play.hub import Hub
from rsjax.tools.play.messages import UPLOAD_BYTES
from rsjax.tools.play.pictures import HEADER
from rsjax.tools.play.serve import listen
from rsjax.tools.play.server import make_app
from tests.waiting import wait_until

NAMES = ("version", "kind", "branch", "frame", "id", "format", "zero", "width", "height", "zero2", "scale")


@dataclass
class Picture:
    """A binary message: the numbers of its header by name, and what follows."""

    header: dict[str, Any]
    payload: bytes

    def __getattr__(self, name: str) -> Any:
        return self.header[name]


@dataclass
class Client:
    """A page's end of a socket.

    Attributes:
        pictures, pushed: what came beside final answers.
    """

    socket: ClientConnection
    pictures: list[Picture] = field(default_factory=list)
    pushed: list[dict[str, Any]] = field(default_factory=list)
    number: int = 0

    def next(self, timeout: float = 120.0) -> dict[str, Any] | Picture:
        """Returns the next message."""
        raw = self.socket.recv(timeout)
        if isinstance(raw, bytes):
            header = dict(zip(NAMES, HEADER.unpack(raw[: HEADER.size]), strict=True))
            return Picture(header, raw[HEADER.size :])
        message: dict[str, Any] = json.loads(raw)
        return message

    def ask(self, kind: str, **fields: Any) -> dict[str, Any]:
        """Sends a message and returns its final answer."""
        return self.wait(self.send(kind, **fields))

    def send(self, kind: str, **fields: Any) -> int:
        """Sends a message and returns its id."""
        self.number += 1
        self.socket.send(json.dumps({"type": kind, "id": self.number} | fields))
        return self.number

    def wait(self, number: int) -> dict[str, Any]:
        """Returns the final answer to a message."""
        while True:
            message = self.next()
            if isinstance(message, Picture):
                self.pictures.append(message)
            elif message["id" if "id" in message else "type"] == number and message["type"] not in _PUSHED:
                return message
            else:
                self.pushed.append(message)

    def keep_next(self) -> None:
        """Waits for the next message, and keeps it with those of its kind."""
        message = self.next()
        (self.pictures if isinstance(message, Picture) else self.pushed).append(message)  # type: ignore[arg-type]

    def until(self, kind: int, count: int) -> list[Picture]:
        """Waits until so many pictures of a kind have come, and returns them."""
        while len(found := [each for each in self.pictures if each.kind == kind]) < count:
            self.keep_next()
        return found

    def until_pushed(self, kind: str, count: int) -> list[dict[str, Any]]:
        """Waits until so many messages of a type have come beside answers, and returns them."""
        while len(found := [each for each in self.pushed if each["type"] == kind]) < count:
            self.keep_next()
        return found

    def drive(self, steps: int, branch: int = 0, **fields: Any) -> list[Picture]:
        """Does random steps and returns their frames."""
        before = len(self.pictures)
        for _ in range(steps):
            made = self.ask("step", branch=branch, **(fields or {"source": {"kind": "random"}}))
            assert made["type"] == "stepped", made
        return [each for each in self.pictures[before:] if each.kind == 1]


_PUSHED = ("progress", "truth", "truth_off", "points", "status")


@dataclass
class Server:
    """A server that runs in a thread."""

    hub: Hub
    port: int

    @contextmanager
    def client(self, query: str = "", **options: Any) -> Iterator[tuple[Client, dict[str, Any]]]:
        """Connects; yields a client and the first message."""
        with connect(f"ws://127.0.0.1:{self.port}/ws{query}", max_size=2**24, **options) as socket:
            client = Client(socket)
            welcome = client.next()
            assert isinstance(welcome, dict)
            yield client, welcome

    def get(self, path: str, host: str = "", method: str = "GET") -> tuple[int, dict[str, str], bytes]:
        """Returns status, headers and body of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request(method, path, headers={"Host": host} if host else {})
        answer = connection.getresponse()
        found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        connection.close()
        return found


@contextmanager
def serving(hub: Hub, token: str = "", sweep: float = 0.05) -> Iterator[Server]:
    """Serves a hub."""
    listener = listen("127.0.0.1", 0)
    config = uvicorn.Config(
        make_app(hub, Guard(token), sweep),
        log_level="critical",
        ws_max_size=UPLOAD_BYTES + 1024,
        ws="websockets-sansio",
        http=bounded(most_connections(hub.most)),
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_until(lambda: server.started)
    try:
        yield Server(hub, listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join()
        hub.engine.close()
