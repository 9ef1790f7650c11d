import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.data.store import MANIFEST, StoreError, complete_key, open_store
from tests.data.clips import clip_store

Damage = Callable[[Path], object]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    clip_store(tmp_path / "a", 0, 2)
    return tmp_path / "a"


def changed(value: Any, *keys: str | int) -> Damage:
    """Puts a value into the manifest."""

    def damage(path: Path) -> None:
        manifest = json.loads((path / MANIFEST).read_text())
        place = manifest
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        (path / MANIFEST).write_text(json.dumps(manifest))

    return damage


def written(content: bytes | None, name: str = MANIFEST) -> Damage:
    """Writes a file of the store anew, or deletes it."""
    return lambda path: (path / name).unlink() if content is None else (path / name).write_bytes(content)


def looped(name: str) -> Damage:
    """Puts a link to itself in place of a file."""

    def damage(path: Path) -> None:
        (path / name).unlink()
        (path / name).symlink_to(name)

    return damage


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


SHARD = "train-00000.array_record"
FILE = ("splits", "train", "files", 0)
DAMAGES: list[tuple[Damage, str]] = [
    *(
        (changed(name, "splits", "train", *keys, "name"), r"splits.train.*name is .*not a file beside it")
        for name in ("../b/train-00000.array_record", "/etc/passwd", "..", "", "a\\b", "x\0y", 3, None)
        for keys in (("files", 0), ("labels",))
    ),
    *(
        (changed({"files": []}, "splits", split), r"manifest.json: splits has .* cannot be the name of a file")
        for split in ("../elsewhere", "/tmp/x", "..", "")
    ),
    *(
        (changed(value, *FILE, field), r"splits.train.files.0")
        for value in (-1, 2**60, "7", 1.5, None)
        for field in ("bytes", "count")
    ),
    (changed(10**13, *FILE, "count"), r"files.0.count is 10000000000000, more than its \d+ bytes"),
    *(
        (changed("of another kind", field), rf"manifest.json: {field} is missing or not what it should be")
        for field in ("episodes", "counts", "filtered", "quarantine", "action_mean", "action_std")
    ),
    (changed(99, "format"), "format 99"),
    (written(b"{"), "manifest.json: not JSON"),
    (written(b"\xff\xfe\x00"), "not JSON"),
    (written(b"[" * 100_000), "manifest.json: not JSON"),
    (looped(MANIFEST), r"manifest.json: cannot be read \(Too many levels of symbolic links\)"),
    (written(None, SHARD), f"{SHARD}: missing"),
    (written(b"short", SHARD), f"{SHARD}.*should be.*make it again"),
    (looped(SHARD), rf"{SHARD}: cannot be read \(Too many levels of symbolic"),
    (written(None, "train-labels.npy"), "train-labels.npy: missing"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_damage_is_named_on_opening(path: Path, damage: Damage, message: str) -> None:
    damage(path)
    with pytest.raises(StoreError, match=message):
        open_store(path)
    assert complete_key(path) is None


def test_a_missing_permission_is_reported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "read_bytes", refuse)  # root, who may run the tests, may read everything
    with pytest.raises(StoreError, match=r"manifest.json: cannot be read \(Permission denied\)"):
        open_store(path)
