"""An IRASim small enough to be trained and sampled in no time, on the toy clips."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np

from rsjax.config import Config
from rsjax.models.base import create_autoencoder, create_model
from rsjax.models.diffusion.config import DenoiseConfig
from rsjax.models.irasim.config import IRASimConfig, KLConfig
from rsjax.trainable import Params
from tests.tools.pipeline import toy

AUTOENCODER = KLConfig(
    network="magvit2",
    latent_channels=3,
    channels=8,
    channel_multipliers=(1, 2),
    res_blocks=1,
    norm_groups=4,
    patch_size=4,
)
MODEL = IRASimConfig(
    autoencoder=AUTOENCODER, width=16, blocks=2, heads=2, patch_size=2, sample=DenoiseConfig("ddim", steps=3)
)


def config(**changes: Any) -> Config:
    """The toy configuration with this model, some of whose fields are changed."""
    base = toy.config()
    loop = replace(base.tokenizer_train, depth_share=0.0)
    return replace(
        base, model=replace(MODEL, **changes), tokenizer_train=loop, runtime=replace(base.runtime, eval_every=6)
    )


@cache
def params(config: Config) -> Params:
    """Random parameters: fresh ones predict zeros."""
    return drawn(jax.eval_shape(create_model(config).init, jax.random.key(0)))


@cache
def autoencoder_params(config: Config) -> Params:
    return drawn(create_autoencoder(config).shapes())


def drawn(shapes: Any) -> Params:
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)
