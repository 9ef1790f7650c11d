"""A world model, a tokenizer and a smaller network that train under every sharding, on virtual devices."""

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
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
from rsjax.training.sharding import Sharding
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import as_numbers, train_step

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
WEIGHTS = np.array([1, 1, 1, 0, 0, 0, 1, 1], np.float32)

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
        "weight": WEIGHTS,
        "index": np.arange(8, dtype=np.int32),
        "has_depth": np.array([1, 0, 0, 1, 1, 0, 1, 1], np.float32),
        "state": np.where(rng.random((8, 1, 3)) < 0.3, np.nan, rng.integers(0, 2, (8, 4, 3))).astype(np.float32),
    }
    return Batch(**fields)


class Training:
    """One sharding's state, steps and checkpoints, as the training loop uses them; also the last step's metrics."""

    metrics: dict[str, float]

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
            self.state, metrics = self.step(self.state, self.sharding.put_batch(self.batches[step]))
        self.metrics = as_numbers(metrics)
        return self.sharding.gather(self.state)


def compile_all(trainings: Iterable[Training]) -> None:
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(Training.compiled, trainings))


def drawn(model: Any, loop: LoopConfig, shapes: Any) -> Any:
    """A state with random parameters of these shapes, made without a program."""
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: (0.1 * rng.normal(size=x.shape)).astype(np.float32), shapes)
    state = jax.eval_shape(lambda: create_state(model, loop))
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), state).replace(params=params)


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


def metrics_apart(one: dict[str, float], other: dict[str, float]) -> float:
    """The largest difference of a scalar of a step, as a share of the scalar."""
    return max(abs(one[name] - other[name]) / (abs(one[name]) + 1e-3) for name in one)


def distance(one: TrainState, other: TrainState, start: TrainState) -> dict[str, float]:
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((s.params, s.ema))]) for s in (one, other, start)]
    apart = np.abs(flat[0] - flat[1])
    way = np.linalg.norm(flat[0] - flat[2])
    return {"largest": float(apart.max()), "share": float(np.linalg.norm(apart) / way)}
