"""Floating-point operations of the transformer, counted from its shapes: matrix products only, 2·m·n·k each.

Norms, softmaxes, GELUs and embeddings are left out as negligible. Operations that rematerialisation repeats are left
out too: these are the operations that the model needs, not those that a program executes.

Axes: T frames, S cells of a frame, C width, n vocabularies of V codes.
"""

from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures import state_heads
from rsjax.models.roboscape.departures.adaptive_norms import changes
from rsjax.models.roboscape.departures.motion_head import OUTPUTS


def forward_flops(config: Architecture, frames: int) -> int:
    """Returns the operations of one pass over one clip of ``frames`` frames, all modalities, without a cache.

    Temporal attention counts every pair of frames, though half of the pairs are masked.
    """
    depth = config.sizes("depth")
    own_sizes = config.depth == "branch" and (depth.width, depth.grid) != (config.width, config.grid)
    products = _blocks(config, frames) + _action_encoder(config)
    if config.depth == "branch":
        products += _blocks(depth, frames)
        products += depth.blocks * depth.grid**2 * depth.width * config.width  # W of Eq. 3
    if own_sizes:
        products += _action_encoder(depth)
    if config.depth_cells > 1:
        tables = 1 + config.departures.read_previous
        products += tables * config.grid**2 * depth.width**2  # of the embeddings of a coarse cell's tokens
    for modality in config.modalities:  # the heads
        products += config.grid**2 * config.sizes(modality).width * config.vocabularies * config.vocabulary_size
    if config.state_heads:
        products += config.grid**2 * config.width * state_heads.PRODUCTS
    return 2 * frames * products


def motion_head_flops(config: Architecture, frames: int) -> int:
    """Returns the operations of the motion head for one clip, which training alone runs; 0 without the head."""
    if not config.motion_head:
        return 0
    return 2 * frames * config.grid**2 * config.width * OUTPUTS


def _blocks(sizes: Architecture, frames: int) -> int:
    """Returns the multiplications in a frame's blocks of one branch."""
    cells = sizes.grid**2
    linear = 8 * sizes.width**2 + 2 * sizes.public.mlp_ratio * sizes.width**2  # qkv and proj twice, fc1 and fc2
    attention = 2 * (cells + frames) * sizes.width  # scores and weighted sums, over space and over time
    adaptive = 0
    if sizes.action_inputs and sizes.action_encoder == "norms":
        adaptive = changes(sizes.departures.more_norms) * sizes.width**2
    return sizes.blocks * (cells * (linear + attention) + adaptive)


def _action_encoder(sizes: Architecture) -> int:
    """Returns the multiplications in a frame's action encoder of one branch."""
    products = sizes.action_inputs * sizes.width
    if sizes.action_inputs and sizes.action_encoder == "mlp":
        products += sizes.width**2
    return products
