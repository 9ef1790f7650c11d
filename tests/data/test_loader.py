import json
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import grain
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.data.loader import CurriculumStage, Loader, MixtureComponent, batches, ordered
from rsjax.data.quarantine import Quarantine
from rsjax.data.store import Source, StoreError
from tests.data import toy
from tests.data.toy import Numbers, assert_same, jitter, take
from tests.waiting import wait_until

COUNT = 13
UNLISTED = Quarantine(None, 1, 0.0)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    return toy.store(tmp_path_factory.mktemp("loader") / "set", COUNT).source("train")


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


@st.composite
def curricula(draw: st.DrawFn) -> tuple[list[CurriculumStage], int]:
    """Stages of one to three parts, each part with records of its own, and a batch size that fits two processes."""
    batch_size, stages, first = 2 * draw(st.integers(1, 3)), [], 0
    for _ in range(draw(st.integers(1, 3))):
        parts = []
        for _ in range(draw(st.integers(1, 3))):
            size, weight = draw(st.integers(1, 7)), draw(st.sampled_from([0.5, 1.0, 2.5]))
            chosen = draw(st.none() | st.lists(st.integers(0, size - 1), min_size=1, unique=True).map(np.array))
            parts.append(MixtureComponent(Numbers(size, first), jitter, chosen, weight))
            first += size
        stages.append(CurriculumStage(tuple(parts), batch_size * draw(st.integers(1, 4))))
    return stages, batch_size


def loader(stages: list[CurriculumStage], size: int, place: int = 0, shard: tuple[int, int] = (0, 1)) -> Loader:
    options = grain.sharding.ShardOptions(*shard)
    state = {"global_next_index": place * size}
    return Loader(stages, size, 3, UNLISTED, shard=options, state=state)


@settings(max_examples=8)
@given(curricula(), st.data())
def test_a_curriculum_resumes_at_any_batch_and_is_the_same_dealt_out_to_two(
    curriculum: tuple[list[CurriculumStage], int], data: st.DataObject
) -> None:
    stages, size = curriculum
    total = sum(stage.records for stage in stages) // size + 2  # the last stage goes on
    cut = data.draw(st.integers(0, total - 1))
    with loader(stages, size) as whole, loader(stages, size, cut) as resumed:
        all_batches = take(whole, total)
        assert whole.state() == {"global_next_index": total * size}
        rest = take(resumed, total - cut)
    assert_same(rest, {name: rows[cut:] for name, rows in all_batches.items()})
    with loader(stages, size, cut, (0, 2)) as even, loader(stages, size, cut, (1, 2)) as odd:
        halves = take(even, total - cut), take(odd, total - cut)
    for name, rows in rest.items():
        np.testing.assert_array_equal(rows[:, ::2], halves[0][name])
        np.testing.assert_array_equal(rows[:, 1::2], halves[1][name])
    assert (rest["index"] == np.arange(size)).all()


