"""Takes a few steps of one state under every sharding, on four virtual devices.

Prints, as JSON, how far the world model's parameters end from those of one device (the largest difference, and the
distance as a share of the way that training moved them), for "pmap", "mesh" (data alone), "fsdp" (2 × 2), and "muon": a
smaller network by Muon under fsdp. "gradient pmap" …: how far the gradient of the first step is from one device's, as a
share; some clips have no depth. "gradient heads": the same under fsdp of a model with depth, motion and state heads and
adaptive norms; the state heads lack labels for some clips. "mean of ratios" and "depth mean of ratios": how far the
loss and its depth term are, as a share, if every device divides by its own weight. For the tokenizer: how far gradients
and averages are from one device's ("tokenizer pmap", "tokenizer fsdp"), and how far its entropy is if each device knows
its own images alone ("tokenizer apart"). "checkpoint": how far two steps of one sharding, saved, and a third one of
another are from three steps; "start": whether fresh parameters are the same to the bit if they are made in parts;
"cut": the share of the fsdp state that one device holds.
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

from rsjax.config import (
    AdamW,
    AdversarialConfig,
    Config,
    DataConfig,
    LoopConfig,
    LossConfig,
    Muon,
    RoboScapeConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
)
from rsjax.config.config_fields import with_values
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.objective import Batch
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.trainable import StepContext, Term, Trainable
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.sharding import Sharding
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import combine, train_step

LOOP = LoopConfig(batch_size=8, steps=3, ema=0.9, optimizer=AdamW(learning_rate=1e-2, warmup_steps=1))
# Wide enough that the world model's matrices are cut rather than left whole.
CONFIG = Config(
    name="devices",
    data=DataConfig("nowhere", "nothing", frames=4, image_size=24, tracks=7, action_dim=3, test_clips=2),
    tokenizer=TokenizerConfig(
        patch_size=8, channels=4, channel_multipliers=(1,), res_blocks=1, norm_groups=2, code_bits=4
    ),
    tokenizer_train=TokenizerTrainConfig(
        batch_size=8,
        steps=2,
        adversarial=AdversarialConfig(lecam_decay=0.9),
        optimizer=AdamW(warmup_steps=1),
    ),
    model=RoboScapeConfig(width=64, blocks=2, heads=2, loss=LossConfig(num_keypoints=3)),
    train=LOOP,
)
MODEL = RoboScape.create(CONFIG)
WITH_HEADS = {"model.depth": "head", "model.loss.keypoints": "motion", "model.state_heads": "on"}
HEADS = RoboScape.create(with_values(CONFIG, WITH_HEADS | {"model.action_encoder": "norms"}))
TOKENIZER = TokenizerTraining.create(CONFIG)
MUON = replace(LOOP, optimizer=Muon(learning_rate=1e-2, warmup_steps=1))
SHARDINGS: dict[str, dict[str, Any]] = {
    "jit": {"sharding": "jit"},
    "pmap": {"sharding": "pmap"},
    "mesh": {"sharding": "mesh"},
    "fsdp": {"sharding": "mesh", "fsdp": 2},
}
STEPS = 3

# Images that grow brighter from first to last.
IMAGES = np.random.default_rng(0).integers(0, 100, (8, 24, 24, 3)) + 20 * np.arange(8)[:, None, None, None]
IMAGES = IMAGES.astype(np.uint8)


@dataclass(frozen=True)
class Small(Trainable[Any]):
    """Two matrices in a row that map each clip's actions to noise drawn by its place in the global batch."""

    @property
    def loss_weights(self) -> dict[str, float]:
        return {"error": 1.0}

    def init(self, key: Array) -> Any:
        shapes = {"encoder": (3, 128), "blocks": (2, 128, 128)}
        return {name: {"kernel": 0.1 * jax.random.normal(key, shape)} for name, shape in shapes.items()}

    def loss_terms(self, params: Any, batch: Any, key: Array, context: StepContext) -> dict[str, Term]:
        hidden = batch.actions.mean(1) @ params["encoder"]["kernel"]
        for matrix in params["blocks"]["kernel"]:
            hidden = jnp.tanh(hidden @ matrix)
        noise = jax.vmap(lambda place: jax.random.normal(jax.random.fold_in(key, place)))(batch.index)
        error = jnp.square(hidden.mean(1) - noise)
        return {"error": (jnp.sum(error * batch.weight), jnp.sum(batch.weight))}


