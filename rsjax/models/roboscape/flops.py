"""Floating-point operations of the world model, counted from its shapes: matrix products alone, 2·m·n·k each.

Norms, softmaxes, GELUs and embeddings are left out (they are few), and so is whatever rematerialisation repeats: these
are the operations that the model needs, not those that a program happens to do.

Axes: T frames, S cells of a frame, C width, n vocabularies of V codes.
"""

from rsjax.config import ModelConfig


def forward_flops(config: ModelConfig, frames: int) -> int:
    """Operations of one pass over one clip of ``frames`` frames, all branches, without a cache.

    Temporal attention counts every pair of frames, as it is computed, though half of the pairs are masked.
    """
    cells, width, branches = config.grid**2, config.width, 2 if config.depth else 1
    linear = 8 * width**2 + 2 * config.mlp_ratio * width**2  # qkv and proj of both attentions, fc1 and fc2
    attention = 2 * (cells + frames) * width  # scores and weighted sums, over space and over time
    head = width * config.vocabularies * config.vocabulary_size
    joint = width**2 * config.blocks if config.depth else 0  # depth → RGB
    per_cell = branches * (config.blocks * (linear + attention) + head) + joint
    return 2 * frames * (cells * per_cell + config.action_dim * width)


def train_flops(config: ModelConfig, frames: int, batch: int) -> int:
    """Operations of one training step on ``batch`` clips: forwards, and twice as much backwards."""
    return 3 * batch * forward_flops(config, frames)
