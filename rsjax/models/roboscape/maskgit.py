"""MaskGIT decoding of one frame: all cells begin masked, and a cosine schedule unmasks them.

A clip's draws depend only on its own key, not on other clips of the batch.

Axes: B clips, S cells, D code bits, n vocabularies of V codes.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.models.roboscape.departures import mean_codes
from rsjax.models.roboscape.departures.second_view import SECOND
from rsjax.tokenizers import lfq


@struct.dataclass
class Frame:
    """A partly decoded frame: tokens by branch, and the cells that are still masked.

    Attributes:
        entropy: of the RGB tokens in nats, in the step that decided each cell; None: not requested.
        means: the mean codes by branch, in the same step; empty: not requested.
    """

    tokens: dict[str, Int[Array, "*B S"]]
    mask: Bool[Array, "*B S"]
    entropy: Float[Array, "*B S"] | None = None
    means: dict[str, Float[Array, "*B S D"]] = struct.field(default_factory=dict)


def masked_after(steps: int, cells: int) -> Int[np.ndarray, " K"]:
    """Returns how many of S cells stay masked after each step s: ceil(cos((s + 1)/K · π/2) · S), and 0 after the last.

    It is computed in float64 as in the reference: cos(π/3) is slightly above ½ there, so that after two of three steps
    one cell more than half stays masked; float32 would drop it.
    """
    left = [math.ceil(math.cos((step + 1) / steps * math.pi / 2) * cells) for step in range(steps - 1)]
    return np.array([*left, 0], np.int32)


def sample_tokens(
    key: Key[Array, ""],
    logits: Float[Array, "*B S n V"],
    temperature: float | Float[Array, ""],
    code_bits: int,
    top_k: int = 0,
) -> tuple[Int[Array, "*B S"], Float[Array, "*B S"]]:
    """Draws a token per cell.

    Args:
        temperature: logits are divided by it; 0 takes each vocabulary's most probable code. An array must be above 0.
        top_k: draw from the ``top_k`` most probable codes of each vocabulary (and ties with the last of them); 0: from
            all.

    Returns:
        Tokens, and their log-probabilities: the sum over vocabularies, in nats, at temperature 1, without ``top_k``.
    """
    log_p = jax.nn.log_softmax(logits, axis=-1)
    if not isinstance(temperature, jax.Array) and temperature == 0:
        codes = jnp.argmax(logits, -1)
    else:
        codes = jax.random.categorical(key, keep_top(logits, top_k) / temperature, axis=-1)
    confidence = jnp.take_along_axis(log_p, codes[..., None], axis=-1)[..., 0].sum(-1)
    return lfq.merge_tokens(codes.astype(jnp.int32), code_bits), confidence


def token_entropy(logits: Float[Array, "*B n V"]) -> Float[Array, "*B"]:
    """Returns the entropy of tokens in nats, the sum over their vocabularies."""
    log_p = jax.nn.log_softmax(logits, axis=-1)
    return -jnp.sum(jnp.exp(log_p) * log_p, axis=(-2, -1))


def keep_top(logits: Float[Array, "*N V"], top_k: int) -> Float[Array, "*N V"]:
    """Replaces all logits below the ``top_k``-th by -inf; none if ``top_k`` is 0."""
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
    temperature: Float[Array, " B"] | None = None,
) -> Frame:
    """Does one decoding step: fills the masked cells, then masks some of them again as the schedule says.

    Both branches share their mask. The cells that are masked again are random or, for "greedy", those of lowest
    confidence, which is the sum of all branches' log-probabilities, without depth's for a clip without depth.

    Args:
        keys: one per clip.
        logits: of this frame, by branch.
        no_depth: True for clips without depth, whose depth tokens are meaningless.
        temperature: one per clip, above 0, instead of that of ``config`` unless that is 0.
    """
    return jax.vmap(partial(_unmask_clip, config, code_bits, step))(keys, frame, logits, no_depth, temperature)


def _unmask_clip(
    config: SampleConfig,
    code_bits: int,
    step: Array | int,
    key: Array,
    frame: Frame,
    logits: dict[str, Array],
    no_depth: Array | None,
    temperature: float | Array | None,
) -> Frame:
    order_key, rgb_key, depth_key = jax.random.split(key, 3)
    # RGB's draws are the same where the others are left out.
    branch_keys = {"rgb": rgb_key, "depth": depth_key, SECOND: jax.random.fold_in(key, 3)}
    tokens = {}
    confidence = jnp.zeros(frame.mask.shape)
    entropy = frame.entropy
    if temperature is None or config.temperature == 0:
        temperature = config.temperature
    if entropy is not None:
        entropy = jnp.where(frame.mask, token_entropy(logits["rgb"]), entropy)
    for branch, branch_logits in logits.items():
        drawn, log_p = sample_tokens(branch_keys[branch], branch_logits, temperature, code_bits, config.top_k)
        tokens[branch] = jnp.where(frame.mask, drawn, frame.tokens[branch])
        if branch == "depth" and no_depth is not None:
            log_p = jnp.where(no_depth, 0.0, log_p)
        confidence += log_p
    means = mean_codes.decided(frame.mask, logits, frame.means, code_bits)
    if config.unmask == "random":
        confidence = jax.random.uniform(order_key, frame.mask.shape)
    # Cells that are already decided stay decided: they get the highest rank.
    rank = jnp.argsort(jnp.argsort(jnp.where(frame.mask, confidence, jnp.inf)))
    still_masked = rank < jnp.asarray(masked_after(config.steps, frame.mask.shape[-1]))[step]
    return Frame(tokens, still_masked, entropy, means)
