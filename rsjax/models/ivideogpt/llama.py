"""The LLaMA of iVideoGPT, with actions added at the slots and a cache of keys and values for sampling.

Axes: B clips, L tokens, C width, h heads, e = C/h head width, F later frames, A action inputs, V vocabulary.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from rsjax.config import ClipShape
from rsjax.layers.attention import KeyValues, attend_parts, rotate
from rsjax.layers.dense import Dense
from rsjax.layers.partition import gathers
from rsjax.layers.platform import attend_cells, put_frames
from rsjax.layers.unstacked_params import stack_params
from rsjax.models.ivideogpt.config import IVideoGPTConfig
from rsjax.models.ivideogpt.sequence import Layout
from rsjax.trainable import Params

NORMAL = nn.initializers.normal(0.02)
Hidden = Float[Array, "B L C"]


@dataclass(frozen=True)
class Architecture:
    """All settings of the network.

    Attributes:
        config: the family's settings.
        layout: the layout of its sequences.
        action_inputs: numbers of the action at a slot; 0: the model has no actions.
    """

    config: IVideoGPTConfig
    layout: Layout
    action_inputs: int

    @classmethod
    def create(cls, config: IVideoGPTConfig, clips: ClipShape) -> "Architecture":
        """Returns the network for clips of this shape."""
        inputs = clips.action_dim * (1 + config.integrate_actions) * config.use_actions
        return cls(config, Layout.create(config, clips.image_size), inputs)


class LlamaBlock(nn.Module):
    """x += Attention(norm x); x += SwiGLU(norm x). Norms are RMSNorms, linear layers have no bias."""

    config: IVideoGPTConfig

    @nn.compact
    def __call__(
        self, x: Hidden, scanned: tuple[KeyValues | None, Int[Array, ""]], first: Any, keys: Key[Array, " B"] | None
    ) -> tuple[Hidden, KeyValues | None]:
        """Returns the output and, with a cache, the tokens' own keys and values.

        Args:
            scanned: the cache of this block, and the block's number.
            first: position of the first token.
            keys: of the dropout of each clip; None: no dropout.
        """
        cfg = self.config
        cache, number = scanned
        dense = partial(Dense, bf16=cfg.compute_dtype == "bfloat16", use_bias=False, kernel_init=NORMAL)
        norm = partial(nn.RMSNorm, epsilon=1e-6)
        positions = first + jnp.arange(x.shape[1])
        h = norm(name="input_layernorm")(x)
        q, k, v = (
            dense(cfg.width, name=f"{name}_proj")(h).reshape(*h.shape[:2], cfg.heads, cfg.width // cfg.heads)
            for name in "qkv"
        )
        q, k = (rotate(y[:, :, None], positions)[:, :, 0] for y in (q, k))
        new = None
        if cache is not None:
            q, k, v = (y.swapaxes(1, 2) for y in (q, k, v))  # B h L e
            new = KeyValues(k, v)
            earlier = jnp.broadcast_to(jnp.arange(cache.k.shape[-2]) < first, (x.shape[1], cache.k.shape[-2]))
            out = attend_parts(q, [(cache, earlier), (new, jnp.tri(x.shape[1], dtype=bool))]).swapaxes(1, 2)
        elif keys is not None:
            out = _attend_with_dropout(q, k, v, folded(keys, jnp.full(len(keys), number)), cfg)
        else:
            out = attend_cells(q, k, v, cfg.compute_dtype == "bfloat16", causal=True)
        x = x + dense(cfg.width, name="o_proj")(out.reshape(x.shape))
        h = norm(name="post_attention_layernorm")(x)
        gated = nn.silu(dense(cfg.mlp_width, name="gate_proj")(h)) * dense(cfg.mlp_width, name="up_proj")(h)
        return x + dense(cfg.width, name="down_proj")(gated), new


def folded(keys: Key[Array, " B"], numbers: Int[Array, " B"]) -> Key[Array, " B"]:
    """Folds each clip's number into its key."""
    return jax.vmap(jax.random.fold_in)(keys, numbers)


