import itertools
import threading
import time
from types import SimpleNamespace

import grain
import numpy as np
import pytest

from rsjax.data import loader as module
from rsjax.data.loader import Loader, Prefetch, batches
from rsjax.data.store import StoreError
from rsjax.errors import Preempted
from tests.data.toy import Numbers, assert_same, jitter


def loader(place: int = 0, bad: tuple[int, ...] = ()) -> Loader:
    return batches(Numbers(50, bad=bad), jitter, 4, seed=1, state={"global_next_index": place}, max_damaged=0.0)


def test_batches_and_states_are_the_loaders_however_far_ahead_it_is() -> None:
    with loader() as plain, Prefetch(loader(), dict, lambda arrays: {"put": arrays["i"]}) as ahead:
        for number in range(6):
            before, arrays = plain.state(), next(plain)
            time.sleep(0.02)  # for the thread to run ahead
            fed = next(ahead)
            np.testing.assert_array_equal(fed.batch["put"], arrays["i"])
            assert (fed.before, fed.after, ahead.state()) == (before, plain.state(), plain.state())
            assert ahead.identify(fed) == plain.identify(arrays)
            if number == 3:
                with loader(fed.before["global_next_index"]) as again:
                    assert_same(next(again), arrays)
        assert ahead.quarantined() == 0


def test_of_a_batch_that_processes_share_all_rows_are_named() -> None:
    shard = grain.sharding.ShardOptions(1, 2)
    shared = batches(Numbers(50), jitter, 4, seed=1, shard=shard)
    with loader() as plain, Prefetch(shared, dict, lambda arrays: None) as half:
        for _ in range(3):
            arrays, fed = next(plain), next(half)
            assert fed.clips["record"].tolist() == arrays["record"][1::2].tolist()
            assert half.identify(fed) == plain.identify(arrays)


def test_batches_are_put_before_they_are_asked_for_but_no_more_than_wait() -> None:
    made = threading.Semaphore(0)
    count = []

    def put(arrays: object) -> None:
        count.append(arrays)
        made.release()

    with Prefetch(loader(), dict, put, ahead=2) as ahead:
        for _ in range(3):  # two wait, and a third is ready
            assert made.acquire(timeout=120)
        assert not made.acquire(timeout=0.1)
        next(ahead)
        assert made.acquire(timeout=120)
    assert len(count) == 4


def test_the_wait_for_a_slow_batch_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock by which a batch takes 5 seconds from when it is asked for, and nothing else takes any."""
    seconds, asked, reads = [0.0], threading.Semaphore(0), itertools.count()

    def monotonic() -> float:
        now = seconds[0]
        if next(reads) % 2 == 0:  # before a wait, not after it
            asked.release()
        return now

    def put(arrays: object) -> None:
        asked.acquire()
        seconds[0] += 5

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=monotonic))
    with Prefetch(loader(), dict, put) as ahead:
        for _ in range(2):
            next(ahead)
        assert ahead.waited == 10
        asked.release(100)  # the thread has to end


def test_an_error_arrives_where_the_batch_is_asked_for_and_stays() -> None:
    with Prefetch(loader(bad=tuple(range(50))), dict, lambda arrays: arrays) as ahead:
        for _ in range(2):
            with pytest.raises(StoreError, match="cannot be read"):
                next(ahead)
        assert ahead.state() == {"global_next_index": 0}


def test_an_error_of_putting_arrives_whatever_its_kind() -> None:
    def fail(arrays: object) -> None:
        raise Preempted("stop")

    with Prefetch(loader(), dict, fail) as ahead, pytest.raises(Preempted):
        next(ahead)


def test_closing_ends_the_thread_while_it_waits_for_room() -> None:
    with Prefetch(loader(), dict, lambda arrays: arrays, ahead=1):
        time.sleep(0.1)
        assert any("thread-prefetch" in thread.name for thread in threading.enumerate())
    assert not any("thread-prefetch" in thread.name for thread in threading.enumerate())