def batch(seed: int) -> Batch:
    """Eight clips for four devices: two, one, none and two of them count; hidden keypoints and depth are as uneven."""
    rng, grid = np.random.default_rng(seed), CONFIG.grid
    tokens = [rng.integers(0, 2**CONFIG.tokenizer.code_bits, (8, 4, grid, grid), np.int32) for _ in range(2)]
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
        "state": np.where(rng.random((8, 1, 3)) < 0.3, np.nan, rng.integers(0, 2, (8, 4, 3))).astype(np.float32),
    }
    return Batch(**fields)


class Training:
    """One sharding's state, steps and checkpoints, as the training loop uses them."""

    def __init__(self, kind: str, model: Trainable[Any], loop: LoopConfig, batches: Sequence[Any], start: Any) -> None:
        self.model, self.loop, self.batches = model, replace(loop, **SHARDINGS[kind]), batches
        self.sharding = Sharding.create(self.loop)
        self.state = self.sharding.init(model, self.loop) if start is None else self.sharding.adopt(start)
        self.step: Any = self.sharding.compile(train_step, model, self.loop)

    def compiled(self) -> "Training":
        """Compiles the step, which is most of the work here and leaves Python to others."""
        self.step = self.step.lower(self.state, self.sharding.put_batch(self.batches[0])).compile()
        return self

    def run(self, first: int, last: int) -> TrainState:
        for step in range(first, last):
            self.state, _ = self.step(self.state, self.sharding.put_batch(self.batches[step]))
        return self.sharding.gather(self.state)


def mean_of_ratios(params: Any) -> tuple[float, float]:
    """What must not be done: every device's own ratio, averaged over devices. The errors of loss and depth term."""
    context = StepContext(jnp.int32(0), None, None)

    @jax.jit
    def terms(params: Any, part: Any) -> dict[str, Term]:
        return MODEL.loss_terms(params, part, jax.random.key(0), context)

    def values(parts: list[dict[str, Term]]) -> np.ndarray:
        sums = jax.tree.map(lambda *x: jnp.sum(jnp.stack(x)), *parts)
        loss, means = combine(sums, MODEL.loss_weights)
        return np.array([loss, means["depth"]])

    cut = jax.tree.map(lambda x: x.reshape(4, 2, *x.shape[1:]), batch(0))
    parts = [terms(params, jax.tree.map(itemgetter(i), cut)) for i in range(4)]
    right, wrong = values(parts), np.mean([values([one]) for one in parts], axis=0)
    of_loss, of_depth = np.abs(wrong - right) / right
    return float(of_loss), float(of_depth)


def tokenizer_apart(state: TrainState) -> float:
    """What must not be done: the entropy of each device's own images. The share by which their mean is off."""

    @jax.jit
    def entropy(images: Any) -> Any:
        context = StepContext(jnp.int32(0), state.extra, None)
        value, weight = TOKENIZER.loss_terms(state.params, images, jax.random.key(0), context)["entropy"]
        return value / weight

    # The parts are repeated, so that one program serves the whole and the parts.
    whole, parts = entropy(IMAGES), [entropy(np.tile(IMAGES[i : i + 2], (4, 1, 1, 1))) for i in range(0, 8, 2)]
    return float(abs(np.mean(parts) - whole) / abs(whole))


def share(one: Any, other: Any) -> float:
    """The distance of two trees, as a share of the first one's length."""
    flat = [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in (one, other)]
    return float(np.linalg.norm(flat[0] - flat[1]) / np.linalg.norm(flat[0]))


def moments(state: TrainState) -> Any:
    """After one step these stand for the gradient. Adam would magnify the rounding errors of its smallest entries."""
    return optax.tree_utils.tree_get(state.opt_state, "mu")


def moments_apart(one: TrainState, other: TrainState) -> dict[str, float]:
    """After one step: relative distances of each network's gradient and of the averages."""
    gradients = moments(one), moments(other)
    shares = {name: share(gradients[0][name], gradients[1][name]) for name in gradients[0]}
    return shares | {"averages": share(one.extra, other.extra)}


