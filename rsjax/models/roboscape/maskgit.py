"""MaskGIT decoding of one frame: all cells masked, then a cosine schedule of which stay so.

A clip's draws depend on its own key alone, not on the clips beside it.

Axes: B clips, S cells, n vocabularies of V codes.
"""

from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.tokenizers import lfq


@struct.dataclass
class Frame:
    """One frame under decoding, by branch: tokens, and the cells still masked."""

    tokens: dict[str, Int[Array, "*B S"]]
    mask: Bool[Array, "*B S"]


def masked_after(step: Array | int, steps: int, cells: int) -> Array:
    """Cells that stay masked after step ``step`` of ``steps``: ceil(cos((step + 1)/steps · π/2) · S); 0 at the end."""
    # float32's cos(π/2) is not quite 0, and its ceil would leave a cell masked for ever.
    share = jnp.where(jnp.asarray(step) + 1 >= steps, 0.0, jnp.cos((step + 1) / steps * jnp.pi / 2))
    return jnp.ceil(share * cells).astype(jnp.int32)


def sample_tokens(
    key: Key[Array, ""], logits: Float[Array, "*B S n V"], temperature: float, code_bits: int, top_k: int = 0
) -> tuple[Int[Array, "*B S"], Float[Array, "*B S"]]:
    """A token per cell and its log-probability (the sum over vocabularies, in nats, at temperature 1, among all codes).

    Args:
        temperature: logits are divided by it; 0 takes each vocabulary's most probable code.
        top_k: draw among each vocabulary's ``top_k`` most probable codes (and those as probable as the last of them);
            0: among all.
    """
    log_p = jax.nn.log_softmax(logits, axis=-1)
    if temperature == 0:
        codes = jnp.argmax(logits, -1)
    else:
        codes = jax.random.categorical(key, keep_top(logits, top_k) / temperature, axis=-1)
    confidence = jnp.take_along_axis(log_p, codes[..., None], axis=-1)[..., 0].sum(-1)
    return lfq.merge_tokens(codes.astype(jnp.int32), code_bits), confidence


def keep_top(logits: Float[Array, "*N V"], top_k: int) -> Float[Array, "*N V"]:
    """Logits with -inf in place of all that lie below the ``top_k``-th; all of them where ``top_k`` is 0."""
    if not 0 < top_k < logits.shape[-1]:
        return logits
    least = jax.lax.top_k(logits, top_k)[0][..., -1:]
    return jnp.where(logits < least, -jnp.inf, logits)


def unmask_step(
    config: SampleConfig,
    code_bits: int,
    keys: Key[Array, " B"],
    step: Array | int,
    frame: Frame,
    logits: dict[str, Float[Array, "B S n V"]],
    no_depth: Bool[Array, " B"] | None = None,
) -> Frame:
    """One decoding step: fill the masked cells, then mask again those that the schedule leaves open.

    Both branches share their mask. Which cells stay open is drawn at random, or, for "greedy", it is those in which the
    branches together are least sure; in a clip without depth, those in which RGB is.

    Args:
        keys: one per clip.
        logits: of this frame, by branch.
        no_depth: True for clips without depth; what is drawn for them there means nothing.
    """
    return jax.vmap(partial(_unmask_clip, config, code_bits, step))(keys, frame, logits, no_depth)


def _unmask_clip(
    config: SampleConfig,
    code_bits: int,
    step: Array | int,
    key: Array,
    frame: Frame,
    logits: dict[str, Array],
    no_depth: Array | None,
) -> Frame:
    order_key, *branch_keys = jax.random.split(key, len(logits) + 1)
    tokens, confidence = {}, jnp.zeros(frame.mask.shape)
    for branch_key, (branch, branch_logits) in zip(branch_keys, logits.items(), strict=True):
        drawn, log_p = sample_tokens(branch_key, branch_logits, config.temperature, code_bits, config.top_k)
        tokens[branch] = jnp.where(frame.mask, drawn, frame.tokens[branch])
        confidence += log_p if branch == "rgb" or no_depth is None else jnp.where(no_depth, 0.0, log_p)
    if config.unmask == "random":
        confidence = jax.random.uniform(order_key, frame.mask.shape)
    # Cells that are already decided stay so: they rank as surest.
    rank = jnp.argsort(jnp.argsort(jnp.where(frame.mask, confidence, jnp.inf)))
    return Frame(tokens, rank < masked_after(step, config.steps, frame.mask.shape[-1]))
