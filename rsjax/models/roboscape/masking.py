"""Masks and corrupts training tokens (reference: the public Genie, 1xgpt).

1. Every sub-token of every frame, including the first, becomes a random code with probability rate·u, u ~ U(0, 1).
2. With this probability: f ~ U{P, …, T-1} and r ~ U(keep, 1); in each frame ≥ f, r shrinks by U(decay, 1) and
   sub-tokens become random with probability 1 - r. Otherwise f = 1. (P: prompt frames.)
3. In frames ≥ f, each cell is masked with probability cos(πv/2), v ~ U(0, 1) drawn per clip and frame. The departure
   ``visible_prefix`` draws a later f for some clips.

u, f and r are drawn per batch; everything else is drawn per clip from its place in the global batch, so that the draws
do not depend on the clip's device.

Axes: B clips, T frames, H×W cells, n vocabularies.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Int

from rsjax.config import CorruptionConfig
from rsjax.models.roboscape.departures.visible_prefix import after_prefix
from rsjax.tokenizers import lfq

KEEP = 0.25  # step 2's constants, from the public Genie
DECAY = 0.9

Tokens = dict[str, Int[Array, "B T H W"]]


@struct.dataclass
class Masked:
    """Inputs of the model: corrupted tokens by branch, and the masked cells (the same in both branches)."""

    tokens: Tokens
    mask: Bool[Array, "B T H W"]


def corrupt(
    config: CorruptionConfig | None,
    visible_prefix: float,
    prompt_frames: int,
    code_bits: int,
    vocabularies: int,
    key: Array,
    tokens: Tokens,
    index: Int[Array, " B"],
) -> Masked:
    """Corrupts and masks a batch.

    Args:
        config: of steps 1 and 2; None: without both, f = 1.
        visible_prefix: as in :class:`rsjax.config.Departures`.
        prompt_frames: P, the first frames, which step 2 leaves alone.
        key: the step's key, the same on all devices.
        tokens: clean tokens by branch.
        index: each clip's place in the global batch.
    """
    frames = next(iter(tokens.values())).shape[1]
    batch_key, clip_key = jax.random.split(key)
    first_masked = jnp.int32(1)
    if config is not None:
        rates, first_masked = _batch_plan(config, prompt_frames, batch_key, frames)

    def one_clip(place: Int[Array, ""], clip: dict[str, Int[Array, "T H W"]]) -> Masked:
        mask_key, *branch_keys = jax.random.split(jax.random.fold_in(clip_key, place), 1 + len(clip))
        noisy = dict(clip)
        if config is not None:
            for branch_key, branch in zip(branch_keys, clip, strict=True):
                where_key, code_key = jax.random.split(branch_key)
                sub_tokens = lfq.split_tokens(clip[branch], code_bits, vocabularies)  # T H W n
                codes = 2 ** (code_bits // vocabularies)
                random = jax.random.randint(code_key, sub_tokens.shape, 0, codes, sub_tokens.dtype)
                where = jax.random.uniform(where_key, sub_tokens.shape) < rates[:, None, None, None]
                noisy[branch] = lfq.merge_tokens(jnp.where(where, random, sub_tokens), code_bits)
        first = after_prefix(visible_prefix, mask_key, frames, first_masked)
        rate_key, cell_key = jax.random.split(mask_key)
        rate = jnp.cos(jnp.pi / 2 * jax.random.uniform(rate_key, (frames,)))
        rate = jnp.where(jnp.arange(frames) >= first, rate, 0.0)
        drawn = jax.random.uniform(cell_key, next(iter(clip.values())).shape)
        return Masked(noisy, drawn < rate[:, None, None])

    return jax.vmap(one_clip)(index, tokens)


def _batch_plan(config: CorruptionConfig, prompt_frames: int, key: Array, frames: int) -> tuple[Array, Array]:
    """Draws the probability per frame that a sub-token is replaced, (T,), and f."""
    u_key, happens_key, f_key, keep_key, decay_key = jax.random.split(key, 5)
    everywhere = config.random_token_rate * jax.random.uniform(u_key)
    happens = jax.random.bernoulli(happens_key, config.probability)
    drawn = jax.random.randint(f_key, (), prompt_frames, frames)
    keep = jax.random.uniform(keep_key, minval=KEEP)
    decay = jax.random.uniform(decay_key, (frames,), minval=DECAY)
    late = jnp.arange(frames) >= drawn
    survive = keep * jnp.cumprod(jnp.where(late, decay, 1.0))
    extra = jnp.where(happens & late, 1 - survive, 0.0)
    return 1 - (1 - everywhere) * (1 - extra), jnp.where(happens, drawn, 1)