def _attend_with_dropout(
    q: Float[Array, "B L h e"],
    k: Float[Array, "B L h e"],
    v: Float[Array, "B L h e"],
    keys: Key[Array, " B"],
    config: IVideoGPTConfig,
) -> Float[Array, "B L h e"]:
    """Returns causal softmax(q·kᵀ/√e)·v with dropout of the weights."""
    scores = jnp.einsum("bqhe,bkhe->bhqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
    weights = jax.nn.softmax(jnp.where(jnp.tri(q.shape[1], dtype=bool), scores, jnp.finfo(jnp.float32).min), axis=-1)
    keep = jax.vmap(lambda key: jax.random.bernoulli(key, 1 - config.dropout, weights.shape[1:]))(keys)
    weights = jnp.where(keep, weights / (1 - config.dropout), 0.0)
    return jnp.einsum("bhqk,bkhe->bqhe", weights.astype(v.dtype), v, preferred_element_type=jnp.float32)


class LLaMA(nn.Module):
    """Maps sequences of :mod:`rsjax.models.ivideogpt.sequence` and actions to the logits of the next number."""

    architecture: Architecture

    @nn.compact
    def __call__(
        self,
        tokens: Int[Array, "B L"],
        actions: Float[Array, "B F A"] | None,
        first: Any = 0,
        cache: KeyValues | None = None,
        keys: Key[Array, " B"] | None = None,
        skip: int = 0,
    ) -> tuple[Float[Array, "B M V"], KeyValues | None]:
        """Returns the logits, float32, of the number that follows each token after the first ``skip``, and the cache.

        Args:
            actions: actions that led to the later frames, in order; a model without actions does not read them.
            first: position of the first token; may be traced.
            cache: from :func:`empty_cache` or an earlier call, whole or in parts
                (``layers/unstacked_params.py``); holds the keys and values of tokens before ``first``.
            keys: of the dropout of each clip; None: no dropout.

        Returns:
            The logits, and the cache with these tokens written to it (None without a cache).
        """
        arch = self.architecture
        cfg = arch.config
        layout = arch.layout
        x = nn.Embed(layout.vocabulary, cfg.width, embedding_init=NORMAL, name="embed_tokens")(tokens)
        if arch.action_inputs:
            if actions is None:
                raise ValueError(f"the model reads actions ({arch.action_inputs} numbers a frame), and got none")
            zeros = nn.initializers.zeros
            added = nn.Dense(cfg.width, kernel_init=zeros, bias_init=zeros, name="action_linear")(actions)
            frame, place = jnp.divmod(first + jnp.arange(tokens.shape[1]) - layout.first_slot, layout.per_frame)
            x = x + jnp.where(((frame >= 0) & (place == 0))[:, None], added[:, jnp.maximum(frame, 0)], 0.0)
        block = gathers(LlamaBlock)
        if cfg.remat == "blocks":
            block = nn.remat(block, prevent_cse=cfg.unroll > 1)
        blocks = nn.scan(
            block,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(0, nn.broadcast, nn.broadcast),
            length=cfg.blocks,
            unroll=min(cfg.unroll, cfg.blocks),
            check_constancy_invariants=False,  # else, the blocks are traced twice
        )
        new: Any
        x, new = blocks(cfg, name="blocks")(x, (stack_params(cache), jnp.arange(cfg.blocks)), first, keys)
        x = nn.RMSNorm(epsilon=1e-6, name="norm")(x[:, skip:])
        head = Dense(layout.vocabulary, cfg.compute_dtype == "bfloat16", False, NORMAL, name="lm_head")
        if cache is None:
            return head(x), None
        return head(x), put_frames(cache, new, first, ring=False)

    def init_params(self, key: Array) -> Params:
        """Returns initial parameters; blocks are stacked along a leading axis."""
        return self.init(key, jnp.zeros((1, 1), jnp.int32), jnp.zeros((1, 1, self.architecture.action_inputs)))[
            "params"
        ]


def empty_cache(arch: Architecture, clips: int, length: int) -> KeyValues:
    """Returns a cache of zeros with ``length`` positions for every block; none is read before it is written."""
    cfg = arch.config
    zeros = jnp.zeros((cfg.blocks, clips, cfg.heads, length, cfg.width // cfg.heads), cfg.sample.cache_dtype)
    return KeyValues(zeros, zeros)
