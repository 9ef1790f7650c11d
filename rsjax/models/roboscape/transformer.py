"""The dual-branch co-autoregressive transformer (paper §2.3, Eq. 2–3) on factorised tokens, as a MaskGIT.

There is no temporal shift: the output at frame t predicts frame t, whose cells are masked at the input, and the action
that led from frame t-1 into frame t is added at frame t.

Axes: B clips, T frames, H×W = S token cells, A action dimensions, n vocabularies of V codes, C width, h heads of
e = C/h, q queries, k keys. A small depth branch has c ≤ C channels and s ≤ S cells.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.attention import KeyValues, attend, packed, sees, unpacked
from rsjax.layers.dense import PRODUCT, Dense, NormParameters, layer_norm
from rsjax.layers.gelu import gelu
from rsjax.layers.mlp import feed_forward, mlp
from rsjax.layers.parameters import Norm, parameter
from rsjax.layers.partition import gathers
from rsjax.layers.platform import attend_in_clip, attend_over_cache, in_feature_dtype, known_after, put_frames
from rsjax.layers.unstacked_params import stack_params
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.action_dropout import with_null_action
from rsjax.models.roboscape.departures.adaptive_norms import ActionNorms
from rsjax.models.roboscape.departures.coarse_depth import merged, split, spread
from rsjax.models.roboscape.departures.motion_head import MotionHead
from rsjax.models.roboscape.departures.norms import optional_norm
from rsjax.models.roboscape.departures.read_previous import absent_cells, frame_before
from rsjax.models.roboscape.departures.rotary import rotated
from rsjax.models.roboscape.departures.second_view import SECOND
from rsjax.models.roboscape.departures.state_heads import StateHeads
from rsjax.models.roboscape.departures.whole_frames import hidden
from rsjax.tokenizers import lfq
from rsjax.trainable import Params

# Each cell's token, or its code: the mean of each bit, in [-1, 1].
Cells = Int[Array, "B T S"] | Float[Array, "B T S D"]
StackedCache = dict[str, KeyValues]  # by the blocks' names in a :class:`DualBlock`
Cache = StackedCache | list[StackedCache]  # of all blocks; or of each, split by rsjax.layers.unstacked_params

Features = Float[Array, "B T S C"]

DEPTH = "depth"  # the name of a depth block's output in rematerialisation policies
MUP_WIDTH = 256  # the public code's base width


class TokenEmbed(nn.Module):
    """The sum of the sub-tokens' embeddings, or of their means under a code; one learned vector for masked cells."""

    config: Architecture

    @nn.compact
    def __call__(self, cells: Cells, mask: Bool[Array, "B T S"]) -> Float[Array, "B T S C"]:
        cfg = self.config
        init = nn.initializers.normal(cfg.departures.embedding_std or 1.0)
        tables = [
            nn.Embed(cfg.vocabulary_size, cfg.width, embedding_init=init, name=f"factored_embed_{k}")
            for k in range(cfg.vocabularies)
        ]
        if jnp.issubdtype(cells.dtype, jnp.integer):
            sub_tokens = lfq.split_tokens(cells, cfg.code_bits, cfg.vocabularies)
            embedded = sum(table(sub_tokens[..., k]) for k, table in enumerate(tables))
        else:
            shares = lfq.code_shares(cells, cfg.vocabularies)
            codes = jnp.arange(cfg.vocabulary_size)
            mean = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)  # a token's code embeds as the token does
            embedded = sum(mean(shares[..., k, :], table(codes)) for k, table in enumerate(tables))
        mask_embed = parameter(
            self, "mask_token_embed", nn.initializers.normal(cfg.departures.embedding_std), (cfg.width,)
        )
        return jnp.where(mask[..., None], mask_embed, embedded)


