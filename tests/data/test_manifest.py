import errno
import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.data.store import MANIFEST, StoreError, open_store
from tests.data.clips import clip_store, numbers


@pytest.fixture
def path(tmp_path: Path) -> Path:
    clip_store(tmp_path / "a", 0, 2)
    return tmp_path / "a"


def change(path: Path, value: Any, *keys: str | int) -> None:
    manifest = json.loads((path / MANIFEST).read_text())
    place = manifest
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    (path / MANIFEST).write_text(json.dumps(manifest))


@pytest.mark.parametrize("name", ["../b/train-00000.array_record", "/etc/passwd", "..", "", "a\\b", "x\0y", 3, None])
def test_a_name_that_leads_elsewhere_is_refused(path: Path, name: Any) -> None:
    for keys in (("files", 0), ("labels",)):
        change(path, name, "splits", "train", *keys, "name")
        with pytest.raises(StoreError, match=r"splits.train.*name is .*not a file beside it"):
            open_store(path)


@pytest.mark.parametrize("value", [-1, 2**60, "7", 1.5, None])
def test_impossible_sizes_are_refused(path: Path, value: Any) -> None:
    for field in ("bytes", "count"):
        change(path, value, "splits", "train", "files", 0, field)
        with pytest.raises(StoreError, match=r"splits.train.files.0"):
            open_store(path)


@settings(max_examples=30)
@given(st.recursive(st.none() | st.integers() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)))
def test_any_manifest_is_one_clear_line(tmp_path_factory: pytest.TempPathFactory, manifest: Any) -> None:
    path = tmp_path_factory.mktemp("store")
    for content in (manifest, {"format": 1, "splits": manifest}, {"format": 1, "splits": {"train": manifest}}):
        (path / MANIFEST).write_text(json.dumps(content))
        if not _opened(path):
            with pytest.raises(StoreError, match=MANIFEST):
                open_store(path)


def _opened(path: Path) -> bool:
    """Whether it is a store after all: one without splits, or with empty ones."""
    try:
        open_store(path)
    except StoreError:
        return False
    return True


def test_a_loop_of_links_is_reported(path: Path) -> None:
    (path / MANIFEST).rename(path / "real")
    (path / MANIFEST).symlink_to(MANIFEST)
    with pytest.raises(StoreError, match=r"manifest.json: cannot be read \(Too many levels of symbolic links\)"):
        open_store(path)


def test_bytes_that_are_no_text_are_reported(path: Path) -> None:
    (path / MANIFEST).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StoreError, match=r"not JSON"):
        open_store(path)


def test_a_missing_permission_is_reported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "read_bytes", refuse)  # root, who may run the tests, may read everything
    with pytest.raises(StoreError, match=r"manifest.json: cannot be read \(Permission denied\)"):
        open_store(path)


def test_a_good_store_is_opened(path: Path) -> None:
    assert numbers(open_store(path)) == [0, 1]


@pytest.mark.parametrize("split", ["../elsewhere", "/tmp/x", "..", ""])
def test_a_split_that_leads_elsewhere_is_refused(path: Path, split: str) -> None:
    change(path, {"files": []}, "splits", split)
    with pytest.raises(StoreError, match=r"manifest.json: splits has .* cannot be the name of a file"):
        open_store(path)


def test_a_shard_that_is_a_loop_of_links_is_reported(path: Path) -> None:
    shard = path / "train-00000.array_record"
    shard.unlink()
    shard.symlink_to(shard)
    with pytest.raises(StoreError, match=r"train-00000.array_record: cannot be read \(Too many levels of symbolic"):
        open_store(path)


def test_a_manifest_of_nothing_but_brackets_is_reported(path: Path) -> None:
    (path / MANIFEST).write_text("[" * 100_000)
    with pytest.raises(StoreError, match=r"manifest.json: not JSON"):
        open_store(path)


@pytest.mark.parametrize("field", ["episodes", "counts", "filtered", "quarantine", "action_mean", "action_std"])
def test_what_others_rely_on_has_its_kind(path: Path, field: str) -> None:
    change(path, "of another kind", field)
    with pytest.raises(StoreError, match=rf"manifest.json: {field} is missing or not what it should be"):
        open_store(path)


def test_more_records_than_bytes_are_refused(path: Path) -> None:
    change(path, 10**13, "splits", "train", "files", 0, "count")
    with pytest.raises(StoreError, match=r"splits.train.files.0.count is 10000000000000, more than its \d+ bytes"):
        open_store(path)
