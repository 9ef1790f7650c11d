"""Run with four virtual devices: a few steps of one state under every placement.

Prints, as JSON, how far the parameters end from the jitted ones (the largest difference, and the distance as a share
of the way that training moved them), for "pmap", "mesh" (data alone), "fsdp" (2 × 2), and "muon": a smaller network by
Muon under fsdp. "mean of ratios": how far the loss is, as a share, where every device divides by its own weight. Of a
model with depth and clips of which some have none: "depth pmap" and "depth mesh", how far the gradient is from the
jitted one, and "depth mean of ratios". For the tokenizer, how far gradients and averages are from the jitted ones
("tokenizer pmap", with its discriminator, and "tokenizer fsdp", without), and how far its entropy is where each device
knows its own images alone ("tokenizer apart").
"checkpoint": how far two steps of one placement, saved, and a third one of another are from three steps; "start":
whether fresh parameters are the same to the bit where they are made in parts; "cut": the share of the fsdp state that
one device holds.
"""

import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

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
from rsjax.models.roboscape import losses
from rsjax.models.roboscape.losses import Term
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.objectives import Objective, Surroundings, TokenizerObjective, WorldModelObjective
from rsjax.training.placement import Placement
from rsjax.training.state import TrainState, create_state

# Wide enough that its matrices are cut rather than left whole. Without depth it compiles in two thirds of the time;
# tests/training/hosts.py takes the one with depth.
MODEL = ModelConfig(frames=4, grid=2, code_bits=4, action_dim=3, width=64, blocks=2, heads=2)
WITH_DEPTH = WorldModelObjective(MODEL, MaskConfig(), LossConfig(num_keypoints=3))
OBJECTIVE = replace(WITH_DEPTH, model=replace(MODEL, depth=False))
SOME_DEPTH = replace(WITH_DEPTH, model=replace(MODEL, width=8, blocks=1), loss=LossConfig(keypoints=False))
LOOP = LoopConfig(batch_size=8, steps=3, ema=0.9, optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=1))
MUON = replace(LOOP, optimizer=replace(LOOP.optimizer, kind="muon"))
WAYS: dict[str, dict[str, Any]] = {
    "jit": {"placement": "jit"},
    "pmap": {"placement": "pmap"},
    "mesh": {"placement": "mesh"},
    "fsdp": {"placement": "mesh", "fsdp": 2},
}
STEPS = 3


@dataclass(frozen=True)
class Small(Objective):
    """Two matrices in a row, asked to lead each clip's actions to noise drawn by its place in the global batch."""

    @property
    def weights(self) -> dict[str, float]:
        return {"error": 1.0}

    def init(self, key: Array) -> Any:
        shapes = {"encoder": (3, 128), "blocks": (2, 128, 128)}
        return {name: {"kernel": 0.1 * jax.random.normal(key, shape)} for name, shape in shapes.items()}

    def terms(self, params: Any, batch: Any, key: Array, around: Surroundings) -> dict[str, Term]:
        hidden = batch.actions.mean(1) @ params["encoder"]["kernel"]
        for matrix in params["blocks"]["kernel"]:
            hidden = jnp.tanh(hidden @ matrix)
        noise = jax.vmap(lambda place: jax.random.normal(jax.random.fold_in(key, place)))(batch.index)
        error = jnp.square(hidden.mean(1) - noise)
        return {"error": (jnp.sum(error * batch.weight), jnp.sum(batch.weight))}


def batch(seed: int) -> Batch:
    """Eight clips for four devices: two, one, none and two of them count; hidden keypoints and depth are as uneven."""
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
        "has_depth": np.array([1, 0, 0, 1, 1, 0, 1, 1], np.float32),
    }
    return Batch(**fields)


