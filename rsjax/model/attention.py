"""Multi-head attention over the cells of a frame (bidirectional) and over time (causal, with an exact cache).

Axes: B clips, T frames, S cells of a frame, C width, h heads, e = C/h head width, q queries, k keys.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from rsjax.model.matmul import matmul_bf16

# torch's default for linear layers, U(±1/√fan_in), which the public weights were trained from.
TORCH_KERNEL = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


@struct.dataclass
class KeyValues:
    """Temporal keys and values of one branch; with a leading axis over blocks where all blocks' are held."""

    k: Float[Array, "*L B T S C"]
    v: Float[Array, "*L B T S C"]


class Dense(nn.Module):
    """A linear layer with float32 parameters; ``bf16`` multiplies in bf16 and accumulates in float32."""

    features: int
    bf16: bool = False
    use_bias: bool = True
    kernel_init: nn.initializers.Initializer = TORCH_KERNEL

    @nn.compact
    def __call__(self, x: Float[Array, "*N K"]) -> Float[Array, "*N M"]:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        if self.bf16:
            out = matmul_bf16(x.reshape(-1, x.shape[-1]), kernel).reshape(*x.shape[:-1], self.features)
        else:
            out = x @ kernel
        return out + self.param("bias", nn.initializers.zeros, (self.features,)) if self.use_bias else out


def attend(
    q: Float[Array, "*N q h e"],
    k: Float[Array, "*N k h e"],
    v: Float[Array, "*N k h e"],
    mask: Bool[Array, "q k"] | None,
) -> Float[Array, "*N q h e"]:
    """softmax(q·kᵀ/√e)·v over the keys that ``mask`` allows; the softmax in float32."""
    scores = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
    if mask is not None:
        scores = jnp.where(mask, scores, jnp.finfo(jnp.float32).min)
    weights = jax.nn.softmax(scores, axis=-1).astype(v.dtype)
    return jnp.einsum("...hqk,...khe->...qhe", weights, v)


class Attention(nn.Module):
    """Projections around :func:`attend`. Rows of the qkv projection: (3, heads, head width)."""

    width: int
    heads: int
    bf16: bool = False

    def setup(self) -> None:
        self.qkv = Dense(3 * self.width, self.bf16, use_bias=False)
        self.proj = Dense(self.width, self.bf16)

    def spatial(self, x: Float[Array, "B T S C"]) -> Float[Array, "B T S C"]:
        """Every cell attends to every cell of its own frame."""
        q, k, v = (self._heads(y) for y in jnp.split(self.qkv(x), 3, axis=-1))
        return self.proj(attend(q, k, v, None).reshape(x.shape))

    def temporal(
        self, x: Float[Array, "B T S C"], start: Any = 0, cache: KeyValues | None = None
    ) -> tuple[Float[Array, "B T S C"], KeyValues | None]:
        """Every cell attends to the same cell in its own and earlier frames.

        Args:
            x: frames start … start + T - 1.
            start: position of x's first frame (may be traced).
            cache: keys and values of the frames before ``start``; what it holds from ``start`` on is replaced by x's.

        Returns:
            The output, and the cache with x's keys and values written in (None where none was given).
        """
        q, k, v = jnp.split(self.qkv(x), 3, axis=-1)
        if cache is not None:
            put = lambda held, new: jax.lax.dynamic_update_slice_in_dim(held, new.astype(held.dtype), start, axis=1)  # noqa: E731
            cache = KeyValues(put(cache.k, k), put(cache.v, v))
            k, v = cache.k, cache.v
        positions = start + jnp.arange(x.shape[1])
        mask = jnp.arange(k.shape[1])[None, :] <= positions[:, None]
        q, k, v = (self._heads(y.swapaxes(1, 2)) for y in (q, k, v))  # B S T h e
        out = attend(q, k, v, mask).swapaxes(1, 2)
        return self.proj(out.reshape(x.shape)), cache

    def _heads(self, x: Float[Array, "*N C"]) -> Float[Array, "*N h e"]:
        return x.reshape(*x.shape[:-1], self.heads, self.width // self.heads)
