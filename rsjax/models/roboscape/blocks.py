"""Spatial-temporal blocks, and pairs of them with the depth → RGB projection (paper Eq. 3).

Axes: B clips, T frames, S cells, C width.
"""

from typing import Any

import flax.linen as nn
from jaxtyping import Array, Float

from rsjax.layers.attention import Attention, Dense, KeyValues, layer_norm
from rsjax.layers.gelu import gelu
from rsjax.models.roboscape.architecture import Architecture

Features = Float[Array, "B T S C"]


class STBlock(nn.Module):
    """x += Spatial(norm1 x); x += Temporal(x); x += MLP(norm2 x), as in the public Genie.

    The departure ``temporal_norm`` adds a norm before temporal attention; ``config.qk_norm`` removes norm1 and norm2.
    GELU is exact.
    """

    config: Architecture

    @nn.compact
    def __call__(self, x: Features, start: Any, cache: KeyValues | None) -> tuple[Features, KeyValues | None]:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        normed = lambda name, x: x if cfg.qk_norm else layer_norm(name)(x)  # noqa: E731
        x = x + Attention(cfg, name="spatial_attn").spatial(normed("norm1", x))
        before_time = layer_norm("norm_temporal")(x) if cfg.departures.temporal_norm else x
        out, cache = Attention(cfg, name="temporal_attn").temporal(before_time, start, cache)
        x = x + out
        h = Dense(cfg.mlp_ratio * cfg.width, bf16, name="fc1")(normed("norm2", x))
        return x + Dense(cfg.width, bf16, name="fc2")(gelu(h)), cache


class DualBlock(nn.Module):
    """One block of each branch, then h_RGB += W(h_depth) (Eq. 3). Without depth, only the RGB block.

    Inputs and outputs are dicts by branch; the signature is that of ``nn.scan``.
    """

    config: Architecture

    @nn.compact
    def __call__(
        self, x: dict[str, Features], cache: dict[str, KeyValues] | None, start: Any
    ) -> tuple[dict[str, Features], dict[str, KeyValues] | None]:
        cfg = self.config
        out: dict[str, Features] = {}
        new: dict[str, Any] = {}
        for branch, features in x.items():
            branch_cache = None if cache is None else cache[branch]
            out[branch], new[branch] = STBlock(cfg, name=branch)(features, start, branch_cache)
        if "depth" in out:
            # Zero at first, so that pre-trained RGB weights keep their logits.
            bf16 = cfg.compute_dtype == "bfloat16"
            project = Dense(cfg.width, bf16, kernel_init=nn.initializers.zeros, name="depth_to_rgb")
            out["rgb"] = out["rgb"] + project(out["depth"])
        return out, None if cache is None else new
