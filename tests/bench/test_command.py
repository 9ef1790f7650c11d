import json
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from experiments import bench as command


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
    assert numbers["preset"] == "debug" and numbers["batch"] == 3
    shown = capsys.readouterr().out
    assert all(name in shown for name in numbers)


def test_errors_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="2"):
        call(monkeypatch, "debug", "--only", "loadr")
    assert capsys.readouterr().err.startswith("error: --only has no part 'loadr'; did you mean 'loader'")