class Attention(nn.Module):
    """Multi-head attention within a frame (bidirectional) or over time (causal, with an exact cache), with projections.

    Rows of the qkv projection are (3, heads, head width).
    """

    config: Architecture

    def setup(self) -> None:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        self.qkv = Dense(3 * cfg.width, bf16, use_bias=False)
        self.proj = Dense(cfg.width, bf16)
        if cfg.public.qk_norm:
            self.norm = layer_norm(None, cfg.feature_dtype)

    def spatial(self, x: Float[Array, "B T S C"], norm: Norm | None) -> Float[Array, "B T S C"]:
        """Lets every cell attend to all cells of its frame, after a LayerNorm with these parameters."""
        out = attend_in_clip(self._project(x, norm), "cells", self.config.compute_dtype == "bfloat16")
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
        q, k, v = unpacked(qkv)
        frames = x.shape[1]
        if cache is not None and frames > cache.k.shape[-2]:
            raise ValueError(f"{frames} frames do not fit a cache of {cache.k.shape[-2]}")
        begins = isinstance(start, int) and start == 0  # no frame in the cache is before these
        if (cache is None or begins) and frames <= cfg.frames:
            out = attend_in_clip(qkv, "frames", cfg.compute_dtype == "bfloat16")
        elif cache is None:
            q, k, v = (y.swapaxes(1, 2) for y in (q, k, v))
            out = attend(q, k, v, sees(positions, positions, cfg.frames)).swapaxes(1, 2)
        else:
            out = attend_over_cache(qkv, cache, start, cfg.frames)
        if cache is None:
            return self.proj(out.reshape(x.shape)), None
        new = KeyValues(*(y.transpose(0, 2, 3, 1, 4) for y in (k, v)))  # B S h T e
        return self.proj(out.reshape(x.shape)), new

    def _project(self, x: Float[Array, "B T S C"], norm: Norm | None = None) -> Float[Array, "B T S 3 h e"]:
        cfg = self.config
        qkv = self.qkv(x, norm).reshape(*x.shape[:-1], 3, cfg.heads, cfg.head_width)
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


class STBlock(nn.Module):
    """x += Spatial(norm1 x); x += Temporal(x); x += MLP(norm2 x), as in the public Genie.

    The departure ``more_norms`` adds a norm before temporal attention; ``public_code.qk_norm`` removes norm1 and norm2.
    With ``action_encoder`` "norms" the embedded actions change the norms. GELU is exact.
    """

    config: Architecture

    @nn.compact
    def __call__(
        self, x: Features, start: Any, cache: KeyValues | None, actions: Float[Array, "B T 1 C"] | None
    ) -> tuple[Features, KeyValues | None]:
        cfg = self.config
        bf16 = cfg.compute_dtype == "bfloat16"
        norm1 = None if cfg.public.qk_norm else NormParameters(name="norm1")(cfg.width)
        norm2 = None if cfg.public.qk_norm else NormParameters(name="norm2")(cfg.width)
        spatial = Attention(cfg, name="spatial_attn").spatial
        temporal = Attention(cfg, name="temporal_attn").temporal
        inner = cfg.public.mlp_ratio * cfg.width
        fc1 = Dense(inner, name="fc1").parameters(cfg.width)
        fc2 = Dense(cfg.width, name="fc2").parameters(inner)
        if actions is None:
            x = x + spatial(x, norm1)
            normed = optional_norm(cfg.departures.more_norms, "norm_temporal", x)
            out, cache = temporal(normed, start, cache)
            return mlp(x + out, norm2, fc1, fc2, bf16), cache
        norm = NormParameters(name="norm_temporal")(cfg.width) if cfg.departures.more_norms else None
        changes = ActionNorms(cfg.width, cfg.departures.more_norms, bf16, name="action_norms")
        over_space, over_time, of_mlp = changes(actions)
        x = x + over_space.after(spatial(over_space.before(x, norm1), None))
        out, cache = temporal(over_time.before(x, norm), start, cache)
        x = x + over_time.after(out)
        return x + of_mlp.after(feed_forward(of_mlp.before(x, norm2), fc1, fc2, bf16)), cache


