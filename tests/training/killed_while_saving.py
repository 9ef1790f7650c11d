"""A process that saves checkpoints until it is killed."""

from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.training.checkpoint import Checkpoints

ARRAYS, SIZE = 4, 2**20


def state(step: int) -> dict[str, Any]:
    """Returns 16 MiB of numbers that do not compress and differ between steps."""
    rng = np.random.default_rng(step)
    return {f"w{i}": rng.random(SIZE, np.float32) for i in range(ARRAYS)} | {"step": np.int32(step)}


def save_forever(directory: Path, events: Connection) -> None:
    """Resumes from the newest checkpoint; sends each step that it restored, starts to save, and has on disk."""
    checkpoints = Checkpoints(directory)
    step = 0 if checkpoints.latest() is None else checkpoints.restore(state(0))[1]["next"]
    events.send(("restored", step))
    while True:
        step += 1
        checkpoints.save(step, state(step), {"next": step})
        events.send(("saving", step))
        checkpoints.wait()
        events.send(("saved", step))
