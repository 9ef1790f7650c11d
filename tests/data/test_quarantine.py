import json
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.loader import MixtureComponent, Readable
from rsjax.data.quarantine import Quarantine, read_quarantine
from rsjax.data.store import StoreError
from tests.data.toy import Numbers, jitter

DAMAGE = StoreError("shard: cannot be read")


def place(record: int, store: str = "here") -> dict[str, object]:
    return {"store": store, "split": "train", "record": record, "file": "shard"}


@given(st.sets(st.integers(0, 19), max_size=19), st.none() | st.permutations(range(20)))
def test_a_damaged_record_is_replaced_by_the_next_of_its_part_that_can_be_read(
    bad: set[int], order: list[int] | None
) -> None:
    chosen = None if order is None else np.array(order[:15])
    numbers = list(range(20)) if order is None else order[:15]
    sound = [number for number in numbers if number not in bad]
    readable = Readable(MixtureComponent(Numbers(20, bad=bad), jitter, chosen), Quarantine(None, 20, 1.0))
    if not sound:
        with pytest.raises(StoreError, match="cannot be read"):
            readable[0]
        return
    for index in range(len(readable)):
        following = (numbers[index:] + numbers)[:20]
        number, record = readable[index]
        assert number == int(record["i"]) == next(n for n in following if n not in bad)


def test_each_is_logged_and_listed_once_and_counted_over_restarts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "stage" / "quarantine.jsonl"
    first = Quarantine(path, 200)
    assert first.count() == 0
    for number in (7, 7, 199):
        first.note(place(number), DAMAGE)
    again = Quarantine(path, 200)
    for number in (199, 7):
        again.note(place(number), DAMAGE)
    assert first.count() == again.count() == 2
    assert read_quarantine(path) == [place(n) | {"error": "shard: cannot be read"} for n in (7, 199)]
    assert [json.loads(line)["record"] for line in path.read_text().splitlines()] == [7, 199]
    assert ["1 of 200" in caplog.text, "2 of 200" in caplog.text, len(caplog.records)] == [True, True, 2]


def test_a_run_that_is_moved_with_its_store_counts_a_record_once_but_that_of_another_store_too(tmp_path: Path) -> None:
    for home in (tmp_path / "before", tmp_path / "after"):
        home.mkdir(exist_ok=True)
        quarantine = Quarantine(home / "stage" / "list.jsonl", 200)
        quarantine.note(place(1, str(home / "store")), DAMAGE)
        assert quarantine.count() == 1
        if home.name == "before":
            home.rename(tmp_path / "after")
    quarantine.note(place(1, "there"), DAMAGE)
    assert quarantine.count() == 2


def test_many_at_once_lose_and_repeat_nothing(tmp_path: Path) -> None:
    path = tmp_path / "quarantine.jsonl"

    def note(numbers: list[int]) -> None:
        mine = Quarantine(path, 100, 1.0)  # as in a process of its own: the lock is that of each opened file
        for number in numbers:
            mine.note(place(number), DAMAGE)

    logging.disable()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(note, [np.random.default_rng(i).permutation(25).tolist() for i in range(8)]))
    logging.disable(logging.NOTSET)
    assert sorted(json.loads(line)["record"] for line in path.read_text().splitlines()) == list(range(25))


@pytest.mark.parametrize(("share", "most"), [(0.01, 1), (0.05, 5), (0.0, 0)])
def test_more_than_the_share_is_an_error_also_after_a_restart(share: float, most: int, tmp_path: Path) -> None:
    path = tmp_path / "quarantine.jsonl"
    quarantine = Quarantine(path, 100, share)
    for number in range(most):
        quarantine.note(place(number), DAMAGE)
    for one in (quarantine, Quarantine(path, 100, share)):
        with pytest.raises(StoreError, match=rf"{most + 1} of 100 .* at most {most}: max_damaged; {path} lists them"):
            one.note(place(most), DAMAGE)


def test_half_a_line_of_a_killed_process_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "quarantine.jsonl"
    quarantine = Quarantine(path, 1000)
    quarantine.note(place(1), DAMAGE)
    with path.open("a") as file:
        file.write('{"store": "here", "sp')
    assert quarantine.count() == 1
    quarantine.note(place(2), DAMAGE)
    assert [row["record"] for row in read_quarantine(path)] == [1, 2]
