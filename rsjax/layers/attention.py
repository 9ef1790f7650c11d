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
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.frame_attention import attend_in_frames
from rsjax.layers.matmul import matmul
from rsjax.layers.unstacked_params import block_part
from rsjax.models.roboscape.architecture import Architecture

# torch's default for linear layers, U(±1/√fan_in), as in the public code.
TORCH_KERNEL = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
PRODUCT = "product"  # the name of linear layers' outputs in rematerialisation policies
FEW = 2  # frames per pass of a rollout
# From this many cells of a frame, or tokens of a sequence, bf16 products in attention save more time than their
# transposes cost.
LARGE_FRAME = 128


@struct.dataclass
class KeyValues:
    """Temporal keys and values of one branch, of one block or stacked over blocks (axis L).

    Frames come after heads, as the products read them; otherwise every pass would transpose the whole cache.
    """

    k: Float[Array, "*L B S h T e"]
    v: Float[Array, "*L B S h T e"]


class Dense(nn.Module):
    """A linear layer with float32 parameters; with ``bf16`` it multiplies in bf16 and accumulates in float32.

    On a CPU without bf16 units it multiplies in float32 even then.
    """

    features: int
    bf16: bool = False
    use_bias: bool = True
    kernel_init: nn.initializers.Initializer = TORCH_KERNEL

    @nn.compact
    def __call__(self, x: Float[Array, "*N K"]) -> Float[Array, "*N M"]:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        if self.bf16:
            out = matmul(x.reshape(-1, x.shape[-1]), kernel).reshape(*x.shape[:-1], self.features)
        else:
            out = x @ kernel
        out = checkpoint_name(out, PRODUCT)
        return out + self.param("bias", nn.initializers.zeros, (self.features,)) if self.use_bias else out


def layer_norm(name: str | None) -> nn.LayerNorm:
    """Returns a float32 LayerNorm with torch's epsilon."""
    return nn.LayerNorm(epsilon=1e-5, name=name)


def attend(
    q: Float[Array, "*N q h e"],
    k: Float[Array, "*N k h e"],
    v: Float[Array, "*N k h e"],
    mask: Bool[Array, "q k"] | None,
) -> Float[Array, "*N q h e"]:
    """Returns softmax(q·kᵀ/√e)·v over the keys that ``mask`` allows; the softmax is float32."""
    scores = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
    if mask is not None:
        scores = jnp.where(mask, scores, jnp.finfo(jnp.float32).min)
    return jnp.einsum("...hqk,...khe->...qhe", jax.nn.softmax(scores, axis=-1).astype(v.dtype), v)


def attend_parts(
    q: Float[Array, "*N q e"], parts: Sequence[tuple[KeyValues, Bool[Array, "q k"]]]
) -> Float[Array, "*N q e"]:
    """Returns :func:`attend` over the concatenation of several keys and values, each with its mask."""
    scores = []
    for part, mask in parts:
        product = jnp.einsum("...qe,...ke->...qk", q, part.k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
        scores.append(jnp.where(mask, product, jnp.finfo(jnp.float32).min))
    weights = jax.nn.softmax(jnp.concatenate(scores, axis=-1), axis=-1)
    shares = jnp.split(weights, np.cumsum([x.shape[-1] for x in scores])[:-1], axis=-1)
    outs = [
        jnp.einsum("...qk,...ke->...qe", share.astype(part.v.dtype), part.v)
        for share, (part, _) in zip(shares, parts, strict=True)
    ]
    return sum(outs[1:], start=outs[0])


def attend_cells(
    q: Float[Array, "*N S h e"],
    k: Float[Array, "*N S h e"],
    v: Float[Array, "*N S h e"],
    bf16: bool,
    causal: bool = False,
) -> Float[Array, "*N S h e"]:
    """Returns :func:`attend` within each frame or sequence, by our fastest implementation on CPUs, jax's elsewhere.

    Args:
        bf16: whether products may round their operands to bf16.
        causal: whether a query sees only its own key and those before it.
    """
    frames = [x.reshape(-1, *x.shape[-3:]) for x in (q, k, v)]
    if bf16 and jax.default_backend() != "cpu":
        halves = (x.astype(jnp.bfloat16) for x in frames)
        out = jax.nn.dot_product_attention(*halves, is_causal=causal).astype(q.dtype)
    elif bf16 and q.shape[-3] >= LARGE_FRAME:
        out = attend_in_frames(frames[0], frames[1], frames[2], causal)
    else:
        out = attend(frames[0], frames[1], frames[2], jnp.tri(q.shape[-3], dtype=bool) if causal else None)
    return out.reshape(q.shape)


def rotate(x: Float[Array, "B T S h e"], positions: Int[Array, " T"]) -> Float[Array, "B T S h e"]:
    """Applies rotary position embedding: rotates channels i and i + e/2 by position · 10000^(-2i/e), in float32.

    The product of a rotated query and key depends only on the difference of their positions.
    """
    half = x.shape[-1] // 2
    angles = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / half)
    cos, sin = (f(angles)[:, None, None] for f in (jnp.cos, jnp.sin))
    first, second = jnp.split(x, 2, axis=-1)
    return jnp.concatenate([first * cos - second * sin, second * cos + first * sin], axis=-1)


