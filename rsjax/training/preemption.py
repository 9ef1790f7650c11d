"""SIGTERM during training; :func:`rsjax.runtime.sigterm_stops` handles it elsewhere."""

import signal
import threading
from types import FrameType
from typing import Self

import jax

from rsjax.training.distributed import anywhere

HOSTS_EVERY = 5  # steps between two exchanges among several processes of whether one has to stop


class StopRequest:
    """Wraps a training loop: SIGTERM is only recorded, so that the current step can finish and be saved.

    Off the main thread, the only one that may handle signals, nothing is recorded.
    """

    def __init__(self) -> None:
        self._received = False

    def __enter__(self) -> Self:
        self._handles = threading.current_thread() is threading.main_thread()
        if self._handles:
            self._before = signal.signal(signal.SIGTERM, self._receive)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._handles:
            signal.signal(signal.SIGTERM, self._before)
            if self._received and kind is None:  # after the last step: leave it to the handler before
                signal.raise_signal(signal.SIGTERM)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = True

    def asked(self, step: int) -> bool:
        """Returns whether to stop after this step, the same on all processes. Each has to call it at every step."""
        if jax.process_count() == 1:
            return self._received
        return step % HOSTS_EVERY == 0 and anywhere(self._received)
