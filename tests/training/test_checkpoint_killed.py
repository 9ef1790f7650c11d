import multiprocessing
import random
import time
from multiprocessing.connection import Connection
from pathlib import Path

import jax
import numpy as np

from rsjax.training.checkpoint import Checkpoints
from tests.training.killed_while_saving import save_forever, state

KILLS = 2


def receive(connection: Connection) -> tuple[str, int]:
    assert connection.poll(60)
    return connection.recv()


def test_a_kill_while_saving_leaves_the_newest_complete_checkpoint(tmp_path: Path) -> None:
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["tests.training.killed_while_saving"])  # jax is loaded once, not in each process
    on_disk, unfinished = 0, 0
    kill = 0
    while kill < KILLS or not unfinished:  # some kill has to hit a save
        kill += 1
        receiver, sender = server.Pipe(duplex=False)
        process = server.Process(target=save_forever, args=(tmp_path, sender), daemon=True)
        process.start()
        sender.close()
        events = [receive(receiver)]
        assert events[0] in (("restored", on_disk), ("restored", on_disk + 1))  # the last report was not sent any more
        last = ("saving", events[0][1] + 2)
        while events[-1] != last:
            began = time.monotonic()
            events.append(receive(receiver))
            if events[-1][0] == "saved":
                seconds = time.monotonic() - began
        time.sleep(random.Random(kill).uniform(0, seconds))
        process.kill()
        process.join()
        unfinished += any("tmp" in path.name for path in tmp_path.iterdir())
        while receiver.poll():
            try:
                events.append(receiver.recv())
            except EOFError:
                break
        on_disk = max(step for event, step in events if event != "saving")
    checkpoints = Checkpoints(tmp_path)
    restored, data = checkpoints.restore(state(0))
    assert data["next"] in (on_disk, on_disk + 1)
    jax.tree.map(np.testing.assert_array_equal, restored, state(data["next"]))
    checkpoints.save(data["next"] + 1, state(0), {})
    checkpoints.close()
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == [data["next"], data["next"] + 1]
