"""Multi-head attention over the cells of a frame (bidirectional) and over time (causal, with an exact cache).

Axes: B clips, T frames, S cells of a frame, C width, h heads, e = C/h head width, q queries, k keys.
"""

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from rsjax.config import ModelConfig
from rsjax.model.frame_attention import attend_in_frames
from rsjax.model.matmul import matmul_bf16

# torch's default for linear layers, U(±1/√fan_in), which the public weights were trained from.
TORCH_KERNEL = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
LARGE_FRAME = 128  # cells per frame from which bf16 products in attention gain more than their transposes cost


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


def layer_norm(name: str | None) -> nn.LayerNorm:
    """LayerNorm with torch's epsilon, in float32."""
    return nn.LayerNorm(epsilon=1e-5, name=name)


def attend(
    q: Float[Array, "*N q h e"],
    k: Float[Array, "*N k h e"],
    v: Float[Array, "*N k h e"],
    mask: Bool[Array, "q k"] | None,
) -> Float[Array, "*N q h e"]:
    """softmax(q·kᵀ/√e)·v over the keys that ``mask`` allows; the softmax in float32."""
    return attend_parts(q, [(k, v, mask)])


def attend_parts(
    q: Float[Array, "*N q h e"], parts: Sequence[tuple[Array, Array, Bool[Array, "q k"] | None]]
) -> Float[Array, "*N q h e"]:
    """:func:`attend` over keys and values that lie in several arrays, each with its mask, as if they were one."""
    scores = []
    for k, _, mask in parts:
        product = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
        scores.append(product if mask is None else jnp.where(mask, product, jnp.finfo(jnp.float32).min))
    weights = jax.nn.softmax(jnp.concatenate(scores, axis=-1), axis=-1)
    ends = np.cumsum([k.shape[-3] for k, _, _ in parts])[:-1]
    shares = zip(jnp.split(weights, ends, axis=-1), parts, strict=True)
    outs = [jnp.einsum("...hqk,...khe->...qhe", share.astype(v.dtype), v) for share, (_, v, _) in shares]
    return sum(outs[1:], start=outs[0])


def attend_cells(
    q: Float[Array, "B T S h e"], k: Float[Array, "B T S h e"], v: Float[Array, "B T S h e"], bf16: bool
) -> Float[Array, "B T S h e"]:
    """:func:`attend` within each frame, in the form that is fastest on this platform."""
    frames = [x.reshape(-1, *x.shape[2:]) for x in (q, k, v)]
    if bf16 and jax.default_backend() != "cpu":
        out = jax.nn.dot_product_attention(*(x.astype(jnp.bfloat16) for x in frames)).astype(q.dtype)
    elif bf16 and q.shape[-3] >= LARGE_FRAME:
        out = attend_in_frames(*frames)
    else:
        out = attend(frames[0], frames[1], frames[2], None)
    return out.reshape(q.shape)


def rotate(x: Float[Array, "B T S h e"], positions: Int[Array, " T"]) -> Float[Array, "B T S h e"]:
    """Rotary position embedding: channels i and i + e/2 of a head turn by position · 10000^(-2i/e), in float32.

    The product of a query and a key so turned depends on their positions' difference alone.
    """
    half = x.shape[-1] // 2
    angles = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / half)
    cos, sin = (f(angles)[:, None, None] for f in (jnp.cos, jnp.sin))
    first, second = jnp.split(x, 2, axis=-1)
    return jnp.concatenate([first * cos - second * sin, second * cos + first * sin], axis=-1)


def frames_held(slots: int, last: Int[Array, ""] | int) -> Int[Array, " slots"]:
    """The frame in each slot of a cache after frame ``last`` is written; negative where none is yet."""
    return last - (last - jnp.arange(slots)) % slots


