"""One page's connection: reads its messages, answers them one after another, and sends the results."""

import asyncio
import json
import time
import traceback
from contextlib import suppress
from typing import Any

from starlette.types import Message
from starlette.websockets import WebSocket, WebSocketDisconnect

from rsjax.tools.play.answers import answer, refusal, upload
from rsjax.tools.play.hub import IN_FLIGHT, Hub, Seat
from rsjax.tools.play.messages import UPLOAD_BYTES, Refused, parse, parse_json
from rsjax.tools.play.send_queue import SendQueue
from rsjax.tools.play.viewer import Viewer

# messages per second, and at once
RATE = 120.0
BURST = 240.0
STRIKES = 20  # excess or invalid messages after which a page is disconnected
QUEUE = 64  # waiting messages, at most


class Bucket:
    """Limits the rate of messages: a bucket that fills at a constant rate, from which each message takes one unit."""

    def __init__(self) -> None:
        self._level = BURST
        self._then = time.monotonic()

    def take(self) -> bool:
        """Takes one unit, and returns whether there was one."""
        now = time.monotonic()
        self._level = min(BURST, self._level + RATE * (now - self._then))
        self._then = now
        if self._level < 1:
            return False
        self._level -= 1
        return True


class Connection:
    """One page's connection to its session."""

    def __init__(self, socket: WebSocket, hub: Hub) -> None:
        self._socket = socket
        self._hub = hub
        self._queue = SendQueue()
        self._todo: asyncio.Queue[dict[str, Any] | bytes] = asyncio.Queue(QUEUE)
        self._steps = 0
        self._uploads = 0
        self._strikes = 0
        self._over: asyncio.Future[tuple[int, str]] = asyncio.get_running_loop().create_future()

    async def serve(self, name: str | None) -> None:
        """Serves the page until it leaves or is disconnected. The socket must be accepted already."""
        try:
            seat, returned = self._hub.open(name, self.end)
        except Refused as error:
            await self._socket.close(4429, error.message)
            return
        session = seat.viewer.session
        tasks: list[asyncio.Task[None]] = []
        try:
            session.out = self._queue
            self._queue.put(self._hub.welcome(seat, returned))
            if session.tree is not None:
                self._queue.put({"type": "session", "id": 0} | seat.viewer.describe())
            tasks += [asyncio.create_task(work) for work in (self._read(seat), self._work(seat.viewer), self._send())]
            code, reason = await self._over
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._hub.leave(seat, self.end)
        if code:
            with suppress(RuntimeError, WebSocketDisconnect, OSError):
                await self._socket.close(code, reason)

    def end(self, code: int, reason: str) -> None:
        """Ends the connection; code 0 means that the page has left."""
        if not self._over.done():
            self._over.set_result((code, reason))

    async def _read(self, seat: Seat) -> None:
        bucket = Bucket()
        try:
            while True:
                raw = await self._socket.receive()
                if raw["type"] != "websocket.receive":
                    break
                seat.viewer.session.used = time.monotonic()
                try:
                    if not bucket.take():
                        raise Refused("too_fast", "too many messages a second")
                    self._take(raw)
                except Refused as error:
                    self._queue.put(refusal(error_id(raw.get("text")), error))
                    self._strikes += error.code in ("too_fast", "too_large", "bad_message")
                if self._strikes >= STRIKES:
                    self.end(1008, "too many messages, or messages without sense")
                    return
        except (WebSocketDisconnect, RuntimeError):
            pass
        self.end(0, "")

    def _take(self, raw: Message) -> None:
        """Puts a message into the queue."""
        if raw.get("bytes") is not None:
            if len(raw["bytes"]) > UPLOAD_BYTES:
                raise Refused("too_large", f"a picture can have {UPLOAD_BYTES // 2**20} MiB")
            if self._uploads:
                raise Refused("busy", "a picture waits already")
            self._wait(raw["bytes"])
            self._uploads += 1
            return
        message = parse(raw["text"])
        if message["type"] == "step":
            if self._steps >= IN_FLIGHT:
                raise Refused("busy", f"{IN_FLIGHT} steps are not answered yet")
            self._wait(message)
            self._steps += 1
        else:
            self._wait(message)

    def _wait(self, item: dict[str, Any] | bytes) -> None:
        try:
            self._todo.put_nowait(item)
        except asyncio.QueueFull:
            raise Refused("busy", f"{QUEUE} messages are not answered yet") from None

    async def _work(self, viewer: Viewer) -> None:
        while True:
            item = await self._todo.get()
            try:
                made = await (upload(viewer, item) if isinstance(item, bytes) else answer(viewer, item))
            except Exception:
                traceback.print_exc()
                if isinstance(item, bytes):
                    number = 0
                else:
                    number = error_id(json.dumps(item))
                made = refusal(number, Refused("failed", "something went wrong; the server's terminal says what"))
            if isinstance(item, bytes):
                self._uploads -= 1
            elif item["type"] == "step":
                self._steps -= 1
            self._strikes += made.get("error") == "bad_message"
            self._queue.put(made)
            if self._strikes >= STRIKES:
                self.end(1008, "too many messages without sense")

    async def _send(self) -> None:
        try:
            while (item := await self._queue.next()) is not None:
                if isinstance(item, bytes):
                    await self._socket.send_bytes(item)
                else:
                    await self._socket.send_text(json.dumps(item, allow_nan=False))
            self.end(1013, "the page is too slow")
        except (WebSocketDisconnect, RuntimeError, OSError):
            self.end(0, "")


def error_id(text: str | None) -> int:
    """Returns the id of a refused message, or 0 if it has none."""
    try:
        number = parse_json(text or "null")["id"]
    except (ValueError, TypeError, KeyError):
        return 0
    if type(number) is int and 0 < number < 2**32:
        return number
    return 0
