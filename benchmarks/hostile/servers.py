"""The two servers: requests, messages of the page, and messages of programs, each with absurd fields."""

import asyncio
import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from benchmarks.hostile.cases import Case, Ended, Place
from rsjax.tools.play.viewer import SEARCHING

SECONDS = 300.0  # for an answer; the first frame compiles
PLANS = "the planner searches for seconds, and says so"
TARGETS = {
    "a number of 4400 digits": "/api/clip/" + "9" * 4400 + ".webp",
    "a negative number": "/api/clip/-1.webp",
    "digits of another script": "/api/clip/%D9%A1.webp",
    "a float": "/api/clip/1.5.webp",
    "nothing for a number": "/api/clip/.webp",
    "a path upwards": "/page/../../../etc/passwd",
    "an encoded path upwards": "/page/%2e%2e%2f%2e%2e%2fetc%2fpasswd",
    "a null byte": "/page/%00",
    "bytes that are not text": "/page/%ff%fe",
    "a path of 60,000 characters": "/" + "x" * 60_000,
    "a file of nobody": "/api/file/../../config.json",
    "a file number of 4400 digits": "/api/file/" + "9" * 4400,
    "first of 4400 digits": "/api/clips?first=" + "9" * 4400,
    "first below 0": "/api/clips?first=-1",
    "count 0": "/api/clips?count=0",
    "count of 400 digits": "/api/clips?count=" + "9" * 400,
    "count in another script": "/api/clips?count=%C2%B2",
    "a token where there is none": "/api/health?token=" + "x" * 5000,
    "a query of nothing but &": "/api/clips?" + "&" * 5000,
    "an unknown address": "/admin",
}
METHODS = ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "HEAD", "NONSENSE")
HOSTS = (
    "evil.example",
    "[::1",
    "[::1]evil",
    "localhost:80:evil",
    "localhost:x",
    "::1",
    "",
    "x" * 5000,
    "127.0.0.1.evil.example",
)
RAW = {
    "nothing": b"",
    "a line without an end": b"GET / HTTP/1.1\r\nHost: localhost\r\n",
    "bytes": bytes(range(256)) * 8,
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\0" * 64,
    "two lengths": b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nx",
    "a negative length": b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
    "a header of 100,000 characters": b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 100_000 + b"\r\n\r\n",
    "10,000 headers": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"X: 1\r\n" * 10_000 + b"\r\n",
    "HTTP of the future": b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
    "an upgrade without a key": b"GET /ws HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n\r\n",
}
NUMBERS: tuple[Any, ...] = (None, True, -1, 1.5, 2**31, 2**64, 10**400, "1", "", [], {}, [[1]], 1e308)
LISTS: tuple[Any, ...] = (None, 3, "rgb", {}, [1], [None], ["x"] * 1000, [["rgb"]], ["rgb" * 10_000], [10**400])
ACTIONS: tuple[Any, ...] = (
    None,
    3,
    "x",
    {},
    [],
    [1],
    [None] * 28,
    ["1"] * 28,
    [10**400] * 28,
    [1e308] * 28,
    [[0] * 28],
    [0] * 10_000,
)
# Messages of the page: their usual fields, and the fields that take absurd values.
MESSAGES: dict[str, tuple[dict[str, Any], dict[str, tuple[Any, ...]]]] = {
    "start": ({"clip": 0}, {"clip": NUMBERS, "seed": NUMBERS, "upload": (1, "x", [], None)}),
    "settings": ({}, dict.fromkeys(("temperature", "steps", "guidance", "top_k"), NUMBERS)),
    "watch": ({"kinds": []}, {"kinds": LISTS}),
    "step": (
        {"branch": 0, "source": {"kind": "random"}},
        {
            "branch": NUMBERS,
            "source": (
                None,
                3,
                "random",
                [],
                {},
                {"kind": None},
                {"kind": "x" * 9999},
                {"kind": "clip", "clip": -1},
                {"kind": "clip", "clip": 10**400},
                {"kind": "policy"},
                {"kind": "planner"},
            ),
        },
    ),
    "fork": ({"branch": 0, "frame": 0}, {"branch": NUMBERS, "frame": NUMBERS, "draw": NUMBERS}),
    "drop": ({"branch": 0}, {"branch": NUMBERS}),
    "frames": (
        {"branch": 0, "first": 0, "count": 1, "kinds": ["rgb"]},
        {"branch": NUMBERS, "first": NUMBERS, "count": NUMBERS, "kinds": LISTS},
    ),
    "record": (
        {"branch": 0, "format": "gif", "fps": 4, "panes": ["rgb"], "scale": 1},
        {
            "branch": NUMBERS,
            "format": NUMBERS,
            "fps": NUMBERS,
            "panes": (*LISTS, ["branch:-1"], ["branch:" + "9" * 400], ["branch:²"]),
            "scale": NUMBERS,
        },
    ),
    "export": ({}, {"branches": (*LISTS, [-1], [2**64])}),
    "load": ({"state": ""}, {"state": (None, 3, "", "x", "====", "é", "A" * 200_000, "eJw" * 50)}),
    "ping": ({}, {"id": NUMBERS}),
}
TEXTS = (
    "",
    "x",
    "null",
    "3",
    "[]",
    "{",
    "{}",
    '{"type": 1}',
    '{"type": "x", "id": 1}',
    '{"type": "ping"}',
    "[" * 100_000,
    '{"a":' * 50_000,
    '{"type": "ping", "id": NaN}',
    '{"type": "ping", "id": 1' + "0" * 5000 + "}",
    '{"type": "' + "x" * 250_000 + '", "id": 1}',
    "\udcff",
)
PICTURES = (
    b"",
    b"x",
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff\xe0" + b"\0" * 100,
    b"RIFF\xff\xff\xff\xffWEBP",
    b"GIF89a" + b"\xff" * 100,
    b"\0" * 2**20,
    b"BM" + b"\xff" * 64,
)
# Messages of programs.
FIELDS: tuple[Any, ...] = (
    None,
    True,
    -1,
    1.5,
    float("nan"),
    2**31,
    2**63,
    "1",
    "x" * 10_000,
    b"x",
    [],
    [1],
    [[1], [1, 2]],
    {},
    {"x": 1},
    np.zeros(0),
    np.full(28, np.nan),
    np.zeros((64, 64, 3)),
    np.zeros((1, 28)),
    np.array(3.0),
)
WIRE: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "reset": ({"clip": 0}, ("clip", "seed", "rgb", "depth", "draw", "ofenrohr")),
    "step": ({}, ("action", "ofenrohr")),
    "generate": ({"clip": 0}, ("actions", "clip", "rgb", "ofenrohr")),
    "": ({}, ("endpoint",)),
}


