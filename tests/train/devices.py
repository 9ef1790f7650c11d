"""Run with four virtual devices: a few steps of one state under jit, pmap, and jit over a sharded mesh.

Prints, as JSON, how far the parameters end from the jitted ones (the largest difference, and the distance as a share
of the way that training moved them), for "pmap", "mesh", and "mean of ratios": a loss that each device divides by its
own weight.
"""

import json
from functools import partial
from typing import Any
from unittest import mock

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from rsjax.clip import Batch
from rsjax.config import LoopConfig, LossConfig, MaskConfig, ModelConfig, OptimizerConfig
from rsjax.objective import losses
from rsjax.train.objectives import WorldModelObjective
from rsjax.train.placement import Placement
from rsjax.train.state import TrainState, create_state
from rsjax.train.step import train_step

MODEL = ModelConfig(frames=4, grid=2, code_bits=4, action_dim=3, width=8, blocks=1, heads=2)
OBJECTIVE = WorldModelObjective(MODEL, MaskConfig(), LossConfig(num_keypoints=3))
LOOP = LoopConfig(batch_size=8, steps=3, ema=0.9, optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=1))
STEPS = 3


def batch(seed: int) -> Batch:
    """Eight clips for four devices: two, one, none and two of them count; hidden keypoints are as uneven."""
    rng = np.random.default_rng(seed)
    tokens = [rng.integers(0, 2**MODEL.code_bits, (8, 4, 2, 2), np.int32) for _ in range(2)]
    seen = np.array([0.9, 0.9, 0.1, 0.9, 0.5, 0.5, 0.1, 0.1])[:, None, None]
    fields: dict[str, Any] = {
        "rgb": tokens[0],
        "depth": tokens[1],
        "actions": rng.normal(size=(8, 4, 3)).astype(np.float32),
        "tracks": rng.random((8, 7, 4, 2)).astype(np.float32),
        "visible": rng.random((8, 7, 4)) < seen,
        "weight": np.array([1, 1, 1, 0, 0, 0, 1, 1], np.float32),
        "index": np.arange(8, dtype=np.int32),
    }
    return Batch(**fields)


def placed(placement: Placement) -> TrainState:
    """The state after the steps, as the training loop takes them."""
    state, step = placement.put_state(create_state(OBJECTIVE, LOOP)), placement.compile(OBJECTIVE, LOOP)
    for seed in range(STEPS):
        state, _ = step(state, placement.put_batch(batch(seed)))
    return placement.first(state)


def meshed() -> TrainState:
    """The same with the batch sharded over a mesh and the collectives left to XLA."""
    mesh = jax.make_mesh((4,), ("data",), axis_types=(AxisType.Auto,))
    state = jax.device_put(create_state(OBJECTIVE, LOOP), NamedSharding(mesh, P()))
    step = jax.jit(partial(train_step, OBJECTIVE, LOOP))
    for seed in range(STEPS):
        state, _ = step(state, jax.device_put(batch(seed), NamedSharding(mesh, P("data"))))
    return state


def wrong() -> TrainState:
    """What must not be done: every device's own ratio, averaged over devices (virtual ones: vmap compiles faster)."""

    def mean_of_ratios(terms: Any, weights: Any, total: Any) -> Any:
        loss, shares = combine(terms, weights)
        return loss / 4, {name: share / 4 for name, share in shares.items()}

    combine = losses.combine
    part = partial(train_step, OBJECTIVE, LOOP, axis_name="parts")
    state = create_state(OBJECTIVE, LOOP)
    with mock.patch.object(losses, "combine", mean_of_ratios):
        step = jax.jit(jax.vmap(part, in_axes=(None, 0), axis_name="parts"))
        for seed in range(STEPS):
            states, _ = step(state, Placement(4).put_batch(batch(seed)))
            state = jax.tree.map(lambda x: x[0], states)
    return state


def distance(one: TrainState, other: TrainState, start: TrainState) -> dict[str, float]:
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((s.params, s.ema))]) for s in (one, other, start)]
    apart = np.abs(flat[0] - flat[1])
    way = np.linalg.norm(flat[0] - flat[2])
    return {"largest": float(apart.max()), "share": float(np.linalg.norm(apart) / way)}


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    jitted, initial = placed(Placement(0)), create_state(OBJECTIVE, LOOP)
    ways = {"pmap": placed(Placement(4)), "mesh": meshed(), "mean of ratios": wrong()}
    print(json.dumps({name: distance(jitted, state, initial) for name, state in ways.items()}))
