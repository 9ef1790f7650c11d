"""The terms of the objective (paper Eq. 4–8). Each returns (weighted sum, weight); :func:`combine` alone divides.

Sums and weights are added over devices separately: the mean of per-device ratios is not the global ratio.

Axes: B clips, T frames, H×W = S cells, n vocabularies of V codes, D code bits, K keypoints.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.models.roboscape.keypoints import Keypoints
from rsjax.tokenizers import lfq

Scalar = Float[Array, ""]
Term = tuple[Scalar, Scalar]


def token_cross_entropy(
    logits: Float[Array, "B T S n V"], tokens: Int[Array, "B T H W"], code_bits: int
) -> Float[Array, "B T H W"]:
    """-log p of each cell's token: the sum of its vocabularies' cross-entropies, in nats."""
    sub_tokens = lfq.split_tokens(tokens, code_bits, logits.shape[-2]).reshape(logits.shape[:-1])
    chosen = jnp.take_along_axis(logits, sub_tokens[..., None], axis=-1)[..., 0]
    return jnp.sum(jax.nn.logsumexp(logits, axis=-1) - chosen, axis=-1).reshape(tokens.shape)


def rgb_term(
    cross_entropy: Float[Array, "B T H W"], mask: Bool[Array, "B T H W"], clip_weight: Float[Array, " B"]
) -> Term:
    """L_RGB of Eq. 4 over the masked cells."""
    weight = mask * clip_weight[:, None, None, None]
    return jnp.sum(cross_entropy * weight), jnp.sum(weight)


def depth_term(
    cross_entropy: Float[Array, "B T H W"], mask: Bool[Array, "B T H W"], clip_weight: Float[Array, " B"]
) -> Term:
    """L_Depth of Eq. 4: the same of the depth tokens."""
    return rgb_term(cross_entropy, mask, clip_weight)


def attention_term(
    cross_entropy: Float[Array, "B T H W"],
    mask: Bool[Array, "B T H W"],
    clip_weight: Float[Array, " B"],
    attention: Float[Array, "B T H W"],
) -> Term:
    """L_Attention of Eq. 7: cross-entropy weighted by the map of Eq. 6.

    The weight counts cells, not the map: keypoint cells count γ times, the others are not counted less.
    """
    total, weight = rgb_term(cross_entropy * attention, mask, clip_weight)
    return total, weight


def expected_codes(logits: Float[Array, "*B n V"], code_bits: int) -> Float[Array, "*B D"]:
    """ŝ of Eq. 5: each bit's expectation in [-1, 1] under the predicted distribution."""
    codes = lfq.vocabulary_codes(code_bits, logits.shape[-2])  # V, D/n
    expected = jax.nn.softmax(logits, axis=-1) @ codes  # … n D/n
    return expected.reshape(*expected.shape[:-2], code_bits)


def keypoint_term(predicted: Float[Array, "B T S D"], keypoints: Keypoints, clip_weight: Float[Array, " B"]) -> Term:
    """L_Keypoint of Eq. 5: ‖ŝ_t(p_i^t) - ŝ_1(p_i^1)‖², over the frames t ≥ 2 in which keypoint i is visible."""
    cells = keypoints.cells.swapaxes(1, 2)  # B T K
    at_points = jnp.take_along_axis(predicted, cells[..., None], axis=2)  # B T K D
    distance = jnp.sum(jnp.square(at_points[:, 1:] - at_points[:, :1]), axis=-1)
    weight = keypoints.visible.swapaxes(1, 2)[:, 1:] * clip_weight[:, None, None]
    return jnp.sum(distance * weight), jnp.sum(weight)


def combine(
    terms: dict[str, Term], weights: dict[str, float], total: Callable[[Scalar], Scalar] = lambda x: x
) -> tuple[Scalar, dict[str, Scalar]]:
    """Eq. 8: Σ λ·sum/weight, this device's share of it.

    Args:
        terms: by name; the names must be those of ``weights``, so that a misspelt or forgotten term cannot pass.
        weights: λ by name.
        total: adds a scalar over devices.

    Returns:
        This device's share of the objective (the shares add up to it), and each term's share, unweighted.

    Raises:
        KeyError: terms and weights differ in name.
    """
    if terms.keys() != weights.keys():
        raise KeyError(f"loss terms {sorted(terms)} are not the configured weights {sorted(weights)}")
    shares = {
        name: value / jnp.maximum(total(jax.lax.stop_gradient(weight)), 1e-8) for name, (value, weight) in terms.items()
    }
    return sum((weights[name] * share for name, share in shares.items()), start=jnp.float32(0)), shares
