"""The dual-branch co-autoregressive transformer (paper §2.3, Eq. 2–3) on factorised tokens, as a MaskGIT.

There is no temporal shift: the output at frame t predicts frame t, whose cells are masked at the input, and the action
that led from frame t-1 into frame t is added at frame t.

Axes: B clips, T frames, H×W = S token cells, A action dimensions, n vocabularies of V codes, C width.
"""

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.attention import PRODUCT, Dense, KeyValues, layer_norm, put_frames
from rsjax.layers.gelu import gelu
from rsjax.layers.unstacked_params import together
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.blocks import DualBlock
from rsjax.tokenizers import lfq
from rsjax.trainable import Params

# Each cell's token, or its code: the mean of each bit, in [-1, 1].
Cells = Int[Array, "B T S"] | Float[Array, "B T S D"]
StackedCache = dict[str, KeyValues]  # by branch
Cache = StackedCache | list[StackedCache]  # of all blocks; or of each, split by rsjax.layers.unstacked_params

MUP_WIDTH = 256  # the public code's base width


class TokenEmbed(nn.Module):
    """The sum of the sub-tokens' embeddings, or of their means under a code; one learned vector for masked cells."""

    config: Architecture

    @nn.compact
    def __call__(self, cells: Cells, mask: Bool[Array, "B T S"]) -> Float[Array, "B T S C"]:
        cfg = self.config
        init = nn.initializers.normal(cfg.embed_std)
        tables = [
            nn.Embed(cfg.vocabulary_size, cfg.width, embedding_init=init, name=f"factored_embed_{k}")
            for k in range(cfg.vocabularies)
        ]
        if jnp.issubdtype(cells.dtype, jnp.integer):
            sub_tokens = lfq.split_tokens(cells, cfg.code_bits, cfg.vocabularies)
            embedded = sum(table(sub_tokens[..., k]) for k, table in enumerate(tables))
        else:
            shares, codes = lfq.code_shares(cells, cfg.vocabularies), jnp.arange(cfg.vocabulary_size)
            mean = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)  # a token's code embeds as the token does
            embedded = sum(mean(shares[..., k, :], table(codes)) for k, table in enumerate(tables))
        mask_embed = self.param("mask_token_embed", nn.initializers.normal(cfg.position_std), (cfg.width,))
        return jnp.where(mask[..., None], mask_embed, embedded)


