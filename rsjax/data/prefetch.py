"""Reads batches and puts them onto the device in a thread, while the training step computes."""

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Self

from grain.experimental import ThreadPrefetchDatasetIterator

from rsjax.data.loader import Loader
from rsjax.data.order import Arrays


class DeviceBatch(NamedTuple):
    """One batch on the device.

    Attributes:
        batch: the input of the training step.
        clips: ``part`` and ``record`` of this process's rows, which :meth:`Prefetch.identify` reads.
        before: state of a loader whose next batch is this one.
        after: state of a loader whose next batch is the following one.
    """

    batch: Any
    clips: Arrays
    before: dict[str, Any]
    after: dict[str, Any]


class Prefetch:
    """An iterator over a loader's batches, which a thread of Grain makes in advance and puts onto the device.

    If the loader or ``put`` fails, the call for that batch raises the error, and so does each later call. Close the
    iterator, or use it as a context manager; this closes the loader too.

    Args:
        loader: source of the batches; nothing else may read it from now on.
        put: turns a loader's arrays into the input of the training step, on the device.
        ahead: how many finished batches wait on the device, at most.

    Attributes:
        waited: total seconds that calls for the next batch have taken.
    """

    def __init__(self, loader: Loader, put: Callable[[Arrays], Any], ahead: int = 2) -> None:
        self._loader, self._state = loader, loader.state()
        self._batches: Any = ThreadPrefetchDatasetIterator(_Batches(loader, put), ahead)
        self._batches.start_prefetch()
        self.waited = 0.0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> DeviceBatch:
        began = time.monotonic()
        item = next(self._batches)
        self.waited += time.monotonic() - began
        if isinstance(item, BaseException):
            raise item
        self._state = item.after
        return item

    def state(self) -> dict[str, Any]:
        """Returns the loader's state after the last batch that was handed out, however many were made in advance."""
        return self._state

    def identify(self, batch: DeviceBatch) -> list[dict[str, Any]]:
        """Returns where the clips of a batch are and come from, as :meth:`rsjax.data.loader.Loader.identify` does.

        If several processes share the batch, it is read once more to identify the rows of all processes.
        """
        if not self._loader.shared:
            return self._loader.identify(batch.clips)
        with self._loader.whole(batch.before) as whole:
            return whole.identify(next(whole))

    def quarantined(self) -> int:
        """Returns how many records are known to be damaged."""
        return self._loader.quarantined()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops the thread and closes the loader."""
        if self._batches is not None:
            self._batches.close()
            self._batches = None  # Grain's iterator prints an error if it still exists at the interpreter's exit
        self._loader.close()


class _Batches:
    """A loader's batches on the device, in the form that Grain prefetches from.

    After an error, each further item is that error. Grain's thread forwards only an :class:`Exception`; any other
    error, such as :class:`rsjax.errors.Preempted`, ends it silently, and the training loop would wait for ever.
    """

    def __init__(self, loader: Loader, put: Callable[[Arrays], Any]) -> None:
        self._loader, self._put = loader, put
        self._failure: BaseException | None = None

    def __iter__(self) -> Iterator[DeviceBatch | BaseException]:
        return self

    def __next__(self) -> DeviceBatch | BaseException:
        if self._failure is not None:
            return self._failure
        try:
            before = self._loader.state()
            arrays = next(self._loader)
            clips = {name: arrays[name] for name in ("part", "record")}
            return DeviceBatch(self._put(arrays), clips, before, self._loader.state())
        except BaseException as error:
            self._failure = error
            return error

    def get_state(self) -> dict[str, Any]:
        return self._loader.state()