class DualBlock(nn.Module):
    """One block of each branch, then h_RGB += W(h_depth) (Eq. 3). Without depth, only the RGB block.

    If the depth branch has fewer blocks (``config.depth_blocks``), more RGB blocks follow.

    Inputs and outputs are dicts by branch; the signature is that of ``nn.scan``.
    """

    config: Architecture

    @nn.compact
    def __call__(
        self,
        x: dict[str, Features],
        cache: dict[str, KeyValues] | None,
        start: Any,
        actions: dict[str, Float[Array, "B T 1 C"] | None],
    ) -> tuple[dict[str, Features], dict[str, KeyValues] | None]:
        cfg = self.config
        out: dict[str, Features] = {}
        new: dict[str, Any] = {}
        for branch, features in x.items():
            branch_cache = None if cache is None else cache[branch]
            out[branch], new[branch] = STBlock(cfg.sizes(branch), name=branch)(
                features, start, branch_cache, actions[branch]
            )
        if "depth" in out:
            # The gradient of W needs it; recomputing it would be all that the depth block's MLP runs again for.
            out["depth"] = checkpoint_name(out["depth"], DEPTH)
            # Zero at first, so that pre-trained RGB weights keep their logits.
            bf16 = cfg.compute_dtype == "bfloat16"
            project = Dense(cfg.width, bf16, kernel_init=nn.initializers.zeros, name="depth_to_rgb")
            joining = project(out["depth"])
            if cfg.depth_cells > 1:
                joining = spread(joining, cfg.depth_cells)
            out["rgb"] = out["rgb"] + joining
        for name in cfg.more_rgb:
            block_cache = None if cache is None else cache[name]
            out["rgb"], new[name] = STBlock(cfg, name=name)(out["rgb"], start, block_cache, actions["rgb"])
        return out, None if cache is None else new


