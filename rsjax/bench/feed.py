"""Whether the loader keeps ahead of the device: real training steps, fed as training feeds them."""

import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.bench import inputs
from rsjax.config import Config
from rsjax.data.curriculum import plan
from rsjax.data.prefetch import Prefetch
from rsjax.data.store import open_store, write_store
from rsjax.pipeline.transforms import token_batch
from rsjax.training.objectives import WorldModelObjective
from rsjax.training.placement import Placement
from rsjax.training.state import create_state

CLIPS = 256
WARM_UP, LEAST, MOST = 3, 10, 200  # steps


def feed(config: Config, budget: float) -> dict[str, Any]:
    """The share of the time that training steps on one device wait for their batch.

    The preset's own batch size and workers; clips with random contents, from a store on disk. Every step is waited for
    before the next batch is asked for, so the time that the batch takes then is the time that the device waits.

    Args:
        budget: seconds after which no further step begins, once there are ``LEAST``.
    """
    loop = replace(config.train, placement="jit", fsdp=1, stages=())
    objective = WorldModelObjective.create(config)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        write_store(path, "tokens", {"train": (inputs.record(config, rng) for _ in range(CLIPS))}, {})
        loop, make = plan(loop, open_store(path), lambda store: inputs.transform(config), Path(folder))
        placement = Placement.create(loop)
        step = placement.compile(objective, loop)
        state = jax.jit(partial(create_state, objective, loop))()
        with Prefetch(make(None), lambda arrays: placement.put_batch(token_batch(arrays))) as batches:
            steps, began, waited = 0, 0.0, 0.0
            while steps < WARM_UP + MOST:
                if steps == WARM_UP:
                    began, waited = time.monotonic(), batches.waited
                state, metrics = step(state, next(batches).batch)
                jax.block_until_ready(metrics)
                steps += 1
                if steps >= WARM_UP + LEAST and time.monotonic() - began > budget:
                    break
            seconds, waited = time.monotonic() - began, batches.waited - waited
    return {
        "feed_batch": loop.batch_size,
        "feed_workers": loop.workers,
        "feed_steps": steps - WARM_UP,
        "feed_step_s": seconds / (steps - WARM_UP),
        "data_wait_s": waited / (steps - WARM_UP),
        "data_wait_share": waited / seconds,
    }
