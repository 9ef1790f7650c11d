"""A CogVideoX small enough to be trained and sampled in no time, on the toy clips."""

from dataclasses import replace
from functools import cache
from typing import Any

from rsjax.config import Config
from rsjax.models.base import create_autoencoder
from rsjax.models.cogvideox.config import CausalVAEConfig, CogVideoXConfig, GuidedDenoiseConfig, TextConfig
from rsjax.models.cogvideox.transformer import Architecture, shapes
from rsjax.trainable import Params
from tests.models.irasim.toy import drawn
from tests.tools.pipeline import toy

AUTOENCODER = CausalVAEConfig(
    patch_size=2, latent_channels=3, widths=(8, 8, 8), res_blocks=1, norm_groups=4, image_draws=2
)
MODEL = CogVideoXConfig(
    autoencoder=AUTOENCODER,
    text=TextConfig(tokens=2, width=4),
    width=32,
    blocks=2,
    heads=2,
    mlp_ratio=2,
    patch_size=2,
    time_width=16,
    sample=GuidedDenoiseConfig(steps=2, guidance=2.0),
)


def config(**changes: Any) -> Config:
    """The toy configuration with this model, some of whose fields are changed."""
    base = toy.config()
    loop = replace(base.tokenizer_train, depth_share=0.0, frames_per_clip=base.sim.frames)
    return replace(base, model=replace(MODEL, **changes), tokenizer_train=loop)


@cache
def params(arch: Architecture) -> Params:
    """Random parameters: fresh ones predict zeros."""
    return drawn(shapes(arch))


@cache
def autoencoder_params(config: Config) -> Params:
    return drawn(create_autoencoder(config).shapes())
