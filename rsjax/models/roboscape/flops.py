"""Floating-point operations of the transformer, counted from its shapes: matrix products only, 2·m·n·k each.

Norms, softmaxes, GELUs and embeddings are left out as negligible. Operations that rematerialisation repeats are left
out too: these are the operations that the model needs, not those that a program executes.

Axes: T frames, S cells of a frame, C width, n vocabularies of V codes.
"""

from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.motion_head import OUTPUTS


def forward_flops(config: Architecture, frames: int) -> int:
    """Returns the operations of one pass over one clip of ``frames`` frames, all modalities, without a cache.

    Temporal attention counts every pair of frames, though half of the pairs are masked.
    """
    cells = config.grid**2
    width = config.width
    linear = 8 * width**2 + 2 * config.public.mlp_ratio * width**2  # qkv and proj of both attentions, fc1 and fc2
    attention = 2 * (cells + frames) * width  # scores and weighted sums, over space and over time
    head = width * config.vocabularies * config.vocabulary_size
    per_cell = len(config.branches) * config.blocks * (linear + attention) + len(config.modalities) * head
    if config.depth == "branch":
        per_cell += width**2 * config.blocks  # W of Eq. 3
    encoder = config.action_inputs * width
    if config.action_inputs and config.action_encoder == "mlp":
        encoder += width**2
    return 2 * frames * (cells * per_cell + encoder)


def motion_head_flops(config: Architecture, frames: int) -> int:
    """Returns the operations of the motion head for one clip, which training alone runs; 0 without the head."""
    if not config.motion_head:
        return 0
    return 2 * frames * config.grid**2 * config.width * OUTPUTS