class Training:
    """One placement's state, steps and checkpoints, as the training loop uses them."""

    def __init__(self, way: str, objective: Objective, loop: LoopConfig, batches: Sequence[Any], start: Any) -> None:
        self.objective, self.loop, self.batches = objective, replace(loop, **WAYS[way]), batches
        self.placement = Placement.create(self.loop)
        self.state = self.placement.init(objective, self.loop) if start is None else self.placement.adopt(start)
        self.step = self.placement.compile(objective, self.loop)

    def compiled(self) -> "Training":
        """Compiling is most of the work here, and leaves Python to others."""
        self.step = self.step.lower(self.state, self.placement.put_batch(self.batches[0])).compile()
        return self

    def run(self, first: int, last: int) -> TrainState:
        for step in range(first, last):
            self.state, _ = self.step(self.state, self.placement.put_batch(self.batches[step]))
        return self.placement.gather(self.state)


def mean_of_ratios(objective: Objective, params: Any) -> float:
    """What must not be done: every device's own ratio, averaged over devices."""
    around = Surroundings(jnp.int32(0), None, None)

    @jax.jit
    def terms(params: Any, part: Any) -> dict[str, Term]:
        return objective.terms(params, part, jax.random.key(0), around)

    def loss(found: list[dict[str, Term]]) -> float:
        sums = jax.tree.map(lambda *x: jnp.sum(jnp.stack(x)), *found)
        return float(losses.combine(sums, objective.weights)[0])

    cut = jax.tree.map(lambda x: x.reshape(4, 2, *x.shape[1:]), batch(0))
    found = [terms(params, jax.tree.map(itemgetter(i), cut)) for i in range(4)]
    right, wrong = loss(found), np.mean([loss([one]) for one in found])
    return float(abs(wrong - right) / right)


TOKENIZER = TokenizerObjective(
    TokenizerConfig(
        image_size=24, patch_size=8, channels=4, channel_multipliers=(1,), res_blocks=1, norm_groups=2, code_bits=4
    ),
    TokenizerTrainConfig(
        batch_size=8, steps=2, adversarial=0.1, lecam_decay=0.9, optimizer=OptimizerConfig(warmup_steps=1)
    ),
)


PLAIN = replace(TOKENIZER, train=replace(TOKENIZER.train, adversarial=0.0))  # no discriminator, which is slow

# Images that grow brighter from first to last.
IMAGES = np.random.default_rng(0).integers(0, 100, (8, 24, 24, 3)) + 20 * np.arange(8)[:, None, None, None]
IMAGES = IMAGES.astype(np.uint8)


def apart(state: TrainState) -> float:
    """What must not be done: the entropy of each device's own images. The share by which the mean of it is off."""

    @jax.jit
    def entropy(images: Any) -> Any:
        around = Surroundings(jnp.int32(0), state.extra, None)
        value, weight = TOKENIZER.terms(state.params, images, jax.random.key(0), around)["entropy"]
        return value / weight

    # The parts are repeated, so that one program serves the whole and the parts.
    whole, parts = entropy(IMAGES), [entropy(np.tile(IMAGES[i : i + 2], (4, 1, 1, 1))) for i in range(0, 8, 2)]
    return float(abs(np.mean(parts) - whole) / abs(whole))


def share(one: Any, other: Any) -> float:
    """The distance of two trees, as a share of the first one's length."""
    flat = [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in (one, other)]
    return float(np.linalg.norm(flat[0] - flat[1]) / np.linalg.norm(flat[0]))


def moments(state: TrainState) -> Any:
    """After one step these stand for the gradient. Adam would blow the rounding of its smallest entries up."""
    return optax.tree_utils.tree_get(state.opt_state, "mu")


def moments_apart(one: TrainState, other: TrainState) -> dict[str, float]:
    """After one step: relative distances of each network's gradient and of the averages."""
    found = moments(one), moments(other)
    if one.extra is None:
        return {"tokenizer": share(*found)}
    shares = {name: share(found[0][name], found[1][name]) for name in found[0]}
    return shares | {"averages": share(one.extra, other.extra)}