def _array(data: Any = b"", dtype: Any = "<f4", shape: Any = (0,)) -> bytes:
    """Packs a step whose action is an array of these parts."""
    action = {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    return bytes(msgpack.packb({"endpoint": "step", "action": action}))


def _scalar(data: Any) -> bytes:
    return bytes(
        msgpack.packb({"endpoint": "step", "action": {b"__npgeneric__": True, b"data": data, b"dtype": "<i1"}})
    )


PACKED: dict[str, bytes] = {
    "nothing": b"",
    "no msgpack": b"\xc1",
    "random": b"\xff" * 1000,
    "cut off": b"\x81",
    "nested": b"\x91" * 5000,
    "a list": msgpack.packb([1]),
    "a number": msgpack.packb(3),
    "keys of numbers": msgpack.packb({1: 2}),
    "an array as endpoint": msgpack.packb({"endpoint": {b"__ndarray__": True}}),
    "an array of 2**248 numbers": _array(shape=[2**31 - 1] * 8),
    "a negative side": _array(shape=[-1]),
    "objects": _array(dtype="O"),
    "too few bytes": _array(b"x", shape=[1]),
    "a float of 3 bytes": _array(b"\0" * 4, "<f3", [1]),
    "a shape that is a number": _array(b"\0" * 4, shape=1),
    "a shape of lists": _array(b"\0" * 4, shape=[[1]]),
    "dates": _array(b"\0" * 8, "<M8", [1]),
    "a float of 99 bytes": _array(dtype="<f99"),
    "a type of 999 letters": _array(dtype="x" * 999),
    "data that are a number": _array(3, shape=[1]),
    "99 axes": _array(shape=[0] * 99),
    "a scalar that does not fit": _scalar(2**62),
    "a scalar of nothing": _scalar(None),
}


def cases() -> Iterator[Case]:
    """Yields a case for each request and message."""
    for name, target in TARGETS.items():
        yield Case(f"play http: {name}", _request("GET", target))
    for method in METHODS:
        yield Case(f"play http: method {method}", _request(method, "/api/health"))
    for host in HOSTS:
        yield Case(f"play http: host {host[:30]!r}", _request("GET", "/", host))
    for name, raw in RAW.items():
        yield Case(f"play http: {name}", _raw(raw))
    for kind, (usual, fields) in MESSAGES.items():
        for field, values in fields.items():
            for number, value in enumerate(values):
                message = {"type": kind, "id": 1} | usual | {field: value}
                name = f"play: {kind}, {field} {number}: {_short(value)}"
                yield Case(name, _message(json.dumps(message)), accepted=PLANS if value == {"kind": "planner"} else "")
            yield Case(
                f"play: {kind} without {field}",
                _message(
                    json.dumps(
                        {"type": kind, "id": 1} | {name: value for name, value in usual.items() if name != field}
                    )
                ),
            )
    for number, action in enumerate(ACTIONS):
        message = {"type": "step", "id": 1, "branch": 0, "action": action}
        yield Case(f"play: step, action {number}: {_short(action)}", _message(json.dumps(message)))
    for number, text in enumerate(TEXTS):
        yield Case(f"play: text {number}: {_short(text)}", _message(text))
    for number, picture in enumerate(PICTURES):
        yield Case(f"play: picture {number}: {_short(picture)}", _message(picture))
    for endpoint, (usual, names) in WIRE.items():
        for field in names:
            for number, value in enumerate(FIELDS):
                yield Case(
                    f"serve: {endpoint or 'no endpoint'}, {field} {number}: {_short(value)}",
                    _wire(_packed({"endpoint": endpoint} | usual | {field: value})),
                )
    for name, data in PACKED.items():
        yield Case(f"serve: bytes, {name}", _wire(data))
    yield Case("serve: text", _wire("x"))


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"array {value.shape}"
    text = repr(value) if not isinstance(value, int) or abs(value) < 2**65 else "10**400"
    return text if len(text) < 40 else f"{text[:24]}… ({len(text)} characters)"


def _packed(message: dict[str, Any]) -> bytes:
    from rsjax.tools.serve.wire import pack_array

    def default(value: Any) -> Any:
        return pack_array(value)

    return bytes(msgpack.packb(message, default=default))


def _request(method: str, target: str, host: str = "localhost") -> Callable[[Place], Ended]:
    def act(place: Place) -> Ended:
        connection = http.client.HTTPConnection("127.0.0.1", play(place.material).port, timeout=SECONDS)
        connection.putrequest(method, target, skip_host=True)
        connection.putheader("Host", host)
        connection.endheaders()
        try:
            answer = connection.getresponse()
            body = answer.read()
        except (http.client.HTTPException, ConnectionError):
            return Ended("refused", "the connection was closed")
        finally:
            connection.close()
        return _of_status(answer.status, body)

    return act


def _raw(data: bytes) -> Callable[[Place], Ended]:
    def act(place: Place) -> Ended:
        with socket.create_connection(("127.0.0.1", play(place.material).port), SECONDS) as connection:
            with suppress(OSError):
                connection.sendall(data)
            with suppress(OSError):
                connection.shutdown(socket.SHUT_WR)
            answer = b""
            with suppress(OSError):
                while part := connection.recv(65536):
                    answer += part
        if not answer:
            return Ended("refused", "the connection was closed")
        return _of_status(int(answer.split()[1]), answer[-500:])

    return act


def _of_status(status: int, body: bytes) -> Ended:
    if status >= 500:
        return Ended("broke", f"status {status}: {body[:500]!r}")
    if status >= 400 or status == 426:
        return Ended("refused", f"status {status}: {body[:500]!r}")
    return Ended("ended", f"status {status}")


def _message(data: str | bytes) -> Callable[[Place], Ended]:
    """Sends a message after a start, and returns how it was answered; the session has to answer a ping after that."""

    def act(place: Place) -> Ended:
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        with connect(f"ws://127.0.0.1:{play(place.material).port}/ws", max_size=2**24) as page:
            page.recv(SECONDS)
            page.send(json.dumps({"type": "start", "id": 1000, "clip": 0, "seed": 0}))
            _answer(page, 1000)
            try:
                if isinstance(data, str):
                    page.send(data.encode(errors="surrogateescape"), text=True)
                else:
                    page.send(data)
                page.send(json.dumps({"type": "ping", "id": 1001}))
                answers = []
                while True:
                    answer = _next(page)
                    if answer["type"] == "status" and answer["text"] == SEARCHING:
                        return Ended("began", SEARCHING)
                    answers.append(answer)
                    if answer.get("id") == 1001:
                        break
            except ConnectionClosed as closed:
                reason = str(closed)
                return Ended("refused" if closed.rcvd is not None and closed.rcvd.code != 1011 else "broke", reason)
        failed = [answer for answer in answers if answer.get("error") == "failed"]
        if failed:
            return Ended("broke", str(failed))
        refused = [answer for answer in answers if answer["type"] == "error"]
        if refused:
            return Ended("refused", refused[0]["message"])
        return Ended("ended", str(answers[0])[:200])

    return act


def _answer(page: Any, number: int) -> dict[str, Any]:
    while True:
        answer = _next(page)
        if answer.get("id") == number and answer["type"] != "progress":
            return answer


def _next(page: Any) -> dict[str, Any]:
    while True:
        raw = page.recv(SECONDS)
        if isinstance(raw, str):
            answer: dict[str, Any] = json.loads(raw)
            return answer


def _wire(data: str | bytes) -> Callable[[Place], Ended]:
    """Sends a message after a reset; afterwards a step has to be answered."""

    def act(place: Place) -> Ended:
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        with connect(served(place.material), compression=None, max_size=None) as client:
            client.recv(SECONDS)
            client.send(_packed({"endpoint": "reset", "clip": 0}))
            client.recv(SECONDS)
            try:
                client.send(data)
                answer = client.recv(SECONDS)
                if isinstance(answer, str) and "the server failed" in answer:
                    return Ended("broke", answer)
                client.send(_packed({"endpoint": "step", "action": np.zeros(28)}))
                if isinstance(client.recv(SECONDS), str):
                    return Ended("broke", "the episode does not go on")
            except ConnectionClosed as closed:
                return Ended(
                    "refused" if closed.rcvd is not None and closed.rcvd.code != 1011 else "broke", str(closed)
                )
        if isinstance(answer, str):
            return Ended("refused", answer)
        return Ended("ended", "answered")

    return act


class Playing:
    """A playground that is served in this process."""

    def __init__(self, material: Path) -> None:
        import uvicorn

        from rsjax.tools.play.connections import bounded, most_connections
        from rsjax.tools.play.engine import Engine
        from rsjax.tools.play.guard import Guard
        from rsjax.tools.play.hub import Hub
        from rsjax.tools.play.messages import UPLOAD_BYTES
        from rsjax.tools.play.play_run import PlayRun
        from rsjax.tools.play.serve import listen
        from rsjax.tools.play.server import make_app
        from rsjax.tools.policies.run_data import RunData

        run = PlayRun(RunData(material / "run", material / "data"), out=material / "play")
        hub = Hub(run, Engine(run.trained, 1), 64, 600.0, grace=0.0)
        listener = listen("127.0.0.1", 0)
        self.port = listener.getsockname()[1]
        config = uvicorn.Config(
            make_app(hub, Guard("")),
            log_level="warning",
            access_log=False,
            ws_max_size=UPLOAD_BYTES + 1024,
            ws_per_message_deflate=False,
            http=bounded(most_connections(64)),
        )
        server = uvicorn.Server(config)
        threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True).start()
        while not server.started:
            time.sleep(0.05)


@cache
def play(material: Path) -> Playing:
    """Returns the playground of this process."""
    return Playing(material)


@cache
def served(material: Path) -> str:
    """Returns the address of a world model that this process serves."""
    from rsjax.tools.play.play_run import PlayRun
    from rsjax.tools.play.serve import listen
    from rsjax.tools.policies.run_data import RunData
    from rsjax.tools.serve.server import WorldServer, WorldServerSettings

    listener = listen("127.0.0.1", 0)
    world = WorldServer(PlayRun(RunData(material / "run", material / "data")), WorldServerSettings(port=0, frames=9))
    server = world.open(listener)  # which takes the listener over
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
