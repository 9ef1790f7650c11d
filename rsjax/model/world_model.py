"""The dual-branch co-autoregressive transformer (paper §2.3, Eq. 2–3) on factorised tokens, in MaskGIT form.

There is no temporal shift: the output at frame t predicts frame t, whose cells are masked at the input, and the action
that led from frame t-1 into frame t is added at frame t.

Axes: B clips, T frames, H×W = S token cells, A action dimensions, n vocabularies of V codes, C width.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.config import ModelConfig
from rsjax.model.attention import Dense, KeyValues
from rsjax.model.blocks import DualBlock, layer_norm
from rsjax.tokenizer import lfq

Cache = dict[str, KeyValues]


class TokenEmbed(nn.Module):
    """Sum of the sub-tokens' embeddings; one learned vector for masked cells."""

    config: ModelConfig

    @nn.compact
    def __call__(self, tokens: Int[Array, "B T S"], mask: Bool[Array, "B T S"]) -> Float[Array, "B T S C"]:
        cfg = self.config
        sub_tokens = lfq.split_tokens(tokens, cfg.code_bits, cfg.vocabularies)
        init = nn.initializers.normal(cfg.embed_std)
        embedded = sum(
            nn.Embed(cfg.vocabulary_size, cfg.width, embedding_init=init, name=f"factored_embed_{k}")(
                sub_tokens[..., k]
            )
            for k in range(cfg.vocabularies)
        )
        mask_embed = self.param("mask_token_embed", nn.initializers.normal(cfg.position_std), (cfg.width,))
        return jnp.where(mask[..., None], mask_embed, embedded)


class WorldModel(nn.Module):
    """Two branches of spatial-temporal blocks; see the module's docstring. ``config.depth=False``: one branch."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        tokens: dict[str, Int[Array, "B T H W"]],
        mask: Bool[Array, "B T H W"],
        actions: Float[Array, "B T A"],
        start: Any = 0,
        cache: Cache | None = None,
    ) -> tuple[dict[str, Float[Array, "B T S n V"]], Cache | None]:
        """Logits of every cell of frames start … start + T - 1, by branch.

        Args:
            tokens: by branch ("rgb", and "depth" if the model has one); read where ``mask`` is False.
            mask: True where the token is hidden, in both branches.
            actions: row t led into frame start + t.
            start: position of the first given frame (may be traced).
            cache: from :func:`empty_cache` or an earlier call; frames before ``start`` are read from it.

        Returns:
            float32 logits by branch, and the cache with these frames written in (None where none was given).
        """
        cfg = self.config
        b, t = mask.shape[:2]
        cells = lambda x: x.reshape(b, t, cfg.grid**2)  # noqa: E731
        init = nn.initializers.normal(cfg.position_std)
        position = self.param("pos_embed", init, (cfg.frames, cfg.grid**2, cfg.width))
        position = jax.lax.dynamic_slice_in_dim(position, start, t, axis=0)
        action = Dense(cfg.width, name="action_encoder")(actions)[:, :, None]
        x = {
            branch: TokenEmbed(cfg, name=f"{branch}_embed")(cells(tokens[branch]), cells(mask)) + action + position
            for branch in branches(cfg)
        }
        blocks = nn.scan(
            DualBlock,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(0, nn.broadcast),
            length=cfg.blocks,
        )
        x, cache = blocks(cfg, name="blocks")(x, cache, start)
        return {branch: self._head(branch, features) for branch, features in x.items()}, cache

    def _head(self, branch: str, x: Float[Array, "B T S C"]) -> Float[Array, "B T S n V"]:
        cfg = self.config
        if cfg.final_norm:
            x = layer_norm(f"{branch}_norm_out")(x)
        bf16 = cfg.compute_dtype == "bfloat16"
        logits = Dense(cfg.vocabularies * cfg.vocabulary_size, bf16, name=f"{branch}_head")(x)
        return logits.reshape(*x.shape[:-1], cfg.vocabularies, cfg.vocabulary_size)

    def init_params(self, key: Array) -> Any:
        """Fresh parameters; blocks are stacked along a leading axis."""
        cfg = self.config
        tokens = jnp.zeros((1, 1, cfg.grid, cfg.grid), jnp.int32)
        actions = jnp.zeros((1, 1, cfg.action_dim))
        return self.init(key, dict.fromkeys(branches(cfg), tokens), tokens == 0, actions)["params"]


def branches(config: ModelConfig) -> tuple[str, ...]:
    """Names of the branches that the model has."""
    return ("rgb", "depth") if config.depth else ("rgb",)


def empty_cache(config: ModelConfig, batch: int, frames: int) -> Cache:
    """A cache of ``frames`` positions for every block and branch: zeros, never read before they are written."""
    shape = (config.blocks, batch, frames, config.grid**2, config.width)
    zeros = jnp.zeros(shape)
    return {branch: KeyValues(zeros, zeros) for branch in branches(config)}
