"""Measures the time that training waits for data, in real training steps."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.bench import inputs
from rsjax.config import Config
from rsjax.data.curriculum import plan
from rsjax.data.prefetch import Prefetch
from rsjax.data.store import open_store, write_store
from rsjax.models.base import create_model
from rsjax.training.sharding import Sharding
from rsjax.training.state import create_state
from rsjax.training.step import train_step

CLIPS = 256
WARM_UP, LEAST, MOST = 3, 10, 200  # steps


def feed(config: Config, budget: float) -> dict[str, Any]:
    """Measures the share of time that training steps on one device wait for their batch.

    It uses the preset's batch size and workers, and random clips from a store on disk. Each step finishes before the
    next batch is requested, so the time until the batch arrives is the time that the device waits.

    Args:
        budget: seconds after which no further step begins, but at least ``LEAST`` steps are run.
    """
    loop = replace(config.train, sharding="jit", fsdp=1, curriculum=())
    model = create_model(config)
    transform = model.transform(inputs.normalization(config))
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        write_store(path, "tokens", {"train": (model.example(rng) for _ in range(CLIPS))}, {})
        loop, make = plan(loop, open_store(path), lambda store: transform, Path(folder))
        sharding = Sharding.create(loop)
        step = sharding.compile(train_step, model, loop)
        state = jax.jit(lambda: create_state(model, loop))()
        with Prefetch(make(None), lambda arrays: sharding.put_batch(model.batch(arrays))) as batches:
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