class Transformer(nn.Module):
    """Two branches of spatial-temporal blocks (``config.depth`` "branch"), or the RGB branch alone.

    With ``config.depth`` "head" the RGB branch also reads depth tokens, and a second head on its output predicts them.
    Its modalities, what it predicts, are "rgb" and "depth", or "rgb" alone; it reads the same unless ``reads_depth`` is
    False. With ``second_view`` the RGB branch reads and predicts "second", too.
    """

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
        """Returns logits of every cell of frames start … start + T - 1 by modality, and the cache.

        Args:
            tokens: by modality, or codes; ignored where ``mask`` is True.
            mask: True for masked cells, in both modalities; ``whole_frames`` masks more, see
                :mod:`rsjax.models.roboscape.departures.whole_frames`.
            actions: row t led into frame start + t; ignored if ``config.action_inputs`` is 0.
            start: position of the first of these frames; may be traced. For learned positions a traced start + T must
                not exceed ``config.frames``, which is not checked.
            cache: from :func:`empty_cache` or an earlier call; frames before ``start`` are read from it.
            drop_actions: True for clips that see the null action instead of their own; needs ``action_dropout``.
            no_depth: True for clips without depth: all their depth cells are masked. Ignored by a model without depth.
            previous: for ``read_previous``, tokens of the frame before each of these, by modality; those for frame
                0 are not read. If ``start`` is 0, the default is ``tokens`` moved by one frame.

        Returns:
            float32 logits by modality, and the cache with these frames written in (None without a cache).

        Raises:
            ValueError: actions are missing; ``drop_actions`` is passed to a model without a null action; the model has
                no positions for this many frames; or ``previous`` is missing.
        """
        cfg = self.config
        departures = cfg.departures
        if drop_actions is not None and not departures.action_dropout:
            raise ValueError("drop_actions needs a model with a null action: model.departures.action_dropout above 0")
        if departures.read_previous and previous is None and not (isinstance(start, int) and start == 0):
            raise ValueError("the model reads the frame before these, which do not begin a clip: pass previous")
        b, t = mask.shape[:2]
        cells = {name: tokens[name].reshape(b, t, cfg.grid**2, *tokens[name].shape[4:]) for name in cfg.inputs}

        # Eq. 2: the sum of token, action and position embeddings, by branch.
        shared: dict[str, Any] = dict.fromkeys(cfg.branches, self._positions(cfg, "", t, start))
        encoded: dict[str, Any] = dict.fromkeys(cfg.branches, self._action(cfg, "", actions, drop_actions))
        small = cfg.sizes("depth")
        if "depth" in shared and (small.width, small.grid) != (cfg.width, cfg.grid):
            shared["depth"] = self._positions(small, "depth_", t, start)
            encoded["depth"] = self._action(small, "depth_", actions, drop_actions)
        if cfg.action_inputs and cfg.action_encoder != "norms":
            shared = {branch: shared[branch] + encoded[branch] for branch in cfg.branches}
            encoded = dict.fromkeys(cfg.branches)  # the blocks read them no more
        mask = hidden(departures, mask.reshape(b, t, cfg.grid**2), start)
        masks = dict.fromkeys(cfg.inputs, mask)
        if "depth" in masks and no_depth is not None:
            masks["depth"] = mask | no_depth[:, None, None]
        x = {name: self._embed(name, f"{name}_embed", cells[name], masks[name]) for name in cfg.inputs}
        x |= {branch: x[branch] + shared[branch] for branch in cfg.branches}
        if departures.read_previous:
            previous = previous or {name: frame_before(frames) for name, frames in cells.items()}
            for name in cfg.inputs:
                before = previous[name]
                absent = absent_cells(name, before, start, no_depth)
                x[name] = x[name] + self._embed(name, f"{name}_previous_embed", before, absent)
        if cfg.depth == "head" and cfg.reads_depth:
            x["rgb"] = x["rgb"] + x["depth"]
        if cfg.second_view:
            x["rgb"] = x["rgb"] + x[SECOND]
        x = {branch: x[branch] for branch in cfg.branches}
        x = {branch: features.astype(cfg.feature_dtype) for branch, features in x.items()}

        # Both branches' blocks, with Eq. 3 after each pair.
        blocks = nn.scan(
            _rematerialised(cfg),
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(0, nn.broadcast, nn.broadcast),
            length=cfg.groups,
            unroll=min(cfg.unroll, cfg.groups),
            check_constancy_invariants=False,  # else, the blocks are traced twice
        )
        new: Any
        x, new = blocks(cfg, name="blocks")(x, stack_params(cache), start, encoded)
        self.sow("trunk", "rgb", x["rgb"].astype(jnp.float32))  # for run_with_trunk; nothing otherwise
        if cache is not None:
            cache = put_frames(cache, new, known_after(x["rgb"], start), departures.rotary)
        return {name: self._head(name, x.get(name, x["rgb"])) for name in cfg.modalities}, cache

    def _embed(self, modality: str, table: str, cells: Cells, mask: Bool[Array, "B T S"]) -> Float[Array, "B T s c"]:
        """Returns the embeddings of a modality's cells, at the width and the cells of the branch that reads it."""
        cfg = self.config.sizes(modality)
        x = TokenEmbed(cfg, name=table)(cells, mask)
        if cfg.grid == self.config.grid:
            return x
        return Dense(cfg.width, name=f"{table}_merge")(merged(x, self.config.depth_cells))

    def _positions(self, cfg: Architecture, prefix: str, frames: int, start: Any) -> Float[Array, "T S C"]:
        """Returns the embeddings of frames and cells, or with rotary positions those of cells alone, (1, S, C).

        Args:
            prefix: of the parameters' names.
        """
        if not cfg.departures.rotary and frames + (start if isinstance(start, int) else 0) > cfg.frames:
            raise ValueError(f"{frames} frames from {start} on; the model has learned positions for {cfg.frames}")
        learned = 1 if cfg.departures.rotary else cfg.frames
        init = nn.initializers.normal(cfg.departures.embedding_std)
        position = parameter(self, f"{prefix}pos_embed", init, (learned, cfg.grid**2, cfg.width))
        if cfg.departures.rotary:
            return position
        return jax.lax.dynamic_slice_in_dim(position, start, frames, axis=0)

    def _action(
        self, cfg: Architecture, prefix: str, actions: Float[Array, "B T A"] | None, drop: Bool[Array, " B"] | None
    ) -> Float[Array, "B T 1 C"] | None:
        """Returns the learned action embeddings c = E_a(a), for all cells of a frame; None without an encoder."""
        if not cfg.action_inputs:
            return None
        if actions is None:
            raise ValueError(f"the model reads actions ({cfg.action_inputs} numbers a frame), and got none")
        if cfg.action_encoder == "mlp":
            inner = gelu(Dense(cfg.width, name=f"{prefix}action_encoder_fc1")(actions))
            encoded = Dense(cfg.width, kernel_init=nn.initializers.zeros, name=f"{prefix}action_encoder_fc2")(inner)
        else:
            encoded = Dense(cfg.width, name=f"{prefix}action_encoder")(actions)
        if cfg.departures.action_dropout:
            null = parameter(self, f"{prefix}null_action", nn.initializers.zeros, (cfg.width,))
            encoded = with_null_action(encoded, null, drop)
        return encoded[:, :, None]

    def _head(self, modality: str, x: Float[Array, "B T s c"]) -> Float[Array, "B T S n V"]:
        cfg = self.config.sizes(modality)
        coarse = self.config.grid // cfg.grid
        x = optional_norm(cfg.departures.more_norms, f"{modality}_norm_out", x)
        if cfg.public.mup:
            x = x / (cfg.width / MUP_WIDTH)
        bf16 = cfg.compute_dtype == "bfloat16"
        head = Dense(coarse**2 * cfg.vocabularies * cfg.vocabulary_size, bf16, name=f"{modality}_head")
        logits = head(x.astype(jnp.float32))  # bf16 features would round them to three digits
        if coarse > 1:
            logits = split(logits, coarse)
        return logits.reshape(*logits.shape[:-1], cfg.vocabularies, cfg.vocabulary_size)

    def init_params(self, key: Array) -> Params:
        """Returns fresh parameters; blocks are stacked along a leading axis."""
        cfg = self.config
        tokens = jnp.zeros((1, 1, cfg.grid, cfg.grid), jnp.int32)
        actions = jnp.zeros((1, 1, cfg.action_inputs))
        params = self.init(key, dict.fromkeys(cfg.modalities, tokens), tokens == 0, actions)["params"]
        features = jnp.zeros((1, 1, 1, cfg.width))
        if cfg.motion_head:
            params["motion_head"] = MotionHead(parent=None).init(jax.random.fold_in(key, 1), features)["params"]
        if cfg.state_heads:
            params["state_heads"] = StateHeads(parent=None).init(jax.random.fold_in(key, 2), features)["params"]
        return params


