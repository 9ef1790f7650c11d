import gzip
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rsjax.training import log as memory
from rsjax.training.log import GIB, memory_scalars
from rsjax.training.profile import SKIPPED, Profile


class Recorder:
    """jax.profiler, recording which steps ran while a trace did."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, directory: Path) -> None:
        self.running, self.traced, self.starts = False, list[int](), 0
        monkeypatch.setattr(jax.profiler, "start_trace", self.start)
        monkeypatch.setattr(jax.profiler, "stop_trace", self.stop)
        (directory / "perfetto_trace.json.gz").touch()

    def start(self, *_: Any, **__: Any) -> None:
        assert not self.running
        self.running, self.starts = True, self.starts + 1

    def stop(self) -> None:
        assert self.running
        self.running = False

    def run(self, profile: Profile, first: int, last: int, fails_at: int | None = None) -> None:
        with profile:
            for step in range(first, last + 1):
                profile.at(step)
                if step == fails_at:
                    raise RuntimeError("boom")
                if self.running:
                    self.traced.append(step)


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    return Recorder(monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("start", "last", "count", "traced"),
    [
        (0, 20, 3, [SKIPPED + 1, SKIPPED + 2, SKIPPED + 3]),
        (100, 120, 2, [101 + SKIPPED, 102 + SKIPPED]),
        (0, 4, 3, [2, 3, 4]),  # a short run is traced to its end
        (0, 2, 5, [1, 2]),
        (0, 20, 0, []),
    ],
)
def test_count_steps_are_traced_after_the_first_ones(
    recorder: Recorder, tmp_path: Path, start: int, last: int, count: int, traced: list[int]
) -> None:
    recorder.run(Profile.after(tmp_path, start, last, count), start + 1, last)
    assert recorder.traced == traced
    assert not recorder.running
    assert recorder.starts == bool(traced)


def test_a_training_without_steps_has_no_trace(recorder: Recorder, tmp_path: Path) -> None:
    profile = Profile.after(tmp_path, 20, 20, 3)
    with profile:
        profile.at(21)
    assert recorder.starts == 0


def test_an_error_passes_and_ends_the_trace(recorder: Recorder, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="boom"):
        recorder.run(Profile(tmp_path, 2, 5), 1, 9, fails_at=4)
    assert recorder.traced == [2, 3]
    assert not recorder.running


def test_an_error_of_the_trace_does_not_hide_the_one_under_way(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jax.profiler, "stop_trace", full)
    with pytest.raises(RuntimeError, match="boom"):
        recorder.run(Profile(tmp_path, 2, 5), 1, 9, fails_at=4)


def test_only_the_lead_process_traces(recorder: Recorder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    recorder.run(Profile(tmp_path, 2, 5), 1, 9)
    assert not recorder.starts


def test_a_real_trace_has_the_requested_steps_and_its_path_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    step_fn, x = jax.jit(lambda x: jnp.sin(x @ x)), jnp.ones((8, 8))
    with Profile(tmp_path / "profile", 2, 2) as profile:
        for step in range(1, 6):
            profile.at(step, x)
            with jax.profiler.StepTraceAnnotation("train", step_num=step):
                x = step_fn(x)
    (path,) = tmp_path.rglob("perfetto_trace.json.gz")
    printed = capsys.readouterr().out
    assert str(path) in printed and "https://ui.perfetto.dev" in printed
    events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    named = [event for event in events if event.get("name") == "train"]
    assert {int(event["args"]["step_num"]) for event in named} == {2, 3}


def test_memory_is_that_of_the_fullest_device(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = [
        SimpleNamespace(memory_stats=lambda n=n: {"bytes_in_use": n * 2**29, "peak_bytes_in_use": n * 2**30})
        for n in (1, 3, 2)
    ]
    monkeypatch.setattr(memory.jax, "local_devices", lambda: devices)
    assert memory_scalars().items() >= {"device_gib": 1.5, "device_peak_gib": 3.0}.items()


def test_memory_of_a_device_without_counts_is_the_process_and_grows_by_an_allocation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory.jax, "local_devices", lambda: [SimpleNamespace(memory_stats=lambda: None)])
    before = memory_scalars()
    taken = bytearray(b"x") * 2**27
    after = memory_scalars()
    assert after["device_gib"] == after["host_gib"] <= after["device_peak_gib"]
    assert after["host_gib"] - before["host_gib"] == pytest.approx(len(taken) / GIB, rel=0.2)
