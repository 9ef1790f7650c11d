import json
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from rsjax.tools.bench import parts
from rsjax.tools.commands import bench as command


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command neither restarts the process nor leaves jax configured otherwise."""
    monkeypatch.setattr(command, "tune_process", lambda: None)
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    command.main()


def test_writes_what_it_shows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "new" / "bench.json"
    call(monkeypatch, "debug", "--only", "loader", "--json", str(out), "--train.batch-size", "3")
    numbers: dict[str, Any] = json.loads(out.read_text())
    assert numbers["preset"] == "debug" and numbers["batch"] == 1 and numbers["loader_clips_per_s"] > 0
    assert not [name for name in numbers if name.startswith(("train_", "sample_", "tokenizer_", "matmul_"))]
    shown = capsys.readouterr().out
    assert all(name in shown for name in numbers)


def test_what_was_measured_outlives_a_part_that_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(parts, "train", lambda *_: {"train_step_s": 2.0, "train_flops": 30.0})
    monkeypatch.setattr(parts, "matmul", lambda *_: {"matmul_ceiling_flops": 40.0})
    monkeypatch.setattr(parts, "sample", full)
    out = tmp_path / "bench.json"
    with pytest.raises(MemoryError):
        call(monkeypatch, "debug", "--only", "matmul,train,sample", "--json", str(out))
    numbers = json.loads(out.read_text())
    assert numbers["train_step_s"] == 2.0 and numbers["train_share_of_ceiling"] == 0.75
    assert numbers["peak_memory_bytes"] >= numbers["train_peak_memory_bytes"] > 0


def test_errors_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="2"):
        call(monkeypatch, "debug", "--only", "loadr")
    assert capsys.readouterr().err.startswith("error: --only has no part 'loadr'; did you mean 'loader'")


def test_torch_needs_the_folder_of_rivals_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setattr(command, "__file__", str(tmp_path / "rsjax" / "tools" / "commands" / "bench.py"))
    with pytest.raises(SystemExit, match="2"):
        call(monkeypatch, "debug", "--torch")
    assert "--torch needs the folder benchmarks/ of a checkout" in capsys.readouterr().err
