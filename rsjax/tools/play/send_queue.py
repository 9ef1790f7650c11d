"""Queues messages for one page. A slow page loses pictures, which it can request again, and finally its connection."""

import asyncio
from collections import deque
from typing import Any

UNSENT = 32  # unsent messages from which on droppable messages are dropped
MOST = 256  # unsent messages at which a page counts as too slow to be served


class SendQueue:
    """A queue of messages, from any coroutine to the one that sends them; a session and its connection share it."""

    def __init__(self) -> None:
        self._items: deque[bytes | dict[str, Any]] = deque()
        self._changed = asyncio.Event()
        self.overflowed = False

    def put(self, item: bytes | dict[str, Any], droppable: bool = False) -> None:
        """Adds a message, or drops it if it is droppable and too many are unsent."""
        if droppable and len(self._items) >= UNSENT:
            return
        self.overflowed |= len(self._items) >= MOST
        if not self.overflowed:
            self._items.append(item)
        self._changed.set()

    async def next(self) -> bytes | dict[str, Any] | None:
        """Returns the message to send next; None if the page is too slow."""
        while not self._items and not self.overflowed:
            self._changed.clear()
            await self._changed.wait()
        if self.overflowed:
            return None
        item = self._items.popleft()
        self._changed.set()
        return item

    async def room(self) -> None:
        """Waits until few messages are unsent."""
        while len(self._items) >= UNSENT // 2 and not self.overflowed:
            await asyncio.sleep(0.005)