def frames_held(slots: int, last: Int[Array, ""] | int) -> Int[Array, " slots"]:
    """Returns the frame in each slot of a cache after frame ``last`` is written; negative for empty slots."""
    return last - (last - jnp.arange(slots)) % slots


def put_frames(cache: Any, new: Any, start: Any, ring: bool) -> Any:
    """Returns a cache into which new frames from ``start`` on are written; both have a leading axis over blocks.

    Args:
        cache: a tree of :class:`KeyValues`, or :func:`rsjax.layers.unstacked_params.apart` of it.
        new: a tree of the same structure with the new frames.
        ring: whether positions beyond the number of slots wrap around.
    """

    if isinstance(cache, list):
        return [put_frames(old, block_part(new, i), start, ring) for i, old in enumerate(cache)]

    def put(old: Float[Array, "*L B S h N e"], fresh: Float[Array, "*L B S h T e"]) -> Float[Array, "*L B S h N e"]:
        fresh = fresh.astype(old.dtype)
        if not ring:
            return jax.lax.dynamic_update_slice_in_dim(old, fresh, start, axis=-2)
        for i in range(fresh.shape[-2]):  # frame by frame, since the slots may wrap around
            slot = (start + i) % old.shape[-2]
            old = jax.lax.dynamic_update_slice_in_dim(old, fresh[..., i : i + 1, :], slot, axis=-2)
        return old

    return jax.tree.map(put, cache, new)


class Attention(nn.Module):
    """Multi-head attention with its projections. Rows of the qkv projection are (3, heads, head width)."""

    config: Architecture

    def setup(self) -> None:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        self.qkv = Dense(3 * cfg.width, bf16, use_bias=False)
        self.proj = Dense(cfg.width, bf16)
        if cfg.qk_norm:
            self.norm = layer_norm(None)

    def spatial(self, x: Float[Array, "B T S C"]) -> Float[Array, "B T S C"]:
        """Lets every cell attend to all cells of its frame."""
        q, k, v = (self._heads(y) for y in self._project(x))
        return self.proj(attend_cells(q, k, v, self.config.compute_dtype == "bfloat16").reshape(x.shape))

    def temporal(
        self, x: Float[Array, "B T S C"], start: Any = 0, cache: KeyValues | None = None
    ) -> tuple[Float[Array, "B T S C"], KeyValues | None]:
        """Lets every cell attend to the same cell in its own frame and the ``config.frames - 1`` frames before it.

        Args:
            x: frames start … start + T - 1.
            start: position of x's first frame (may be traced).
            cache: keys and values of frames before ``start``, frame f in slot f mod N of N; later frames in it are not
                read. If positions exceed N, slots are reused, which needs N ≥ config.frames + T - 1 so that a frame's
                whole window stays in the cache.

        Returns:
            The output, and x's own keys and values for :func:`put_frames` (None without a cache). Writing them here
            would copy the cache in every block of every pass.

        Raises:
            ValueError: x has more frames than the cache.
        """
        cfg = self.config
        q, k, v = self._project(x)
        positions = start + jnp.arange(x.shape[1])
        if cfg.departures.rotary:
            q, k = (rotate(self._heads(y), positions).reshape(y.shape) for y in (q, k))
        if cache is None:
            q, k, v = (self._heads(y.swapaxes(1, 2)) for y in (q, k, v))
            out = attend(q, k, v, self._sees(positions, positions)).swapaxes(1, 2)
            return self.proj(out.reshape(x.shape)), None
        frames, slots = x.shape[1], cache.k.shape[-2]
        if frames > slots:
            raise ValueError(f"{frames} frames do not fit a cache of {slots}")
        q, new = self._head_major(q), KeyValues(self._head_major(k), self._head_major(v))
        sees = (self._sees(positions, frames_held(slots, start - 1)), self._sees(positions, positions))
        # XLA's CPU backend multiplies one row by each matrix three times as fast as two rows.
        at_once = 1 if frames <= FEW else frames
        outs = [
            attend_parts(
                q[..., i : i + at_once, :], [(cache, sees[0][i : i + at_once]), (new, sees[1][i : i + at_once])]
            )
            for i in range(0, frames, at_once)
        ]
        out = jnp.concatenate(outs, axis=-2).transpose(0, 3, 1, 2, 4)
        return self.proj(out.reshape(x.shape)), new

    def _head_major(self, x: Float[Array, "B T S C"]) -> Float[Array, "B S h T e"]:
        return self._heads(x).transpose(0, 2, 3, 1, 4)

    def _sees(self, queries: Int[Array, " q"], keys: Int[Array, " k"]) -> Bool[Array, "q k"]:
        age = queries[:, None] - keys[None, :]
        return (age >= 0) & (age < self.config.frames) & (keys >= 0)

    def _project(self, x: Float[Array, "*N C"]) -> tuple[Float[Array, "*N C"], ...]:
        q, k, v = jnp.split(self.qkv(x), 3, axis=-1)
        if self.config.qk_norm:
            q, k = (self.norm(self._heads(y)).reshape(y.shape) for y in (q, k))
        if self.config.mup:
            # Together with attend's 1/√e this scales by 8/e, after the norm as in the public code.
            q = q * (8 * self.config.head_width**-0.5)
        return q, k, v

    def _heads(self, x: Float[Array, "*N C"]) -> Float[Array, "*N h e"]:
        return x.reshape(*x.shape[:-1], self.config.heads, self.config.head_width)
