"""A trace of some training steps, to be viewed in a browser."""

import contextlib
from pathlib import Path
from typing import Self

import jax
from jaxtyping import PyTree

from rsjax.files import disk_guard
from rsjax.progress import note

SKIPPED = 5  # steps before the trace: the first one compiles, the next ones fill queues


class Profile:
    """A context manager around a training loop that traces some steps. With several processes, only the lead traces.

    Args:
        directory: each trace gets its own folder in it.
        first: the first step to trace.
        count: number of steps; 0: none.
    """

    def __init__(self, directory: Path, first: int, count: int) -> None:
        self._directory = directory
        self._first = first
        self._end = first + (count if jax.process_index() == 0 else 0)
        self._running = False

    @classmethod
    def after(cls, directory: Path, start: int, last: int, count: int) -> "Profile":
        """Returns a profile of ``count`` steps of a run from ``start`` + 1 to ``last``, after the first few."""
        return cls(directory, start + 1 + max(0, min(SKIPPED, last - start - count)), min(count, last - start))

    def at(self, step: int, pending: PyTree = None) -> None:
        """Starts or ends the trace when it is time. Call it before each step.

        Args:
            step: the next step.
            pending: arrays that the device may still be computing, such as the state; awaited at both ends.
        """
        if not self._running and self._first <= step < self._end:
            jax.block_until_ready(pending)
            jax.profiler.start_trace(self._directory, create_perfetto_trace=True)
            self._running = True
        elif self._running and step >= self._end:
            jax.block_until_ready(pending)
            self._stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # The trace's own errors must not hide the one under way.
        with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
            if self._running:
                self._stop()

    def _stop(self) -> None:
        self._running = False
        with disk_guard(self._directory):
            jax.profiler.stop_trace()
        trace = max(self._directory.rglob("perfetto_trace.json.gz"), key=lambda path: path.stat().st_mtime)
        note(f"trace from step {self._first} on: {trace}")
        note(f"open it at https://ui.perfetto.dev, or: pip install xprof; xprof --logdir {self._directory}")