@settings(max_examples=8)
@given(curricula())
def test_a_stage_draws_from_its_parts_alone_by_their_weights_and_evenly(
    curriculum: tuple[list[CurriculumStage], int],
) -> None:
    stages, size = curriculum
    with loader(stages, size) as whole:
        rows = take(whole, sum(stage.records for stage in stages) // size)
    parts, records = rows["part"].ravel(), rows["record"].ravel()
    first_part = begin = 0
    for stage in stages:
        drawn = slice(begin, begin + stage.records)
        weights = sum(part.weight for part in stage.components)
        for number, part in enumerate(stage.components, first_part):
            of_part = records[drawn][parts[drawn] == number]
            share = stage.records * part.weight / weights  # dealt out part by part, each from what the last one left
            assert abs(len(of_part) - share) < len(stage.components) + 0.01 * stage.records
            allowed = np.arange(len(part)) if part.chosen is None else part.chosen
            times = [int(np.sum(of_part == record)) for record in allowed]
            assert sum(times) == len(of_part) and max(times) - min(times) <= 1, "some come more often than others"
        assert ((parts[drawn] >= first_part) & (parts[drawn] < first_part + len(stage.components))).all()
        begin, first_part = begin + stage.records, first_part + len(stage.components)


def test_one_stage_of_one_part_is_the_loader_without_stages_and_cut_as_grain_cuts() -> None:
    stage = CurriculumStage((MixtureComponent(Numbers(7), jitter),), 8)
    with Loader([stage], 4, 5, UNLISTED) as staged, batches(Numbers(7), jitter, 4, seed=5) as plain:
        taken = take(staged, 6)
        assert_same(taken, take(plain, 6))
    elastic = grain.experimental.ElasticIterator(ordered([stage], 5, UNLISTED), 4, grain.sharding.NoSharding())
    index = np.tile(np.arange(4, dtype=np.int32), (6, 1))
    assert_same(taken, take(elastic, 6) | {"index": index})
    elastic.close()


def test_a_batch_that_processes_cannot_share_is_refused() -> None:
    with pytest.raises(ConfigError, match="batch_size 3 does not divide over 2 processes"):
        batches(Numbers(7), jitter, 3, seed=0, shard=grain.sharding.ShardOptions(0, 2))


def test_clips_are_named_by_store_and_record_with_where_they_come_from(source: Source) -> None:
    with batches(source, jitter, 3, seed=0) as loader, batches(Numbers(COUNT), jitter, 3, seed=0) as unnamed:
        arrays, other = next(loader), next(unnamed)
        named = json.loads(json.dumps(loader.identify(arrays)))
        assert unnamed.identify(other) == [{"record": int(i)} for i in other["i"]]
    for number, row in zip(arrays["i"].tolist(), named, strict=True):
        assert source[row["record"]]["i"] == number
        assert row | {"store": ""} == {
            "store": "",
            "split": "train",
            "record": number,
            "file": "train-00000.array_record",
            "task": toy.record(number)["task"],
            "provenance": {"episode": number},
        }
        assert Path(row["store"]).name == "set"


def test_processes_change_nothing_whether_stopped_or_killed(tmp_path: Path) -> None:
    """Two worker processes over a stage's border, a mixture and a damaged record."""
    one, other = toy.store(tmp_path / "one", 5), toy.store(tmp_path / "other", 6, first=100)
    toy.damage(tmp_path / "one", 3)
    whole, chosen = (
        MixtureComponent(one.source("train"), jitter),
        MixtureComponent(other.source("train"), jitter, np.array([1, 4])),
    )
    stages = [CurriculumStage((whole, chosen), 16), CurriculumStage((chosen,), 8)]
    listed = Quarantine(tmp_path / "quarantine.jsonl", 11)
    with Loader(stages, 4, 1, Quarantine(None, 11)) as alone:
        expected = take(alone, 9)
    assert 3 not in expected["i"]
    with Loader(stages, 4, 1, listed, workers=2) as loader:
        first = [next(loader) for _ in range(2)]  # then both are under way
        workers = multiprocessing.active_children()
        assert len(workers) == 2
        for worker in workers:
            os.kill(worker.pid or 0, signal.SIGTERM)  # as schedulers send it to every process; it is the main one's
        first += [next(loader) for _ in range(2)]
        assert all(worker.is_alive() for worker in workers)
        os.kill(workers[0].pid or 0, signal.SIGKILL)
        first += [next(loader) for _ in range(5)]
        assert loader.quarantined() == 1
    assert_same({name: np.stack([row[name] for row in first]) for name in first[0]}, expected)
    assert len((tmp_path / "quarantine.jsonl").read_text().splitlines()) == 1


ORPHAN = """
import multiprocessing, time
from rsjax.data.loader import batches
from tests.data.toy import Numbers, jitter
if __name__ == "__main__":
    loader = batches(Numbers(5), jitter, 2, seed=0, workers=1)
    next(loader)
    print(multiprocessing.active_children()[0].pid, flush=True)
    time.sleep(600)
"""


def test_worker_processes_die_with_the_one_that_started_them(tmp_path: Path) -> None:
    script = tmp_path / "orphan.py"
    script.write_text(ORPHAN)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment) as parent:
        assert parent.stdout
        worker = int(parent.stdout.readline())
        assert running(worker)
        parent.kill()
    wait_until(lambda: not running(worker))


def running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_too_many_damaged_records_are_an_error_from_a_process(tmp_path: Path) -> None:
    options: dict[str, Any] = {"quarantine": tmp_path / "quarantine.jsonl", "max_damaged": 0.0}
    with (
        batches(Numbers(100, bad={1}), jitter, 100, seed=0, workers=1, **options) as loader,
        pytest.raises(StoreError, match=r"record 1 cannot be read \(1 of 100 records are damaged; .* at most 0"),
    ):
        next(loader)
