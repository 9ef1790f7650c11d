"""Tests how often lines of progress appear, and whether their rates and remaining times are right."""

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from rsjax.progress import PLAIN_SECONDS, RATE_WINDOW_SECONDS, Progress, _thousands, duration, note, stage


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Counted:
    """A scalar that counts its conversions to a number."""

    reads = 0

    def __float__(self) -> float:
        self.reads += 1
        return 0.5


def run(
    steps: list[tuple[float, int]], total: int, start: int = 0, terminal: bool = False, settle: int = 0
) -> list[str]:
    """Returns the lines that appear during a series of updates, each (seconds since the last update, done)."""
    shown, clock = io.StringIO(), Clock()
    console = Console(file=shown, force_terminal=terminal, width=200)
    with Progress("train", total, "steps", start, console, clock, settle=settle) as progress:
        for seconds, done in steps:
            clock.now += seconds
            progress.update(done, loss=0.25)
    return shown.getvalue().splitlines()


def test_a_line_gives_done_rate_time_left_and_scalars() -> None:
    assert run([(20.0, 40), (20.0, 80)], total=400) == [
        "  train: 40/400 steps, 2 steps/s, 3 min 00 s left, loss=0.25",
        "  train: 80/400 steps, 2 steps/s, 2 min 40 s left, loss=0.25",
        "  train: 80 steps in 40 s (2 steps/s)",
    ]


def test_the_rate_counts_only_units_of_this_run() -> None:
    assert run([(10.0, 320)], total=400, start=300)[0] == "  train: 320/400 steps, 2 steps/s, 40 s left, loss=0.25"


def test_the_rate_forgets_a_slow_first_step() -> None:
    steady = [(1.0, done) for done in range(2, 2 + int(RATE_WINDOW_SECONDS) + 1)]
    lines = run([(300.0, 1), *steady], total=100)
    assert ", 1 steps/s, " in lines[-2]


def test_no_rate_includes_a_pause_between_quick_units() -> None:
    steady = [(1.0, done) for done in range(1, 101)]
    lines = run([*steady, (60.0, 101), (10.0, 106)], total=206)
    assert lines[-3] == "  train: 101/206 steps, loss=0.25"
    assert lines[-2] == "  train: 106/206 steps, 0.5 steps/s, 3 min 20 s left, loss=0.25"


def test_the_rate_shows_units_that_stay_slow() -> None:
    steady = [(1.0, done) for done in range(1, 101)]
    lines = run([*steady, (60.0, 101), (60.0, 102), (60.0, 103)], total=203)
    assert lines[-3:-1] == [
        f"  train: {done}/203 steps, 0.0167 steps/s, {left} left, loss=0.25"
        for done, left in ((102, "1 h 41 min"), (103, "1 h 40 min"))
    ]


def test_no_rate_includes_the_start_up() -> None:
    lines = run([(12.0, 1), (12.0, 2), (5.0, 12), (5.0, 22)], total=42, settle=2)
    assert lines[:2] == ["  train: 1/42 steps, loss=0.25", "  train: 2/42 steps, loss=0.25"]
    assert lines[2] == "  train: 22/42 steps, 2 steps/s, 10 s left, loss=0.25"


@given(st.lists(st.floats(0.01, 15), min_size=1, max_size=60))
def test_plain_lines_are_at_least_ten_seconds_apart(waits: list[float]) -> None:
    lines = run([(wait, i + 1) for i, wait in enumerate(waits)], total=len(waits))
    due, last, now = 0, 0.0, 0.0
    for wait in waits:
        now += wait
        if now - last >= PLAIN_SECONDS:
            due, last = due + 1, now
    # Sums of floats near the limit may fall on either side of it.
    assert abs(len(lines) - 1 - due) <= 1
    assert len(lines) - 1 <= now / PLAIN_SECONDS + 1e-6


def test_scalars_are_converted_only_when_shown() -> None:
    clock, value = Clock(), Counted()
    with Progress("train", 100, "steps", console=Console(file=io.StringIO()), clock=clock) as progress:
        for done in range(1, 41):
            clock.now += 1.0
            progress.update(done, loss=value)
    assert value.reads == 40 // PLAIN_SECONDS


def test_a_terminal_shows_a_bar_and_ends_with_the_same_summary() -> None:
    lines = run([(20.0, 40)], total=400, terminal=True)
    assert any("40/400 steps, 2 steps/s, 3 min 00 s left, loss=0.25" in line for line in lines)
    assert lines[-1].endswith("  train: 40 steps in 20 s (2 steps/s)")


def test_after_an_error_there_is_no_summary() -> None:
    shown = io.StringIO()
    with pytest.raises(RuntimeError, match="boom"), Progress("train", 4, "steps", console=Console(file=shown)):
        raise RuntimeError("boom")
    assert shown.getvalue() == ""


def test_headlines_and_notes_are_printed_verbatim(capsys: pytest.CaptureFixture[str]) -> None:
    stage(2, 6, "tokenizer", "up to date, skipped")
    note("[bold] is no markup")
    assert capsys.readouterr().out == "[2/6] tokenizer: up to date, skipped\n  note: [bold] is no markup\n"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599.6, "1 h 00 min"), (7625, "2 h 07 min")],
)
def test_duration(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_a_second_rate_counts_the_parts_of_a_unit() -> None:
    shown, clock = io.StringIO(), Clock()
    with Progress("train", 400, "steps", console=Console(file=shown), clock=clock, per_unit=("tokens", 8192)) as bar:
        clock.now += 20.0
        bar.update(40, loss=0.25, rgb=3.0)
    assert shown.getvalue().splitlines() == [
        "  train: 40/400 steps, 2 steps/s, 16.4k tokens/s, 3 min 00 s left, loss=0.25, rgb=3",
        "  train: 40 steps in 20 s (2 steps/s, 16.4k tokens/s)",
    ]


@given(st.floats(1e-3, 1e12))
def test_a_short_number_is_the_number_to_three_digits(number: float) -> None:
    short = _thousands(number)
    factor = {"k": 1e3, "M": 1e6, "G": 1e9}.get(short[-1], 1.0)
    assert float(short.rstrip("kMG")) * factor == pytest.approx(number, rel=0.005)
    assert len(short) <= 5 or number < 1 or number >= 1e12 * 0.9995


def test_a_narrow_terminal_shows_all_scalars_on_a_second_line() -> None:
    shown, clock = io.StringIO(), Clock()
    console = Console(file=shown, force_terminal=True, width=80)
    terms = dict.fromkeys(("loss", "rgb", "depth", "attention", "keypoint"), 0.25)
    with Progress("world model", 400, "steps", 0, console, clock, ("tokens", 8192)) as progress:
        clock.now += 20.0
        progress.update(40, **terms)
    lines = [line for line in shown.getvalue().splitlines() if "loss=" in line]
    assert lines and all("loss=0.25, rgb=0.25, depth=0.25, attention=0.25, keypoint=0.25" in line for line in lines)
