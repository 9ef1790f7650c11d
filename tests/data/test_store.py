import errno
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.data import store as store_module
from rsjax.data.store import (
    MANIFEST,
    Record,
    StoreError,
    complete_key,
    decode,
    encode,
    open_store,
    write_store,
)
from rsjax.files import FileError

ARRAYS = hnp.arrays(
    st.sampled_from([np.uint8, np.int32, np.float32, np.float64, np.bool_]), hnp.array_shapes(min_dims=0, min_side=0)
)
VALUES = st.text() | st.integers(-(2**60), 2**60) | st.dictionaries(st.text(), st.lists(st.floats(allow_nan=False)))


def assert_same(left: Record, right: Record) -> None:
    assert left.keys() == right.keys()
    for name, value in left.items():
        if isinstance(value, np.ndarray):
            assert right[name].dtype == value.dtype
            assert right[name].shape == value.shape
            np.testing.assert_array_equal(right[name], value)
        else:
            assert right[name] == value


@given(st.dictionaries(st.text(), ARRAYS | VALUES))
def test_record_round_trip(record: Record) -> None:
    assert_same(record, decode(encode(record)))


@given(st.data())
def test_any_changed_byte_is_noticed(data: st.DataObject) -> None:
    payload = bytearray(encode({"x": np.arange(5), "name": "word"}))
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(ValueError, match=r"checksum"):
        decode(bytes(payload))


def numbered(count: int, start: int = 0) -> Iterator[Record]:
    rng = np.random.default_rng(0)
    for i in range(start, start + count):
        yield {"i": np.array(i), "noise": rng.integers(0, 255, 5000, np.uint8), "name": f"record {i}"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_store(tmp_path / "set", "numbers", {"train": numbered(7), "test": numbered(2, 100)}, {"key": "abc", "x": 1})
    return tmp_path / "set"


def test_store_round_trip(path: Path) -> None:
    store = open_store(path)
    assert store.manifest["kind"] == "numbers"
    assert store.manifest["x"] == 1
    assert complete_key(path) == "abc"
    assert store.splits == ("train", "test")
    assert [int(store.source("train")[i]["i"]) for i in (6, 0, 3)] == [6, 0, 3]
    test = pickle.loads(pickle.dumps(store.source("test")))
    assert len(test) == 2
    assert test[1]["name"] == "record 101"
    with pytest.raises(IndexError):
        test[2]
    with pytest.raises(StoreError, match=r"'val'.*train, test"):
        store.source("val")


@settings(max_examples=5)
@given(st.integers(1, 30_000))
def test_shards_change_nothing(tmp_path_factory: pytest.TempPathFactory, shard_bytes: int) -> None:
    path = tmp_path_factory.mktemp("shards") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "SHARD_BYTES", shard_bytes)
        write_store(path, "numbers", {"train": numbered(6)}, {})
    source = open_store(path).source("train")
    assert len(source) == 6
    for i, record in enumerate(numbered(6)):
        assert_same(record, source[i])


def test_damaged_record_is_named_on_reading(path: Path) -> None:
    shard = path / "train-00000.array_record"
    damaged = bytearray(shard.read_bytes())
    needle = next(r["noise"].tobytes()[100:140] for r in list(numbered(7))[3:])
    place = damaged.find(needle)
    assert place > 0
    damaged[place] ^= 255
    shard.write_bytes(bytes(damaged))
    source = open_store(path).source("train")
    assert source[2]["name"] == "record 2"
    assert source[4]["name"] == "record 4"
    with pytest.raises(StoreError, match=f"{shard}: record 3 .*make it again"):
        source[3]


def test_full_disk_leaves_the_old_store(path: Path) -> None:
    def records() -> Iterator[Record]:
        yield from numbered(2)
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(FileError, match=r"disk is full"):
        write_store(path, "numbers", {"train": records()}, {"key": "new"})
    assert complete_key(path) == "abc"
    assert [p.name for p in path.parent.iterdir()] == ["set"]


