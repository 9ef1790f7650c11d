"""Batches put onto the device before they are asked for."""

import queue
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Self

from rsjax.data.loader import Loader
from rsjax.data.order import Arrays

JOIN_SECONDS = 30.0  # for a batch that is being read when the end comes


class DeviceBatch(NamedTuple):
    """One batch.

    Attributes:
        batch: what the training step takes, on the device.
        clips: which clips these are, for :meth:`Prefetch.identify`: ``part`` and ``record``, of this process's rows.
        before: the loader's state before this batch: given to a loader, it begins with this batch.
        after: the same after it.
    """

    batch: Any
    clips: Arrays
    before: dict[str, Any]
    after: dict[str, Any]


class Prefetch:
    """Hands out a loader's batches, of which the next ones are made and put onto the device by a thread meanwhile.

    Close it, or use it as a context manager: that closes the loader too.

    Args:
        loader: what is read; its own from now on.
        put: a loader's arrays to what the training step takes, on the device.
        ahead: how many batches wait on the device at most, beside the one that is being made.

    Attributes:
        waited: seconds that calls for the next batch have taken in all.
    """

    def __init__(self, loader: Loader, put: Callable[[Arrays], Any], ahead: int = 2) -> None:
        self._loader, self._put = loader, put
        self._queue: queue.Queue[DeviceBatch | BaseException] = queue.Queue(ahead)
        self._state = loader.state()
        self._stopped = threading.Event()
        self._failure: BaseException | None = None
        self.waited = 0.0
        self._thread = threading.Thread(target=self._work, name="prefetch", daemon=True)
        self._thread.start()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> DeviceBatch:
        began = time.monotonic()
        item = self._failure or self._queue.get()
        self.waited += time.monotonic() - began
        if isinstance(item, BaseException):
            self._failure = item
            raise item
        self._state = item.after
        return item

    def state(self) -> dict[str, Any]:
        """The loader's state after the last batch that was handed out, whatever was made ahead."""
        return self._state

    def identify(self, fed: DeviceBatch) -> list[dict[str, Any]]:
        """Where the clips of a batch lie and come from: :meth:`rsjax.data.loader.Loader.identify`.

        Of several processes', all rows of the batch, which is read once more for that.
        """
        if not self._loader.shared:
            return self._loader.identify(fed.clips)
        with self._loader.whole(fed.before) as whole:
            return whole.identify(next(whole))

    def quarantined(self) -> int:
        """How many records are known to be damaged."""
        return self._loader.quarantined()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops the thread and closes the loader."""
        self._stopped.set()
        while not self._queue.empty():  # the thread may wait for room
            self._queue.get_nowait()
        self._thread.join(JOIN_SECONDS)
        self._loader.close()

    def _work(self) -> None:
        item: DeviceBatch | BaseException
        while not self._stopped.is_set():
            try:
                item = self._make()
            except BaseException as error:  # is raised where the batch is asked for
                item = error
            self._queue.put(item)
            if isinstance(item, BaseException):
                return

    def _make(self) -> DeviceBatch:
        before = self._loader.state()
        arrays = next(self._loader)
        clips = {name: arrays[name] for name in ("part", "record")}
        return DeviceBatch(self._put(arrays), clips, before, self._loader.state())