def distance(one: TrainState, other: TrainState, start: TrainState) -> dict[str, float]:
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((s.params, s.ema))]) for s in (one, other, start)]
    apart = np.abs(flat[0] - flat[1])
    way = np.linalg.norm(flat[0] - flat[2])
    return {"largest": float(apart.max()), "share": float(np.linalg.norm(apart) / way)}


def same(one: Any, other: Any) -> bool:
    return all(map(np.array_equal, *map(jax.tree.leaves, (one, other))))


def held(state: TrainState) -> float:
    """The share of a state's elements that its first device holds."""
    leaves = jax.tree.leaves(state)
    return sum(x.addressable_data(0).size for x in leaves) / sum(x.size for x in leaves)


def through_checkpoints(trainings: list[Training], start: Any) -> list[TrainState]:
    """From each placement's two steps to the next one's third, by way of the disk."""
    ends = []
    for source, sink in zip(trainings, [*trainings[1:], trainings[0]], strict=True):
        source.state = source.placement.adopt(start)
        source.run(0, 2)
        with tempfile.TemporaryDirectory() as directory:
            checkpoints = Checkpoints(Path(directory))
            checkpoints.save(2, source.placement.portable(source.state), {})
            checkpoints.close()
            checkpoints = Checkpoints(Path(directory))
            restored, _ = checkpoints.restore(sink.placement.template(sink.objective, sink.loop))
            checkpoints.close()
        sink.state = sink.placement.adopt(restored)
        ends.append(sink.run(2, 3))
    return ends


def main() -> dict[str, Any]:
    clips = [batch(seed) for seed in range(STEPS)]
    start, deep, fresh, plain = (
        jax.device_get(jax.jit(partial(create_state, objective, loop))())
        for objective, loop in (
            (OBJECTIVE, LOOP),
            (SOME_DEPTH, LOOP),
            (TOKENIZER, TOKENIZER.train),
            (PLAIN, PLAIN.train),
        )
    )
    trainings = {way: Training(way, OBJECTIVE, LOOP, clips, start) for way in WAYS}
    depths = {way: Training(way, SOME_DEPTH, LOOP, clips, deep) for way in ("jit", "pmap", "mesh")}
    small = {way: Training(way, Small(), MUON, clips, None) for way in ("jit", "fsdp")}
    tokenizers = [Training(way, TOKENIZER, TOKENIZER.train, [IMAGES], fresh) for way in ("jit", "pmap")]
    plainer = [Training(way, PLAIN, PLAIN.train, [IMAGES], plain) for way in ("jit", "fsdp")]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(Training.compiled, [*trainings.values(), *depths.values(), *tokenizers, *plainer]))

    cut = held(trainings["fsdp"].state)
    begun = {way: training.placement.gather(training.state) for way, training in small.items()}
    ends = {way: training.run(0, STEPS) for way, training in trainings.items()}
    muon = {way: training.run(0, STEPS) for way, training in small.items()}
    gradients = {way: moments(training.run(0, 1)) for way, training in depths.items()}
    return {
        **{way: distance(ends["jit"], ends[way], start) for way in ("pmap", "mesh", "fsdp")},
        "muon": distance(muon["jit"], muon["fsdp"], begun["jit"]),
        "mean of ratios": mean_of_ratios(OBJECTIVE, start.params),
        "depth mean of ratios": mean_of_ratios(SOME_DEPTH, deep.params),
        **{f"depth {way}": share(gradients["jit"], gradients[way]) for way in ("pmap", "mesh")},
        "tokenizer pmap": moments_apart(*(training.run(0, 1) for training in tokenizers)),
        "tokenizer fsdp": moments_apart(*(training.run(0, 1) for training in plainer)),
        "tokenizer apart": apart(fresh),
        "checkpoint": [
            distance(ends["jit"], end, start) for end in through_checkpoints(list(trainings.values()), start)
        ],
        "start": same(begun["jit"], begun["fsdp"]),
        "cut": cut,
    }


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    print(json.dumps(main()))
