"""Run with four virtual devices: a few steps of one state under jit, pmap, and jit over a sharded mesh.

Prints, as JSON, how far the parameters end from the jitted ones (the largest difference, and the distance as a share
of the way that training moved them), for "pmap", "mesh", and "mean of ratios": a loss that each device divides by its
own weight. And, for the tokenizer with its discriminator under pmap, how far the gradients and averages are from the
jitted ones ("tokenizer"), and how far where each device knows its own images alone ("tokenizer apart").
"""

import json
from functools import partial
from typing import Any
from unittest import mock

import jax
import numpy as np
import optax
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from rsjax.clip import Batch
from rsjax.config import (
    LoopConfig,
    LossConfig,
    MaskConfig,
    ModelConfig,
    OptimizerConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
)
from rsjax.objective import losses
from rsjax.tokenizer.loss import tokenizer_terms
from rsjax.train import objectives
from rsjax.train.objectives import TokenizerObjective, WorldModelObjective
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


TOKENIZER = TokenizerObjective(
    TokenizerConfig(
        image_size=24, patch_size=8, channels=4, channel_multipliers=(1,), res_blocks=1, norm_groups=2, code_bits=4
    ),
    TokenizerTrainConfig(
        batch_size=8, steps=2, adversarial=0.1, lecam_decay=0.9, optimizer=OptimizerConfig(warmup_steps=1)
    ),
)


def tokenizer_step(placement: Placement) -> TrainState:
    """The tokenizer's state after one step, at a learning rate of 0, on images that grow brighter from first to last.

    Compared are the moments, not the parameters: Adam would blow the rounding of the smallest gradients up.
    """
    images = np.random.default_rng(0).integers(0, 100, (8, 24, 24, 3)) + 20 * np.arange(8)[:, None, None, None]
    state = placement.put_state(jax.jit(partial(create_state, TOKENIZER, TOKENIZER.train))())
    step = placement.compile(TOKENIZER, TOKENIZER.train)
    return placement.first(step(state, placement.put_batch(images.astype(np.uint8)))[0])


def apart() -> TrainState:
    """What must not be done: entropy, normalisation and averages of each device's own images."""
    alone = lambda *arguments: tokenizer_terms(*arguments[:-1])  # noqa: E731 - all but axis_name
    with mock.patch.object(objectives, "tokenizer_terms", alone):
        return tokenizer_step(Placement(4))


def moments_apart(one: TrainState, other: TrainState) -> dict[str, float]:
    """Relative distances: of each network's gradient, of the averages."""

    def share(x: Any, y: Any) -> float:
        flat = [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in (x, y)]
        return float(np.linalg.norm(flat[0] - flat[1]) / np.linalg.norm(flat[0]))

    moments = [optax.tree_utils.tree_get(state.opt_state, "mu") for state in (one, other)]
    shares = {name: share(moments[0][name], moments[1][name]) for name in moments[0]}
    return shares | {"averages": share(one.extra, other.extra)}


def distance(one: TrainState, other: TrainState, start: TrainState) -> dict[str, float]:
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((s.params, s.ema))]) for s in (one, other, start)]
    apart = np.abs(flat[0] - flat[1])
    way = np.linalg.norm(flat[0] - flat[2])
    return {"largest": float(apart.max()), "share": float(np.linalg.norm(apart) / way)}


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    jitted, initial = placed(Placement(0)), create_state(OBJECTIVE, LOOP)
    ways = {"pmap": placed(Placement(4)), "mesh": meshed(), "mean of ratios": wrong()}
    result = {name: distance(jitted, state, initial) for name, state in ways.items()}
    whole = tokenizer_step(Placement(0))
    result |= {"tokenizer": moments_apart(whole, tokenizer_step(Placement(4)))}
    result |= {"tokenizer apart": moments_apart(whole, apart())}
    print(json.dumps(result))