def test_replaces_a_store_but_nothing_else(path: Path, tmp_path: Path) -> None:
    write_store(path, "numbers", {"train": numbered(1)}, {"key": "new"})
    assert complete_key(path) == "new"
    assert not (path / "test-00000.array_record").exists()
    (tmp_path / "mine").mkdir()
    with pytest.raises(StoreError, match=r"not a store"):
        write_store(tmp_path / "mine", "numbers", {"train": numbered(1)}, {})


@given(st.lists(st.tuples(st.text(), st.sampled_from("ab")), max_size=20))
def test_labels_are_those_of_the_records_in_their_order(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    path = tmp_path_factory.mktemp("labels") / "set"
    records = [{"i": np.array(i), "one": one, "two": two} for i, (one, two) in enumerate(rows)]
    write_store(path, "numbers", {"train": records}, {}, lambda r: {"one": r["one"], "two": r["two"]})
    store = open_store(path)
    assert len(store.source("train")) == len(rows)
    assert store.labelled("train") == bool(rows)
    if not rows:
        return
    labels = store.labels("train")
    for column, name in enumerate(("one", "two")):
        words = [labels.words[name][code] for code in labels.codes[name]]
        assert words == [row[column] for row in rows]
        assert sum(labels.counts()[name].values()) == len(rows)


def test_damaged_labels_are_named(tmp_path: Path) -> None:
    write_store(tmp_path / "set", "numbers", {"train": numbered(3)}, {}, lambda r: {"name": r["name"]})
    file = tmp_path / "set" / "train-labels.npy"
    payload = bytearray(file.read_bytes())
    payload[-1] ^= 1
    file.write_bytes(payload)
    with pytest.raises(StoreError, match=f"{file}: cannot be read .*make it again"):
        open_store(tmp_path / "set").labels("train")


def test_a_reader_that_went_stale_is_opened_again(path: Path) -> None:
    class Stale:
        def __getitem__(self, index: int) -> bytes:
            raise RuntimeError("stale file handle")

    source = open_store(path).source("train")
    source._reader = Stale()
    assert source[3]["name"] == "record 3"


@pytest.mark.parametrize("manifest", [None, "not JSON", '{"name": "my web page"}'])
def test_only_what_holds_shards_is_to_be_deleted(path: Path, tmp_path: Path, manifest: str | None) -> None:
    theirs = tmp_path / "recordings"
    theirs.mkdir()
    (theirs / "video.mp4").touch()
    for place in (path, theirs):
        (place / MANIFEST).unlink(missing_ok=True)
        if manifest is not None:
            (place / MANIFEST).write_text(manifest)
    with pytest.raises(StoreError, match=f"delete {path} and make it again"):
        open_store(path)
    with pytest.raises(StoreError, match=r"; give a store, or make one with rsjax ingest") as caught:
        open_store(theirs)
    assert "delete" not in str(caught.value)
    for place, line in ((theirs / "nowhere", "nowhere: not there"), (theirs / "video.mp4", "video.mp4: no store")):
        with pytest.raises(StoreError, match=line):
            open_store(place)
    if manifest is None:
        assert f"{theirs}: no store (it has no manifest.json)" in str(caught.value)


def test_what_is_no_split_and_no_number_of_a_record_is_refused(path: Path) -> None:
    store = open_store(path)
    for split in (None, 3, ["train"], "val"):
        with pytest.raises(StoreError) as raised:
            store.source(split)  # type: ignore[arg-type]
        assert "no split" in str(raised.value)
    source = store.source(store.splits[0])
    for number in (None, 1.5, "0", True, [0]):
        with pytest.raises(StoreError) as raised:
            source[number]  # type: ignore[index]
        assert "records are numbered from 0" in str(raised.value)
    with pytest.raises(IndexError):
        source[10**400]