def run_transformer(arch: Architecture, params: Params, *inputs: Any, **options: Any) -> Any:
    """Returns what :class:`Transformer` returns; its features have ``compute_dtype`` where that is faster."""

    def run(dtype: Any) -> Any:
        return Transformer(replace(arch, feature_dtype=dtype)).apply({"params": params}, *inputs, **options)

    return in_feature_dtype(arch.compute_dtype, run)


def run_with_trunk(
    arch: Architecture, params: Params, *inputs: Any, **options: Any
) -> tuple[dict[str, Float[Array, "B T S n V"]], Cache | None, Float[Array, "B T S C"]]:
    """Returns what :func:`run_transformer` does, and the float32 features that RGB's head reads."""

    def run(dtype: Any) -> Any:
        network = Transformer(replace(arch, feature_dtype=dtype))
        (logits, cache), kept = network.apply({"params": params}, *inputs, mutable=["trunk"], **options)
        return logits, cache, kept["trunk"]["rgb"][0]

    return in_feature_dtype(arch.compute_dtype, run)


def _rematerialised(config: Architecture) -> Any:
    block = gathers(DualBlock)
    if config.remat == "none":
        return block
    names = {"blocks": (DEPTH,), "products": (DEPTH, PRODUCT)}[config.remat]
    keep = jax.checkpoint_policies.save_only_these_names(*names)
    # Common-subexpression elimination could undo the recomputation within an iteration of the scan, not across
    # iterations.
    return nn.remat(block, prevent_cse=config.unroll > 1, policy=keep)


def empty_cache(config: Architecture, batch: int, frames: int, dtype: Any = jnp.float32) -> StackedCache:
    """Returns a cache of ``frames`` slots for every block and branch: zeros, never read before they are written."""
    cache = {}
    for name in (*config.branches, *config.more_rgb):
        cfg = config.sizes("depth") if name == "depth" else config
        zeros = jnp.zeros((config.groups, batch, cfg.grid**2, cfg.heads, frames, cfg.head_width), dtype)
        cache[name] = KeyValues(zeros, zeros)
    return cache