def put_frames(cache: KeyValues, new: KeyValues, start: Any, ring: bool) -> KeyValues:
    """A cache with the frames from ``start`` on written in; both with a leading axis over blocks, frames on axis 2.

    Args:
        ring: slots are taken over where positions pass their number.
    """

    def put(held: Float[Array, "L B N S C"], fresh: Float[Array, "L B T S C"]) -> Float[Array, "L B N S C"]:
        fresh = fresh.astype(held.dtype)
        if not ring:
            return jax.lax.dynamic_update_slice_in_dim(held, fresh, start, axis=2)
        for i in range(fresh.shape[2]):  # frame by frame, for the slots may go around the end
            slot = (start + i) % held.shape[2]
            held = jax.lax.dynamic_update_slice_in_dim(held, fresh[:, :, i : i + 1], slot, axis=2)
        return held

    return jax.tree.map(put, cache, new)


class Attention(nn.Module):
    """Projections around :func:`attend`. Rows of the qkv projection: (3, heads, head width)."""

    config: ModelConfig

    def setup(self) -> None:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        self.qkv = Dense(3 * cfg.width, bf16, use_bias=False)
        self.proj = Dense(cfg.width, bf16)
        if cfg.qk_norm:
            self.norm = layer_norm(None)

    def spatial(self, x: Float[Array, "B T S C"]) -> Float[Array, "B T S C"]:
        """Every cell attends to every cell of its own frame."""
        q, k, v = (self._heads(y) for y in self._project(x))
        return self.proj(attend_cells(q, k, v, self.config.compute_dtype == "bfloat16").reshape(x.shape))

    def temporal(
        self, x: Float[Array, "B T S C"], start: Any = 0, cache: KeyValues | None = None
    ) -> tuple[Float[Array, "B T S C"], KeyValues | None]:
        """Every cell attends to the same cell in its own frame and the ``config.frames - 1`` before it.

        Args:
            x: frames start … start + T - 1.
            start: position of x's first frame (may be traced).
            cache: keys and values of frames before ``start``, frame f in slot f mod N of N; what it holds from
                ``start`` on is not read. Where positions pass N, slots are taken over, and a frame must still find
                all that it attends to: N ≥ config.frames + T - 1.

        Returns:
            The output, and x's own keys and values, for :func:`put_frames` (None where no cache was given). Writing
            them here would copy the cache in every block of every pass.

        Raises:
            ValueError: x has more frames than the cache.
        """
        cfg = self.config
        q, k, v = self._project(x)
        positions = start + jnp.arange(x.shape[1])
        if cfg.positions == "rotary":
            q, k = (rotate(self._heads(y), positions).reshape(y.shape) for y in (q, k))
        sources = [(KeyValues(k, v), positions)]
        if cache is not None:
            if x.shape[1] > cache.k.shape[1]:
                raise ValueError(f"{x.shape[1]} frames do not fit a cache of {cache.k.shape[1]}")
            sources.insert(0, (cache, frames_held(cache.k.shape[1], start - 1)))
        parts = [(self._over_time(held.k), self._over_time(held.v), self._sees(positions, at)) for held, at in sources]
        out = attend_parts(self._over_time(q), parts).swapaxes(1, 2)
        return self.proj(out.reshape(x.shape)), None if cache is None else KeyValues(k, v)

    def _over_time(self, x: Float[Array, "B T S C"]) -> Float[Array, "B S T h e"]:
        return self._heads(x.swapaxes(1, 2))

    def _sees(self, positions: Int[Array, " q"], held: Int[Array, " k"]) -> Bool[Array, "q k"]:
        age = positions[:, None] - held[None, :]
        return (age >= 0) & (age < self.config.frames) & (held >= 0)

    def _project(self, x: Float[Array, "*N C"]) -> tuple[Float[Array, "*N C"], ...]:
        q, k, v = jnp.split(self.qkv(x), 3, axis=-1)
        if self.config.qk_norm:
            q, k = (self.norm(self._heads(y)).reshape(y.shape) for y in (q, k))
        if self.config.mup:
            # 8/e in all: attend divides by √e. The public code's plain attention scales before the norm, which undoes
            # it; its default, fused one after, as here.
            q = q * (8 * self.config.head_width**-0.5)
        return q, k, v

    def _heads(self, x: Float[Array, "*N C"]) -> Float[Array, "*N h e"]:
        return x.reshape(*x.shape[:-1], self.config.heads, self.config.head_width)
