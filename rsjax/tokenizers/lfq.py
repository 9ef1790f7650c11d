"""Lookup-free quantisation (LFQ, MAGVIT-2): a code is the signs of D channels, a token the number with these bits.

Tokens are little-endian, ``token = Σ_c bit_c·2^c``, as in the published token files and Genie weights.
A vocabulary of 2^D is factorised into n vocabularies of 2^(D/n): sub-token k holds bits k·D/n … (k+1)·D/n - 1.

Axes: … any leading axes, D code bits, n vocabularies, V = 2^(D/n) codes each, N tokens.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Scalar = Float[Array, ""]


def quantize(latents: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """Returns the signs of the latents (+1 where > 0, else -1), with the straight-through gradient."""
    signs = jnp.where(latents > 0, 1.0, -1.0).astype(latents.dtype)
    return latents + jax.lax.stop_gradient(signs - latents)


def codes_to_tokens(codes: Float[Array, "*batch D"]) -> Int[Array, "*batch"]:
    """Converts codes in {-1, +1} to int32 tokens, 0 … 2^D - 1."""
    powers = 2 ** jnp.arange(codes.shape[-1], dtype=jnp.int32)
    return jnp.sum((codes > 0) * powers, axis=-1, dtype=jnp.int32)


def tokens_to_codes(tokens: Int[Array, "*batch"], code_bits: int) -> Float[Array, "*batch D"]:
    """Converts tokens to float32 codes in {-1, +1}."""
    bits = (tokens[..., None] >> jnp.arange(code_bits, dtype=tokens.dtype)) & 1
    return bits.astype(jnp.float32) * 2 - 1


def split_tokens(tokens: Int[Array, "*batch"], code_bits: int, vocabularies: int) -> Int[Array, "*batch n"]:
    """Splits tokens into sub-tokens, one per factorised vocabulary; vocabulary 0 has the lowest bits."""
    width = code_bits // vocabularies
    shifts = jnp.arange(vocabularies, dtype=tokens.dtype) * width
    return (tokens[..., None] >> shifts) & (2**width - 1)


def merge_tokens(sub_tokens: Int[Array, "*batch n"], code_bits: int) -> Int[Array, "*batch"]:
    """Merges sub-tokens into tokens; the inverse of :func:`split_tokens`."""
    vocabularies = sub_tokens.shape[-1]
    shifts = jnp.arange(vocabularies, dtype=sub_tokens.dtype) * (code_bits // vocabularies)
    return jnp.sum(sub_tokens << shifts, axis=-1, dtype=sub_tokens.dtype)


def token_cross_entropy(
    logits: Float[Array, "B T S n V"], tokens: Int[Array, "B T H W"], code_bits: int
) -> Float[Array, "B T H W"]:
    """Returns -log p of each cell's token: the sum of its vocabularies' cross-entropies, in nats."""
    sub_tokens = split_tokens(tokens, code_bits, logits.shape[-2]).reshape(logits.shape[:-1])
    chosen = jnp.take_along_axis(logits, sub_tokens[..., None], axis=-1)[..., 0]
    return jnp.sum(jax.nn.logsumexp(logits, axis=-1) - chosen, axis=-1).reshape(tokens.shape)


def vocabulary_codes(code_bits: int, vocabularies: int) -> Float[Array, "V d"]:
    """Returns the code bits in {-1, +1} of every entry of one factorised vocabulary, d = D/n."""
    width = code_bits // vocabularies
    return tokens_to_codes(jnp.arange(2**width, dtype=jnp.int32), width)


def mean_codes(logits: Float[Array, "*batch n V"], code_bits: int) -> Float[Array, "*batch D"]:
    """Returns ŝ of Eq. 5: each bit's expectation in [-1, 1] under the predicted distribution."""
    codes = vocabulary_codes(code_bits, logits.shape[-2])
    expected = jax.nn.softmax(logits, axis=-1) @ codes
    return expected.reshape(*expected.shape[:-2], code_bits)


def code_shares(codes: Float[Array, "*batch D"], vocabularies: int) -> Float[Array, "*batch n V"]:
    """Returns each sub-token's probability if a code's bits are independent and have these means in [-1, 1]."""
    bits = codes.reshape(*codes.shape[:-1], vocabularies, 1, -1)
    return jnp.prod((1 + bits * vocabulary_codes(codes.shape[-1], vocabularies)) / 2, axis=-1)


def commitment_loss(latents: Float[Array, "*batch D"]) -> Scalar:
    """Returns mean((x - sg(q))²), float32, which keeps the latents near their codes."""
    latents = latents.astype(jnp.float32)
    return jnp.mean(jnp.square(latents - jax.lax.stop_gradient(quantize(latents))))


def entropy_loss(
    latents: Float[Array, "*batch D"],
    temperature: float,
    offset: float = 1e-5,
    total: Callable[[Any], Any] = lambda x: x,
) -> Scalar:
    """Returns the mean entropy of a token's code minus the entropy of the batch's average code, in nats.

    It is exact over all 2^D codes without an array of N × 2^D: code c has probability ∝ exp(2·x·c/τ), so its bits are
    independent with p_d = σ(4·x_d/τ), the first term is a sum of binary entropies, and the average over the batch is a
    product of two tables of 2^(D/2) half-codes. Everything is float32, products included.

    Args:
        offset: added to the average code's probabilities p in log p, 1e-5 in the reference; 0 gives the true entropy.
            It matters at 18 bits, where most of the 262,144 codes are rarer than 1e-5: the gradient's cosine to that
            of the true entropy is 0.8 to 0.95 for 16,384 tokens (latents of scale 0.05 to 1), for 64 even negative.
        total: adds arrays over devices. The average code covers all devices' tokens, the mean entropy only this one's.
    """
    logits = 4.0 * latents.reshape(-1, latents.shape[-1]).astype(jnp.float32) / temperature  # (N, D)
    log_one = jax.nn.log_sigmoid(logits)
    log_zero = jax.nn.log_sigmoid(-logits)
    per_token = -jnp.sum(jnp.exp(log_one) * log_one + jnp.exp(log_zero) * log_zero, axis=-1)

    half = logits.shape[-1] // 2
    low, high = (_code_probabilities(log_one[:, s], log_zero[:, s]) for s in (slice(half), slice(half, None)))
    average = total(_product(high.T, low)) / total(jnp.float32(logits.shape[0]))  # (2^(D-half), 2^half)
    # Without the floor the gradient of 0·log 0 is undefined.
    of_average = -jnp.sum(average * jnp.log(jnp.maximum(average + offset, 1e-20)))
    return jnp.mean(per_token) - of_average


def _code_probabilities(log_one: Float[Array, "N d"], log_zero: Float[Array, "N d"]) -> Float[Array, "N V"]:
    ones = (vocabulary_codes(log_one.shape[-1], 1) + 1) / 2  # (V, d) in {0, 1}
    return jnp.exp(_product(log_one, ones.T) + _product(log_zero, (1 - ones).T))


def _product(left: Float[Array, "a b"], right: Float[Array, "b c"]) -> Float[Array, "a c"]:
    # Accelerators round the operands by default.
    return jnp.matmul(left, right, precision=jax.lax.Precision.HIGHEST)
