"""What a stage prints while it runs: a bar on a terminal, a line every ten seconds elsewhere."""

import time
from collections import deque
from collections.abc import Callable
from typing import Self, SupportsFloat

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as RichProgress

TERMINAL_SECONDS = 0.25
PLAIN_SECONDS = 10.0
RATE_WINDOW_SECONDS = 30.0  # short enough to forget the first step, which compiles
_BAR_COLUMNS = 30  # of the bar and the space around it


def stage(number: int, of: int, name: str, note: str) -> None:
    """Prints a stage's headline, such as ``[2/6] tokenizer: up to date, skipped``."""
    print(f"[{number}/{of}] {name}: {note}", flush=True)


def note(line: str) -> None:
    """Prints a message of a stage, such as that something is switched off."""
    print(f"  note: {line}", flush=True)


def duration(seconds: float) -> str:
    """Formats a time: ``42 s``, ``3 min 05 s``, ``2 h 07 min``."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


class Progress:
    """Shows how far a stage has got, its rate, the time left and the latest scalars. A context manager around the work.

    Args:
        stage: name of the work.
        total: number of units of the whole stage.
        unit: name of the units, in the plural.
        start: number of units that an earlier run finished.
        console: where to print; default: standard output.
        clock: returns seconds, monotonic.
        per_unit: the parts of a unit and their number, such as ``("tokens", 16384)``, for a second rate.
        settle: number of units at the start that the rates leave out, because workers are still starting.
    """

    def __init__(
        self,
        stage: str,
        total: int,
        unit: str,
        start: int = 0,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
        per_unit: tuple[str, float] | None = None,
        settle: int = 0,
    ) -> None:
        self.stage = stage
        self.total = total
        self.unit = unit
        self.per_unit = per_unit
        self._settled = start + settle
        self._console = console or Console()
        self._clock = clock
        self._first = start
        self._done = start
        self._bar: RichProgress | None = None

    def __enter__(self) -> Self:
        self._began = self._clock()
        self._shown = self._began
        self._samples = deque([(self._began, self._first)])
        if self._console.is_terminal:
            columns = (TextColumn("  {task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[text]}"))
            self._bar = RichProgress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task(self.stage, total=self.total, completed=self._first, text="starting")
            self._bar.start()
        return self

    def update(self, done: int, **scalars: SupportsFloat) -> None:
        """Reports progress.

        Args:
            done: number of finished units of the whole stage, including those of earlier runs.
            scalars: the latest values, such as ``loss=0.12``. Device arrays cost nothing until they are shown.
        """
        now = self._clock()
        self._done = done
        # A pause between quick units, as to compile a second program, says nothing about the units to come.
        paused = len(self._samples) > 3 and now - self._samples[-1][0] > RATE_WINDOW_SECONDS
        if done <= self._settled or paused:
            self._samples.clear()
        self._samples.append((now, done))
        while len(self._samples) > 2 and self._samples[1][0] <= now - RATE_WINDOW_SECONDS:
            self._samples.popleft()
        if now - self._shown < (PLAIN_SECONDS if self._bar is None else TERMINAL_SECONDS):
            return
        self._shown = now
        then, before = self._samples[0]
        parts = [f"{done}/{self.total} {self.unit}"]
        if now > then and done > before:
            rate = (done - before) / (now - then)
            parts += [*self._rates(rate), f"{duration((self.total - done) / rate)} left"]
        values = [f"{name}={float(value):.4g}" for name, value in scalars.items()]
        line = ", ".join(parts + values)
        if self._bar is None:
            self._print(line)
            return
        if len(self.stage) + _BAR_COLUMNS + len(line) > self._console.width:
            line = f"{', '.join(parts)}\n{', '.join(values)}"
        self._bar.update(self._task, completed=done, text=line)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if kind is None:
            seconds = self._clock() - self._began
            done = self._done - self._first
            rates = f" ({', '.join(self._rates(done / seconds))})" if seconds > 0 and done else ""
            self._print(f"{self._done} {self.unit} in {duration(seconds)}{rates}")

    def _print(self, line: str) -> None:
        self._console.print(f"  {self.stage}: {line}", markup=False, highlight=False, soft_wrap=True)

    def _rates(self, per_second: float) -> list[str]:
        rates = [f"{per_second:.3g} {self.unit}/s"]
        if self.per_unit is not None:
            what, count = self.per_unit
            rates.append(f"{_thousands(per_second * count)} {what}/s")
        return rates


def _thousands(number: float) -> str:
    """Formats a number with three digits: ``950``, ``16.4k``, ``2.03M``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= 0.9995 * size:
            return f"{number / size:#.3g}".rstrip(".") + letter
    return f"{number:.3g}"