def distance(one: TrainState, other: TrainState, start: TrainState) -> dict[str, float]:
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((s.params, s.ema))]) for s in (one, other, start)]
    apart = np.abs(flat[0] - flat[1])
    way = np.linalg.norm(flat[0] - flat[2])
    return {"largest": float(apart.max()), "share": float(np.linalg.norm(apart) / way)}


def same(one: Any, other: Any) -> bool:
    return all(map(np.array_equal, *map(jax.tree.leaves, (one, other))))


def first_device_share(state: TrainState) -> float:
    """The share of a state's elements that its first device holds."""
    leaves = jax.tree.leaves(state)
    return sum(x.addressable_data(0).size for x in leaves) / sum(x.size for x in leaves)


def through_checkpoints(trainings: list[Training], start: Any) -> list[TrainState]:
    """From each sharding's two steps to the next one's third, by way of the disk."""
    ends = []
    for source, sink in zip(trainings, [*trainings[1:], trainings[0]], strict=True):
        source.state = source.sharding.adopt(start)
        source.run(0, 2)
        with tempfile.TemporaryDirectory() as directory:
            checkpoints = Checkpoints(Path(directory))
            checkpoints.save(2, source.sharding.portable(source.state), {})
            checkpoints.close()
            checkpoints = Checkpoints(Path(directory))
            restored, _ = checkpoints.restore(sink.sharding.template(sink.model, sink.loop))
            checkpoints.close()
        sink.state = sink.sharding.adopt(restored)
        ends.append(sink.run(2, 3))
    return ends


def main() -> dict[str, Any]:
    clips = [batch(seed) for seed in range(STEPS)]
    start = jax.device_get(jax.jit(partial(create_state, MODEL, LOOP))())
    fresh = jax.device_get(jax.jit(partial(create_state, TOKENIZER, CONFIG.loop("tokenizer")))())
    trainings = {kind: Training(kind, MODEL, LOOP, clips, start) for kind in SHARDINGS}
    small = {kind: Training(kind, Small(), MUON, clips, None) for kind in ("jit", "fsdp")}
    heads = {kind: Training(kind, HEADS, LOOP, clips, None) for kind in ("jit", "fsdp")}
    kinds = ("jit", "pmap", "fsdp")
    tokenizers = {kind: Training(kind, TOKENIZER, CONFIG.loop("tokenizer"), [IMAGES], fresh) for kind in kinds}
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(Training.compiled, [*trainings.values(), *heads.values(), *tokenizers.values()]))

    cut = first_device_share(trainings["fsdp"].state)
    begun = {kind: training.sharding.gather(training.state) for kind, training in small.items()}
    gradients = {kind: moments(training.run(0, 1)) for kind, training in trainings.items()}
    ends = {kind: training.run(1, STEPS) for kind, training in trainings.items()}
    of_head = {kind: moments(training.run(0, 1)) for kind, training in heads.items()}
    muon = {kind: training.run(0, STEPS) for kind, training in small.items()}
    images = {kind: training.run(0, 1) for kind, training in tokenizers.items()}
    of_loss, of_depth = mean_of_ratios(start.params)
    return {
        **{kind: distance(ends["jit"], ends[kind], start) for kind in ("pmap", "mesh", "fsdp")},
        **{f"gradient {kind}": share(gradients["jit"], gradients[kind]) for kind in ("pmap", "mesh", "fsdp")},
        "gradient heads": share(of_head["jit"], of_head["fsdp"]),
        "muon": distance(muon["jit"], muon["fsdp"], begun["jit"]),
        "mean of ratios": of_loss,
        "depth mean of ratios": of_depth,
        **{f"tokenizer {kind}": moments_apart(images["jit"], images[kind]) for kind in ("pmap", "fsdp")},
        "tokenizer apart": tokenizer_apart(fresh),
        "checkpoint": [
            distance(ends["jit"], end, start) for end in through_checkpoints(list(trainings.values()), start)
        ],
        "start": same(begun["jit"], begun["fsdp"]),
        "cut": cut,
    }


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    print(json.dumps(main()))
