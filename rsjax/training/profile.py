"""A trace of some training steps, to be looked at in a browser."""

import contextlib
from pathlib import Path
from typing import Any, Self

import jax

from rsjax.files import disk_guard
from rsjax.progress import note

SKIPPED = 5  # steps before the trace: the first compiles, the next ones fill queues


class Profile:
    """Traces ``count`` steps from step ``first`` on. Used as a context manager around the loop; only one at a time.

    Only the lead process of several traces.

    Args:
        directory: where the trace goes; each one gets a directory of its own there.
        first: the first step that is traced.
        count: steps; 0: none.
    """

    def __init__(self, directory: Path, first: int, count: int) -> None:
        self._directory = directory
        self._first, self._end = first, first + (count if jax.process_index() == 0 else 0)
        self._running = False

    @classmethod
    def after(cls, directory: Path, start: int, last: int, count: int) -> "Profile":
        """``count`` steps, once a few have been done.

        Args:
            start: steps done before.
            last: the last step that will be done.
        """
        return cls(directory, start + 1 + max(0, min(SKIPPED, last - start - count)), count)

    def at(self, step: int, pending: Any = None) -> None:
        """Called before each step: starts or ends the trace where it is time.

        Args:
            step: the step that comes next.
            pending: arrays that the device may still be computing, such as the state; waited for at both ends.
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
        if not self._running:
            return
        if kind is None:
            self._stop()
        else:  # a trace of what there was; its own trouble must not hide the error that is under way
            with contextlib.suppress(Exception):
                self._stop()

    def _stop(self) -> None:
        self._running = False
        with disk_guard(self._directory):
            jax.profiler.stop_trace()
        trace = max(self._directory.rglob("perfetto_trace.json.gz"), key=lambda path: path.stat().st_mtime)
        note(f"trace from step {self._first} on: {trace}")
        note(f"open it at https://ui.perfetto.dev, or: pip install xprof; xprof --logdir {self._directory}")
