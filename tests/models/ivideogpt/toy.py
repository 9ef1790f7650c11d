"""A tokenizer and a LLaMA of iVideoGPT that are small enough to compile in no time, with random parameters."""

from typing import Any

import jax
import numpy as np

from rsjax.config import ClipShape
from rsjax.models.ivideogpt.config import ConditionalVQConfig, IVideoGPTConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA
from rsjax.tools.convert.ivideogpt import tokenizer_shapes
from rsjax.trainable import Params

SIZE = 16  # pixels a side
# Two levels and a cross-attention after each, in the decoder after the middle and the first level.
VQ = ConditionalVQConfig(
    widths=(8, 16), res_blocks=1, norm_groups=4, latent=8, codes=32, future_patch=4, attention_size=16, dropout=0.0
)


MODEL = IVideoGPTConfig(autoencoder=VQ, width=16, blocks=2, heads=2, mlp_width=32, dropout=0.0)
CLIPS = ClipShape(frames=4, image_size=SIZE, tracks=4, action_dim=3, test_clips=2)
ARCH = Architecture.create(MODEL, CLIPS)


def llama_params(arch: Architecture = ARCH) -> Params:
    return random_params(jax.eval_shape(LLaMA(arch).init_params, jax.random.key(0)))


def random_params(shapes: Params, seed: int = 0) -> Params:
    """Normally distributed parameters, scaled so that outputs are of order 1; codebooks are far apart."""
    rng = np.random.default_rng(seed)

    def draw(path: Any, x: jax.ShapeDtypeStruct) -> np.ndarray:
        name = jax.tree_util.keystr(path)
        fan_in = int(np.prod(x.shape[:-1]))
        scale = 1.0 if "embedding" in name else 0.3 if x.ndim == 1 or "pos_emb" in name else fan_in**-0.5
        return (rng.normal(scale=scale, size=x.shape) + ("scale" in name)).astype(np.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def vq_params(config: ConditionalVQConfig = VQ, size: int = SIZE) -> Params:
    return random_params(tokenizer_shapes(config, size))


def frames(clips: int, count: int, size: int = SIZE) -> np.ndarray:
    """Frames 0–255, (clips, count, size, size, 3)."""
    return np.random.default_rng(1).integers(0, 256, (clips, count, size, size, 3), np.uint8)
