import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import pytest

from rsjax.config import ComponentConfig, Config, CurriculumStageConfig, from_dict, presets
from rsjax.data.store import write_store
from rsjax.files import FileError
from rsjax.tools.pipeline import provenance
from rsjax.tools.pipeline.provenance import (
    NAME,
    code_version,
    data_fingerprints,
    read_starts,
    record_data,
    record_start,
)
from rsjax.tools.pipeline.run import Run

DEBUG = presets.debug()
CODE = {"version": "0", "revision": "a" * 40, "dirty": False, "diff_sha256": None}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setattr(provenance, "code_version", lambda root: CODE)
    directory = tmp_path / "run"
    directory.mkdir()
    return Run(DEBUG, directory, tmp_path / "data")


def test_a_start_holds_all_that_made_the_run(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    jax.devices()  # which reads the flags, and would not take this one
    monkeypatch.setenv("XLA_FLAGS", "--some_flag")
    monkeypatch.setenv("WANDB_API_KEY", "secret")
    assert record_start(run, "train debug") == []
    (start,) = read_starts(run.directory)
    assert from_dict(Config, start["config"]) == DEBUG
    assert start["keys"] == run.keys() and start["command"] == "train debug" and start["code"] == CODE
    assert start["packages"]["jax"] == jax.__version__
    assert (start["machine"]["processes"], start["machine"]["devices"]) == (1, jax.device_count())
    assert start["machine"]["environment"]["XLA_FLAGS"] == "--some_flag"
    assert "secret" not in (run.directory / NAME).read_text()


def test_every_start_is_recorded_in_full(run: Run) -> None:
    for seed in (0, 1, 1):
        record_start(replace(run, config=replace(DEBUG, train=replace(DEBUG.train, seed=seed))), f"seed {seed}")
    starts = read_starts(run.directory)
    assert [start["config"]["train"]["seed"] for start in starts] == [0, 1, 1]
    assert [start["command"] for start in starts] == ["seed 0", "seed 1", "seed 1"]
    assert all(start.keys() == starts[0].keys() for start in starts)


@pytest.mark.parametrize(("name", "value"), [("code", CODE | {"dirty": True}), ("packages", {"jax": "0"})])
def test_what_may_change_results_is_reported_at_the_next_start_and_not_after(
    run: Run, monkeypatch: pytest.MonkeyPatch, name: str, value: Any
) -> None:
    record_start(run, "train")
    if name == "code":
        monkeypatch.setattr(provenance, "code_version", lambda root: value)
    else:
        older = [type("Distribution", (), {"metadata": {"Name": k, "Version": v}})() for k, v in value.items()]
        monkeypatch.setattr(provenance.importlib.metadata, "distributions", lambda: older)
    assert record_start(run, "train") == [name]
    assert record_start(run, "train") == []


def store(path: Path, count: int = 2, key: str = "k") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_store(path, "tokens", {"train": ({"x": i} for i in range(count)), "test": iter([{"x": 0}])}, {"key": key})


def test_data_are_known_by_key_counts_and_bytes_and_every_change_of_them_shows(run: Run) -> None:
    elsewhere = run.data_directory / "other"
    stages = (CurriculumStageConfig((ComponentConfig(), ComponentConfig(store=str(elsewhere)))),)
    run = replace(run, config=replace(DEBUG, train=replace(DEBUG.train, curriculum=stages)))
    assert data_fingerprints(run) == {}
    for path in (run.clips, run.output("tokens"), elsewhere):
        store(path)
    found = data_fingerprints(run)
    assert set(found) == {"clips", "tokens", str(elsewhere)}
    splits = found["clips"]["splits"]
    size = sum(path.stat().st_size for path in run.clips.glob("train-*"))
    assert splits["train"] == {"count": 2, "bytes": size} and splits["test"]["count"] == 1
    assert found["clips"]["key"] == "k"
    seen = [found["clips"]]
    for count, key in ((3, "k"), (2, "l")):
        store(run.clips, count, key)
        seen.append(data_fingerprints(run)["clips"])
    assert len({fingerprint["manifest_sha256"] for fingerprint in seen}) == 3


def test_data_that_a_start_makes_complete_it_and_are_no_change_at_the_next(run: Run) -> None:
    record_start(run, "train")
    store(run.clips)
    record_data(run)
    (start,) = read_starts(run.directory)
    assert start["data"].keys() == {"clips"}
    store(run.output("tokens"))
    assert record_start(run, "train") == []
    store(run.output("tokens"), key="another")
    assert record_start(run, "train") == ["data"]


def test_data_that_were_moved_are_no_change(run: Run) -> None:
    store(run.clips)
    record_start(run, "train")
    moved = replace(run, data_directory=run.data_directory.with_name("moved"))
    moved.clips.parent.mkdir(parents=True)
    run.clips.rename(moved.clips)
    assert record_start(moved, "train") == []
    before, now = (start["data"]["clips"]["path"] for start in read_starts(run.directory))
    assert before != now


def test_a_damaged_file_is_named(run: Run) -> None:
    (run.directory / NAME).write_text("[")
    with pytest.raises(FileError, match=r"run.json: not JSON .* delete it"):
        record_start(run, "train")


def test_the_revision_is_the_checkouts_own_and_changes_of_it_show(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        line = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e", *arguments]
        return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()

    inside = tmp_path / "environment"
    inside.mkdir()
    assert code_version(tmp_path)["revision"] is None
    git("init")
    (tmp_path / "code.py").write_text("1")
    git("add", ".")
    git("commit", "-m", "one")
    clean = code_version(tmp_path)
    assert (clean["revision"], clean["dirty"], clean["diff_sha256"]) == (git("rev-parse", "HEAD"), False, None)
    hashes = set()
    for text in (b"2", b"3", b"caf\xe9"):  # the last in Latin-1
        (tmp_path / "code.py").write_bytes(text)
        changed = code_version(tmp_path)
        assert changed["revision"] == clean["revision"] and changed["dirty"]
        hashes.add(changed["diff_sha256"])
    assert len(hashes) == 3
    assert code_version(inside)["revision"] is None, "a package inside somebody's checkout is not that checkout"