class Transformer(nn.Module):
    """Two branches of spatial-temporal blocks, or the RGB branch alone if ``config.use_depth`` is False."""

    config: Architecture

    @nn.compact
    def __call__(
        self,
        tokens: dict[str, Int[Array, "B T H W"] | Float[Array, "B T H W D"]],
        mask: Bool[Array, "B T H W"],
        actions: Float[Array, "B T A"] | None,
        start: Any = 0,
        cache: Cache | None = None,
        drop_actions: Bool[Array, " B"] | None = None,
        no_depth: Bool[Array, " B"] | None = None,
        previous: dict[str, Cells] | None = None,
    ) -> tuple[dict[str, Float[Array, "B T S n V"]], Cache | None]:
        """Returns logits of every cell of frames start … start + T - 1 by branch, and the cache.

        Args:
            tokens: by branch ("rgb", and "depth" if the model has it), or codes; ignored where ``mask`` is True.
            mask: True for masked cells, in both branches; ``whole_frames`` masks more, see :func:`hidden`.
            actions: row t led into frame start + t; ignored if ``config.action_inputs`` is 0.
            start: position of the first of these frames; may be traced. For learned positions a traced start + T must
                not exceed ``config.frames``, which is not checked.
            cache: from :func:`empty_cache` or an earlier call; frames before ``start`` are read from it.
            drop_actions: True for clips that see the null action instead of their own; needs ``action_dropout``.
            no_depth: True for clips without depth: all their cells are masked in the depth branch. Ignored by a model
                without that branch.
            previous: for ``read_previous``, tokens of the frame before each of these, by branch; those for frame
                0 are not read. If ``start`` is 0, the default is ``tokens`` moved by one frame.

        Returns:
            float32 logits by branch, and the cache with these frames written in (None without a cache).

        Raises:
            ValueError: actions are missing; ``drop_actions`` is passed to a model without a null action; the model has
                no positions for so many frames; or ``previous`` is missing.
        """
        cfg = self.config
        if drop_actions is not None and not cfg.departures.action_dropout:
            raise ValueError("drop_actions needs a model with a null action: model.departures.action_dropout above 0")
        if cfg.departures.read_previous and previous is None and not (isinstance(start, int) and start == 0):
            raise ValueError("the model reads the frame before these, which do not begin a clip: pass previous")
        b, t = mask.shape[:2]
        cells = lambda x: x.reshape(b, t, cfg.grid**2, *x.shape[4:])  # noqa: E731
        init = nn.initializers.normal(cfg.position_std)
        rotary = cfg.departures.rotary  # then the blocks encode time
        if not rotary and t + (start if isinstance(start, int) else 0) > cfg.frames:
            raise ValueError(f"{t} frames from {start} on; the model has learned positions for {cfg.frames}")
        position = self.param("pos_embed", init, (1 if rotary else cfg.frames, cfg.grid**2, cfg.width))
        position = position if rotary else jax.lax.dynamic_slice_in_dim(position, start, t, axis=0)
        shared = position + self._action(actions, drop_actions) if cfg.action_inputs else position
        masks = dict.fromkeys(cfg.branches, cells(hidden(cfg, mask, start)))
        if cfg.use_depth and no_depth is not None:
            masks["depth"] = masks["depth"] | no_depth[:, None, None]  # not in place: the caller owns the mask
        x = {
            branch: TokenEmbed(cfg, name=f"{branch}_embed")(cells(tokens[branch]), masked) + shared
            for branch, masked in masks.items()
        }
        if cfg.departures.read_previous:
            first = (start + jnp.arange(t) == 0)[:, None]
            for branch, before in (previous or {name: shifted(cells(tokens[name])) for name in x}).items():
                absent = jnp.broadcast_to(first, before.shape[:3])
                if branch == "depth" and no_depth is not None:
                    absent = absent | no_depth[:, None, None]
                x[branch] = x[branch] + TokenEmbed(cfg, name=f"{branch}_previous_embed")(before, absent)
        blocks = nn.scan(
            _rematerialised(cfg),
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(0, nn.broadcast),
            length=cfg.blocks,
            unroll=min(cfg.unroll, cfg.blocks),
        )
        new: Any
        x, new = blocks(cfg, name="blocks")(x, together(cache), start)
        if cache is not None:
            cache = put_frames(cache, new, start, rotary)
        return {branch: self._head(branch, features) for branch, features in x.items()}, cache

    def _action(self, actions: Float[Array, "B T A"] | None, drop: Bool[Array, " B"] | None) -> Float[Array, "B T 1 C"]:
        cfg = self.config
        if actions is None:
            raise ValueError(f"the model reads actions ({cfg.action_inputs} numbers a frame), and got none")
        if cfg.action_encoder == "mlp":
            hidden = gelu(Dense(cfg.width, name="action_encoder_fc1")(actions))
            encoded = Dense(cfg.width, kernel_init=nn.initializers.zeros, name="action_encoder_fc2")(hidden)
        else:
            encoded = Dense(cfg.width, name="action_encoder")(actions)
        if cfg.departures.action_dropout:
            null = self.param("null_action", nn.initializers.zeros, (cfg.width,))
            encoded = encoded if drop is None else jnp.where(drop[:, None, None], null, encoded)
        return encoded[:, :, None]

    def _head(self, branch: str, x: Float[Array, "B T S C"]) -> Float[Array, "B T S n V"]:
        cfg = self.config
        if cfg.departures.final_norm:
            x = layer_norm(f"{branch}_norm_out")(x)
        if cfg.mup:
            x = x / (cfg.width / MUP_WIDTH)
        bf16 = cfg.compute_dtype == "bfloat16"
        logits = Dense(cfg.vocabularies * cfg.vocabulary_size, bf16, name=f"{branch}_head")(x)
        return logits.reshape(*x.shape[:-1], cfg.vocabularies, cfg.vocabulary_size)

    def init_params(self, key: Array) -> Params:
        """Returns fresh parameters; blocks are stacked along a leading axis."""
        cfg = self.config
        tokens = jnp.zeros((1, 1, cfg.grid, cfg.grid), jnp.int32)
        actions = jnp.zeros((1, 1, cfg.action_inputs))
        return self.init(key, dict.fromkeys(cfg.branches, tokens), tokens == 0, actions)["params"]


def hidden(config: Architecture, mask: Bool[Array, "B T H W"], start: Any = 0) -> Bool[Array, "B T H W"]:
    """Returns the cells hidden from the network: the masked ones, or with ``whole_frames`` all after a clip's first.

    Args:
        start: position of the first of these frames.
    """
    if not config.departures.whole_frames:
        return mask
    return mask | (start + jnp.arange(mask.shape[1]) > 0)[:, None, None]


def shifted(frames: Cells) -> Cells:
    """Returns the frame before each frame; for the first frame, the frame itself."""
    return jnp.concatenate([frames[:, :1], frames[:, :-1]], axis=1)


def _rematerialised(config: Architecture) -> Any:
    if config.remat == "none":
        return DualBlock
    keep = None if config.remat == "blocks" else jax.checkpoint_policies.save_only_these_names(PRODUCT)
    # Common-subexpression elimination could undo the recomputation within an iteration of the scan, not across
    # iterations.
    return nn.remat(DualBlock, prevent_cse=config.unroll > 1, policy=keep)


def empty_cache(config: Architecture, batch: int, frames: int, dtype: Any = jnp.float32) -> StackedCache:
    """Returns a cache of ``frames`` slots for every block and branch: zeros, never read before they are written."""
    shape = (config.blocks, batch, config.grid**2, config.heads, frames, config.head_width)
    zeros = jnp.zeros(shape, dtype)
    return {branch: KeyValues(zeros, zeros) for branch in config.branches}
