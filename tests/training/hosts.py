"""One of several processes that train together: ``python -m tests.training.hosts FOLDER [HOST:PORT PROCESSES ID]``.

Without an address it joins the Slurm task that its environment describes, or trains alone on one device. Under each
sharding a small network takes a few steps on the real loader's batches and saves a checkpoint in FOLDER/SHARDING.
Several processes also save sharded checkpoints in FOLDER/checkpoints.
Prints, as JSON, the losses of each sharding's steps with the clips' places in the batch, and what the processes
exchange; the lead writes each sharding's last parameters to FOLDER/SHARDING-PROCESSES.npz.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import LoopConfig
from rsjax.data.loader import Arrays, batches
from rsjax.errors import UserError
from rsjax.models.roboscape.records import token_batch
from rsjax.training import distributed
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.sharding import Sharding
from rsjax.training.step import as_numbers, train_step
from tests.training.checkpoint_processes import save_together
from tests.training.devices import CONFIG, LOOP, SHARDINGS, STEPS, Small


def records(count: int = 11) -> list[Arrays]:
    """Returns clips of uneven weight: every third one counts nothing, keypoints are hidden at random."""
    rng, clips, codes = np.random.default_rng(0), CONFIG.clips, 2**CONFIG.tokenizer.code_bits
    shape = (clips.frames, CONFIG.grid, CONFIG.grid)
    return [
        {
            "rgb": rng.integers(0, codes, shape, np.int32),
            "depth": rng.integers(0, codes, shape, np.int32),
            "actions": rng.normal(size=(clips.frames, clips.action_dim)).astype(np.float32),
            "tracks": rng.random((clips.tracks, clips.frames, 2)).astype(np.float32),
            "visible": rng.random((clips.tracks, clips.frames)) < rng.random(),
            "weight": np.asarray(number % 3 > 0, np.float32),
            "has_depth": np.asarray(number % 4 > 0, np.float32),
        }
        for number in range(count)
    ]


def as_is(record: Arrays, rng: np.random.Generator) -> Arrays:
    return record


def train(loop: LoopConfig, folder: Path) -> dict[str, Any]:
    model = Small()
    sharding = Sharding.create(loop)
    state, step = sharding.init(model, loop), sharding.compile(train_step, model, loop)
    losses = []
    with batches(records(), as_is, loop.batch_size, seed=3) as loader:
        for _ in range(STEPS):
            batch = token_batch(next(loader))
            state, metrics = step(state, sharding.put_batch(batch))
            losses.append(as_numbers(metrics)["loss"])
        checkpoints = Checkpoints(folder)
        checkpoints.save(STEPS, sharding.portable(state), loader.state())
        checkpoints.close()
    # A resumed run does this: the state has to fit the compiled step.
    checkpoints = Checkpoints(folder)
    restored, _ = checkpoints.restore(sharding.template(model, loop))
    checkpoints.close()
    whole = sharding.gather(state)
    assert all(map(np.array_equal, *map(jax.tree.leaves, (whole, sharding.gather(sharding.adopt(restored))))))
    if distributed.is_lead():
        np.savez(f"{folder}-{jax.process_count()}.npz", *jax.tree.leaves(whole.params))
    return {"losses": losses, "index": np.asarray(batch.index).tolist()}


def failing() -> None:
    if distributed.is_lead():
        raise UserError("no room")


def exchanged() -> dict[str, Any]:
    """Returns what the processes exchange."""
    me = jax.process_index()
    try:
        distributed.on_lead("a stage", failing)
        failed = ""
    except UserError as error:
        failed = str(error)
    distributed.barrier("end")
    return {
        "agree": distributed.agree({"from": me, "text": "λ" * 300}),
        "anywhere": [distributed.anywhere(me == 1), distributed.anywhere(False)],
        "failed": failed,
        "devices": [jax.local_device_count(), jax.device_count()],
    }


def main(folder: Path, *address: str) -> dict[str, Any]:
    if address:
        distributed.initialize(address[0], int(address[1]), int(address[2]))
    else:
        distributed.initialize()
    several = jax.process_count() > 1
    if several:
        save_together(folder / "checkpoints")
    loops = {kind: replace(LOOP, **SHARDINGS[kind if several else "jit"]) for kind in ("pmap", "fsdp")}
    trained = {kind: train(loop, folder / kind) for kind, loop in loops.items()}
    return {"trained": trained, "exchanged": exchanged()}


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), *sys.argv[2:])))
