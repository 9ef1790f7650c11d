"""What a stage shows while it runs: a bar on a terminal, a line every ten seconds elsewhere."""

import time
from collections import deque
from collections.abc import Callable
from typing import Any, Self, SupportsFloat

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as RichProgress

TERMINAL_SECONDS = 0.25
PLAIN_SECONDS = 10.0
RATE_WINDOW_SECONDS = 30.0  # short enough to forget the first step, which compiles


def stage(number: int, of: int, name: str, note: str, console: Console | None = None) -> None:
    """Prints a stage's headline, such as ``[2/6] tokenizer: up to date, skipped``."""
    _say(console or Console(), f"[{number}/{of}] {name}: {note}")


def note(line: str, console: Console | None = None) -> None:
    """Prints a line that a stage has to say once, such as that a part of it is off."""
    _say(console or Console(), f"  note: {line}")


def duration(seconds: float) -> str:
    """Seconds in words: ``42 s``, ``3 min 05 s``, ``2 h 07 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class Progress:
    """Shows how far a stage has come, at what rate, the time left and the latest scalars.

    Scalars are converted to numbers only when they are shown, so passing device arrays costs nothing in between.

    Args:
        stage: what is being done.
        total: units when it is finished.
        unit: what is counted, in the plural.
        start: units that an earlier run had already done.
        console: where to show; standard output by default.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        stage: str,
        total: int,
        unit: str,
        start: int = 0,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stage, self.total, self.unit = stage, total, unit
        self._console = console or Console()
        self._clock = clock
        self._first = self._done = start
        self._bar: RichProgress | None = None

    def __enter__(self) -> Self:
        self._began = self._shown = self._clock()
        self._samples = deque([(self._began, self._first)])
        if self._console.is_terminal:
            columns = (TextColumn("  {task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[text]}"))
            self._bar = RichProgress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task(self.stage, total=self.total, completed=self._first, text="starting")
            self._bar.start()
        return self

    def update(self, done: int, **scalars: SupportsFloat) -> None:
        """Says that ``done`` of ``total`` units are finished, counted from the stage's beginning (not a step's worth).

        Args:
            done: units finished so far, those of earlier runs included.
            scalars: the latest values to show, such as ``loss=0.12``.
        """
        now = self._clock()
        self._done = done
        self._samples.append((now, done))
        while len(self._samples) > 2 and self._samples[1][0] <= now - RATE_WINDOW_SECONDS:
            self._samples.popleft()
        if now - self._shown < (PLAIN_SECONDS if self._bar is None else TERMINAL_SECONDS):
            return
        self._shown = now
        text = self._text(scalars)
        if self._bar is None:
            _say(self._console, f"  {self.stage}: {text}")
        else:
            self._bar.update(self._task, completed=done, text=text)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if kind is None:
            seconds, done = self._clock() - self._began, self._done - self._first
            rate = f" ({_rate(done / seconds, self.unit)})" if seconds > 0 and done else ""
            _say(self._console, f"  {self.stage}: {self._done} {self.unit} in {duration(seconds)}{rate}")

    def _text(self, scalars: dict[str, Any]) -> str:
        (then, before), (now, done) = self._samples[0], self._samples[-1]
        parts = [f"{done}/{self.total} {self.unit}"]
        if now > then and done > before:
            rate = (done - before) / (now - then)
            parts += [_rate(rate, self.unit), f"{duration((self.total - done) / rate)} left"]
        parts += [f"{name}={float(value):.4g}" for name, value in scalars.items()]
        return ", ".join(parts)


def _rate(per_second: float, unit: str) -> str:
    return f"{per_second:.3g} {unit}/s"


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
