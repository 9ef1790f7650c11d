import itertools
import json

import numpy as np
import pytest

from rsjax.data.loader import Substituting, batches, epoch
from rsjax.data.store import Record, Source, StoreError, open_store, write_store

COUNT = 13


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    path = tmp_path_factory.mktemp("loader") / "set"
    write_store(path, "numbers", {"train": ({"i": np.array(i)} for i in range(COUNT))}, {})
    return open_store(path).source("train")


def jitter(record: Record, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"i": record["i"], "random": rng.random(2)}


def take(loader, count: int) -> dict[str, np.ndarray]:
    rows = list(itertools.islice(loader, count))
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def assert_same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> None:
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name])


def test_every_epoch_is_another_permutation_with_fresh_randomness(source: Source) -> None:
    with batches(source, jitter, COUNT, seed=0) as loader:
        taken = take(loader, 3)
    np.testing.assert_array_equal(np.sort(taken["i"]), np.tile(np.arange(COUNT), (3, 1)))
    assert len({tuple(row) for row in taken["i"]}) == 3
    assert len(np.unique(taken["random"])) == taken["random"].size


def test_resumed_equals_never_stopped(source: Source) -> None:
    with batches(source, jitter, 4, seed=1) as loader:
        take(loader, 5)
        state = json.loads(json.dumps(loader.state()))
        rest = take(loader, 4)
    with batches(source, jitter, 4, seed=1, state=state) as resumed:
        assert_same(take(resumed, 4), rest)
    with batches(source, jitter, 4, seed=2, state=state) as other:
        assert not np.array_equal(take(other, 4)["i"], rest["i"])


def test_workers_change_nothing(source: Source) -> None:
    with batches(source, jitter, 4, seed=1) as loader:
        alone = take(loader, 5)
    with batches(source, jitter, 4, seed=1, workers=2) as loader:
        assert_same(take(loader, 5), alone)


def test_epoch_covers_all_in_order_and_pads_with_weight_0(source: Source) -> None:
    taken = take(epoch(source, 5, jitter), 100)
    np.testing.assert_array_equal(taken["i"].ravel(), [*range(COUNT), COUNT - 1, COUNT - 1])
    np.testing.assert_array_equal(taken["weight"].ravel(), [1] * COUNT + [0, 0])
    assert_same(take(epoch(source, 5, jitter), 100), taken)


class Damaged:
    """Numbered records of which some cannot be read."""

    def __init__(self, count: int, bad: set[int]) -> None:
        self._count, self._bad = count, bad

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Record:
        if index in self._bad:
            raise StoreError(f"shard: record {index} cannot be read")
        return {"i": np.array(index)}


def test_damaged_records_are_replaced_logged_once_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    source = Substituting(Damaged(200, {7, 199}))
    assert [int(source[i]["i"]) for i in (6, 7, 7, 199, 199)] == [6, 8, 8, 0, 0]
    assert ["1 of 200" in caplog.text, "2 of 200" in caplog.text, len(caplog.records)] == [True, True, 2]


def test_too_many_damaged_records_are_an_error() -> None:
    with (
        batches(Damaged(100, {1, 2}), jitter, 100, seed=0) as loader,
        pytest.raises(StoreError, match=r"2 of 100 records are damaged"),
    ):
        next(loader)


def test_epoch_does_not_hide_damage() -> None:
    with pytest.raises(StoreError, match=r"record 1 "):
        list(epoch(Damaged(3, {1}), 2, jitter))


def test_empty_split_is_an_error() -> None:
    with pytest.raises(StoreError, match=r"no records"):
        batches(Damaged(0, set()), jitter, 2, seed=0)
