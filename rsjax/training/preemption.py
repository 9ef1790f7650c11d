"""SIGTERM in a training loop; :func:`rsjax.runtime.sigterm_stops` has it elsewhere."""

import signal
import threading
from types import FrameType
from typing import Self

import jax

from rsjax.training.distributed import anywhere

HOSTS_EVERY = 5  # steps between two questions among several processes whether one of them is to stop


class StopRequest:
    """Around a training loop: SIGTERM is only noted, so that the step under way can end and be saved.

    Off the main thread, which alone may handle signals, nothing is noted.
    """

    def __init__(self) -> None:
        self._noted = False

    def __enter__(self) -> Self:
        self._handles = threading.current_thread() is threading.main_thread()
        if self._handles:
            self._before = signal.signal(signal.SIGTERM, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._handles:
            signal.signal(signal.SIGTERM, self._before)
            if self._noted and kind is None:  # too late for a step to be stopped at: who had it before answers it
                signal.raise_signal(signal.SIGTERM)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._noted = True

    def asked(self, step: int) -> bool:
        """Whether to stop after this step: the same answer on all processes, each of which has to ask at every step."""
        if jax.process_count() == 1:
            return self._noted
        return step % HOSTS_EVERY == 0 and anywhere(self._noted)
