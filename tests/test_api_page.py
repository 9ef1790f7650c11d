"""Runs the code blocks of docs/api.md in order on an untrained model."""

import re
from pathlib import Path
from typing import Any

import pytest

import rsjax
from rsjax.evaluation import registry
from tests.tools.pipeline import toy

PAGE = Path(__file__).parents[1] / "docs" / "api.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_every_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    store = toy.store(tmp_path / "clips")
    model = toy.trained(store)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rsjax, "load", lambda run: model)
    monkeypatch.setattr(rsjax, "open_store", lambda path: store)
    namespace: dict[str, Any] = {}
    assert len(BLOCKS) >= 5
    try:
        for block in BLOCKS:
            exec(block, namespace)
    finally:
        registry._METRICS.pop("last_frame_error", None)
    frames = model.config.clips.frames
    assert namespace["video"].rgb.shape[0] == namespace["video"].depth.shape[0] == frames
    assert namespace["videos"].rgb.shape[:2] == (2, frames)
    assert namespace["seen"].rgb.shape == namespace["clip"]["rgb"].shape
    assert "actions have shape (6, 3); expected (T, 28) with T above 1" in capsys.readouterr().out
