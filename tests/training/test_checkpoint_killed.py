import multiprocessing
import random
import time
from multiprocessing.connection import Connection
from pathlib import Path

import jax
import numpy as np

from rsjax.training.checkpoint import Checkpoints
from tests.training.killed_while_saving import save_on, state

KILLS = 5


def hear(told: Connection) -> tuple[str, int]:
    assert told.poll(60)
    return told.recv()


def test_killed_while_writing_the_newest_whole_checkpoint_is_there(tmp_path: Path) -> None:
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["tests.training.killed_while_saving"])  # jax is loaded once, not in each process
    on_disk, unfinished = 0, 0
    for kill in range(KILLS):
        told, tell = server.Pipe(duplex=False)
        process = server.Process(target=save_on, args=(tmp_path, tell), daemon=True)
        process.start()
        tell.close()
        events = [hear(told)]
        assert events[0] in (("restored", on_disk), ("restored", on_disk + 1))  # the last was not told of any more
        last = ("saving", events[0][1] + 3)
        while events[-1] != last:
            began = time.monotonic()
            events.append(hear(told))
            if events[-1][0] == "saved":
                seconds = time.monotonic() - began
        time.sleep(random.Random(kill).uniform(0, seconds))
        process.kill()
        process.join()
        unfinished += any("tmp" in path.name for path in tmp_path.iterdir())
        while told.poll():
            try:
                events.append(told.recv())
            except EOFError:
                break
        on_disk = max(step for event, step in events if event != "saving")
    checkpoints = Checkpoints(tmp_path)
    restored, data = checkpoints.restore(state(0))
    assert data["next"] in (on_disk, on_disk + 1)
    jax.tree.map(np.testing.assert_array_equal, restored, state(data["next"]))
    checkpoints.save(data["next"] + 1, state(0), {})
    checkpoints.close()
    assert unfinished > 0  # the kills struck while something was written
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == [data["next"], data["next"] + 1]
