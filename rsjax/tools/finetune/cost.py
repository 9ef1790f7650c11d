"""Estimates how long a run's trainings take on this machine, from their operations and the speed of its products."""

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from rsjax.config import Config, TokenModelConfig
from rsjax.data.curriculum import check_stages
from rsjax.data.store import open_store
from rsjax.models.base import create_autoencoder, create_model
from rsjax.progress import duration

SIDE = 1024  # of the matrices whose product is timed
PRODUCTS = 8
# Seconds that a training takes, in seconds of as many operations of plain products. Measured with ``tiny`` on a busy
# CPU; other networks and machines differ, by a factor of two or so.
TOKENIZER_OVERHEAD = 6.0
MODEL_OVERHEAD = 2.2
COMPILING = 120.0  # seconds, of all programs together


@dataclass(frozen=True)
class Cost:
    """The cost of a run's trainings.

    Attributes:
        tokenizer, world_model: floating-point operations of all steps.
        rate: operations a second of this machine's products.
    """

    tokenizer: float
    world_model: float
    rate: float

    @property
    def seconds(self) -> float:
        """The estimated time of both trainings, evaluation not included."""
        work = TOKENIZER_OVERHEAD * self.tokenizer + MODEL_OVERHEAD * self.world_model
        return COMPILING + work / self.rate

    def __str__(self) -> str:
        total = self.tokenizer + self.world_model
        return (
            f"training takes about {duration(self.seconds)} here at most: {total:.2g} operations, and this machine's "
            f"products reach {self.rate:.2g} a second"
        )


def estimate(config: Config) -> Cost:
    """Estimates the trainings of a run on a store that exists."""
    clips = config.clips
    assert config.data is not None
    own = config.tokenizer_train
    images = own.steps * own.batch_size * own.frames_per_clip
    tokenizer = 3 * images * sum(create_autoencoder(config).flops().values())
    loop = config.train
    model = create_model(config)
    count = len(check_stages(loop, open_store(config.data.store))[0].source("train"))
    assert isinstance(config.model, TokenModelConfig)
    passes = 1 + config.model.departures.self_conditioning / 3
    drawn = [(stage.epochs * count, stage.frames or clips.frames) for stage in loop.curriculum]
    drawn = drawn or [(loop.steps * loop.batch_size, clips.frames)]
    world_model = passes * sum(number * model.flops(frames)["train"] for number, frames in drawn)
    return Cost(tokenizer, world_model, products_per_second())


def products_per_second() -> float:
    """Returns the operations a second that float32 products of square matrices reach here."""
    x = jnp.ones((SIDE, SIDE), jnp.float32)
    product = jax.jit(jnp.matmul)
    product(x, x).block_until_ready()
    began = time.perf_counter()
    for _ in range(PRODUCTS):
        made = product(x, x)
    made.block_until_ready()
    return PRODUCTS * 2 * SIDE**3 / (time.perf_counter() - began)
