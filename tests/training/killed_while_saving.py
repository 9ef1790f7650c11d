"""A process that saves checkpoints of some tens of megabytes, to be killed while it does."""

from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.training.checkpoint import Checkpoints

ARRAYS, SIZE = 6, 2**20


def state(step: int) -> dict[str, Any]:
    """Numbers that do not compress, other ones at each step: 24 MiB."""
    rng = np.random.default_rng(step)
    return {f"w{i}": rng.random(SIZE, np.float32) for i in range(ARRAYS)} | {"step": np.int32(step)}


def save_on(directory: Path, told: Connection) -> None:
    """Goes on from the newest checkpoint; tells of each step that it restored, began to save, and has on disk."""
    checkpoints = Checkpoints(directory)
    step = 0 if checkpoints.latest() is None else checkpoints.restore(state(0))[1]["next"]
    told.send(("restored", step))
    while True:
        step += 1
        checkpoints.save(step, state(step), {"next": step})
        told.send(("saving", step))
        checkpoints.wait()
        told.send(("saved", step))
