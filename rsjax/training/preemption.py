"""SIGTERM during training; :func:`rsjax.runtime.stop_signals` handles it elsewhere."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Self

import jax

from rsjax.runtime import patient
from rsjax.training.distributed import anywhere

HOSTS_EVERY = 5  # steps after which several processes tell each other again whether one has to stop


class StopRequest:
    """Wraps a training loop: SIGTERM is only recorded, so that the current step can finish and be saved.

    Until the first step, which takes long to compile, is done, there is nothing to save, and the previous handler
    answers. Off the main thread, the only one that may handle signals, nothing is recorded.
    """

    def __init__(self) -> None:
        self._received = False
        self._stepped = False

    def __enter__(self) -> Self:
        self._handles = threading.current_thread() is threading.main_thread()
        if self._handles:
            self._before = signal.signal(signal.SIGTERM, self._receive)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._handles:
            signal.signal(signal.SIGTERM, self._before)
            if jax.process_count() == 1:
                patient.clear()
            if self._received and kind is None:  # after the last step: leave it to the previous handler
                signal.raise_signal(signal.SIGTERM)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = True
        if not self._stepped and jax.process_count() == 1 and callable(self._before):
            self._before(number, frame)

    def asked(self, step: int) -> bool:
        """Returns whether to stop after this step, the same on all processes. Each has to call it at every step."""
        if jax.process_count() == 1:
            if self._handles and not self._stepped:
                self._stepped = True
                patient.set()
            return self._received
        return step % HOSTS_EVERY == 0 and anywhere(self._received)

    @contextmanager
    def impatient(self) -> Iterator[None]:
        """Wraps work between steps that may take longer than a scheduler waits, such as compiling the validation.

        If the work goes on for :data:`rsjax.runtime.STOP_SECONDS` after SIGTERM, the process ends, and the run resumes
        from the newest checkpoint.
        """
        was_set = patient.is_set() and jax.process_count() == 1
        if was_set:
            patient.clear()
        try:
            yield
        finally:
            if was_set:
                patient.set()
