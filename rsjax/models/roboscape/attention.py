"""Attention of a spatial-temporal block: within a frame (bidirectional), and over time (causal, with an exact cache).

Axes: B clips, T frames, S cells of a frame, C width, h heads, e = C/h head width, q queries, k keys.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.attention import KeyValues, attend, attend_few, frames_held, packed, unpacked
from rsjax.layers.dense import Dense, layer_norm
from rsjax.layers.platform import attend_in_clip
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.rotary import rotated


class Attention(nn.Module):
    """Multi-head attention with its projections. Rows of the qkv projection are (3, heads, head width)."""

    config: Architecture

    def setup(self) -> None:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        self.qkv = Dense(3 * cfg.width, bf16, use_bias=False)
        self.proj = Dense(cfg.width, bf16)
        if cfg.public.qk_norm:
            self.norm = layer_norm(None, cfg.feature_dtype)

    def spatial(self, x: Float[Array, "B T S C"]) -> Float[Array, "B T S C"]:
        """Lets every cell attend to all cells of its frame."""
        out = attend_in_clip(self._project(x), "cells", self.config.compute_dtype == "bfloat16")
        return self.proj(out.reshape(x.shape))

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
        qkv = self._project(x)
        positions = start + jnp.arange(x.shape[1])
        qkv = rotated(cfg.departures, qkv, positions)
        if cache is None and x.shape[1] <= cfg.frames:
            out = attend_in_clip(qkv, "frames", cfg.compute_dtype == "bfloat16")
            return self.proj(out.reshape(x.shape)), None
        q, k, v = unpacked(qkv)
        if cache is None:
            q, k, v = (y.swapaxes(1, 2) for y in (q, k, v))
            out = attend(q, k, v, self._sees(positions, positions)).swapaxes(1, 2)
            return self.proj(out.reshape(x.shape)), None
        frames = x.shape[1]
        slots = cache.k.shape[-2]
        if frames > slots:
            raise ValueError(f"{frames} frames do not fit a cache of {slots}")
        q, k, v = (y.transpose(0, 2, 3, 1, 4) for y in (q, k, v))  # B S h T e
        new = KeyValues(k, v)
        sees = (self._sees(positions, frames_held(slots, start - 1)), self._sees(positions, positions))
        out = attend_few(q, [(cache, sees[0]), (new, sees[1])]).transpose(0, 3, 1, 2, 4).astype(x.dtype)
        return self.proj(out.reshape(x.shape)), new

    def _sees(self, queries: Int[Array, " q"], keys: Int[Array, " k"]) -> Bool[Array, "q k"]:
        age = queries[:, None] - keys[None, :]
        return (age >= 0) & (age < self.config.frames) & (keys >= 0)

    def _project(self, x: Float[Array, "B T S C"]) -> Float[Array, "B T S 3 h e"]:
        cfg = self.config
        qkv = self.qkv(x).reshape(*x.shape[:-1], 3, cfg.heads, cfg.head_width)
        if not (cfg.public.qk_norm or cfg.public.mup):
            return qkv
        q, k, v = unpacked(qkv)
        if cfg.public.qk_norm:
            q = self.norm(q)
            k = self.norm(k)
        if cfg.public.mup:
            # Together with attend's 1/√e this scales by 8/e, after the norm as in the public code.
            q = q * (8 * cfg.head_width**-0.5)
        return packed(q, k, v)
