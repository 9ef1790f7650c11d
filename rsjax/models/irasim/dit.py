"""IRASim's transformer, which predicts the noise from a clip's noisy latents and actions.

Axes: B clips, T frames (t: T, or 1 for all), h×w cells of latents with C channels, S tokens of a frame, D width, A
action inputs.
"""

from dataclasses import dataclass, fields
from functools import partial

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from rsjax.config import Config
from rsjax.layers.attention import attend
from rsjax.layers.dense import Dense
from rsjax.layers.partition import gathers
from rsjax.layers.platform import attend_cells
from rsjax.models.diffusion.layers import TIME_CHANNELS, TimeEmbedding, grid_positions, modulate, positions
from rsjax.models.irasim.config import DiTConfig, IRASimConfig
from rsjax.trainable import Params

XAVIER = nn.initializers.xavier_uniform()
ZEROS = nn.initializers.zeros
Tokens = Float[Array, "B T S D"]
Condition = Float[Array, "B t 1 D"]


@dataclass(frozen=True)
class Architecture(DiTConfig):
    """All settings of the network.

    Attributes:
        frames: frames that the network processes at once.
        rows, columns: rows and columns of cells in a frame's latents.
        channels: channels of the latents of RGB.
        depth: whether as many channels of depth follow them.
        action_inputs: numbers of an action and, with ``integrate_actions``, of the sum of actions so far.
    """

    frames: int = 16
    rows: int = 32
    columns: int = 32
    channels: int = 4
    depth: bool = False
    action_inputs: int = 7

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of a frame's tokens."""
        return self.rows // self.patch_size, self.columns // self.patch_size

    @property
    def inputs(self) -> int:
        """Channels of the input: RGB's latents and, with ``depth``, those of depth."""
        return self.channels * (1 + self.depth)

    @property
    def outputs(self) -> int:
        """Channels of the output: the noise and, with ``learn_sigma``, variances."""
        return self.inputs * (1 + self.learn_sigma)

    @property
    def clip_mlp(self) -> bool:
        """Whether actions are encoded one by one and then all together, as in Language-Table's Video-Ada."""
        return self.conditioning == "video" and self.action_activation == "none"


def architecture(config: Config) -> Architecture:
    """Returns the architecture of a configuration whose model is IRASim."""
    model = config.model
    clips = config.clips
    assert isinstance(model, IRASimConfig)
    side = clips.image_size // model.autoencoder.downsampling
    return Architecture(
        **{field.name: getattr(model, field.name) for field in fields(DiTConfig)},
        frames=clips.frames,
        rows=side,
        columns=side,
        channels=model.autoencoder.latent_channels,
        depth=model.uses_depth,
        action_inputs=clips.action_dim * (1 + model.integrate_actions),
    )


class DiTBlock(nn.Module):
    """Attention along one axis of tokens, then an MLP, each with adaptive LayerNorm and gate (adaLN-Zero)."""

    config: Architecture
    over_time: bool

    @nn.compact
    def __call__(self, x: Tokens, condition: Condition) -> Tokens:
        cfg = self.config
        dense = partial(Dense, bf16=cfg.compute_dtype == "bfloat16", kernel_init=XAVIER)
        ada = nn.Dense(6 * cfg.width, kernel_init=ZEROS, name="ada")(nn.silu(condition))
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = jnp.split(ada, 6, axis=-1)
        qkv = dense(3 * cfg.width, name="qkv")(modulate(x, shift_a, scale_a))
        q, k, v = (y.reshape(*y.shape[:-1], cfg.heads, -1) for y in jnp.split(qkv, 3, axis=-1))
        if self.over_time:
            out = attend(q.swapaxes(1, 2), k.swapaxes(1, 2), v.swapaxes(1, 2), None).swapaxes(1, 2)
        else:
            out = attend_cells(q, k, v, cfg.compute_dtype == "bfloat16")
        x = x + gate_a * dense(cfg.width, name="proj")(out.reshape(x.shape))
        hidden = dense(cfg.mlp_ratio * cfg.width, name="fc1")(modulate(x, shift_m, scale_m))
        return x + gate_m * dense(cfg.width, name="fc2")(nn.gelu(hidden, approximate=True))


class Pair(nn.Module):
    """A block within frames, then a block over time; ``nn.scan`` prescribes the signature."""

    config: Architecture

    @nn.compact
    def __call__(
        self, x: Tokens, conditions: tuple[Condition, Condition], first: Bool[Array, ""]
    ) -> tuple[Tokens, None]:
        cfg = self.config
        x = DiTBlock(cfg, over_time=False, name="spatial")(x, conditions[0])
        x = x + jnp.where(first, positions(cfg.frames, cfg.width)[:, None], 0.0)
        return DiTBlock(cfg, over_time=True, name="temporal")(x, conditions[1]), None


class DiT(nn.Module):
    """The network."""

    config: Architecture

    @nn.compact
    def __call__(
        self,
        latents: Float[Array, "B T h w C"],
        t: Int[Array, " B"],
        actions: Float[Array, "B T A"],
        drop: Bool[Array, " B"] | None = None,
    ) -> Float[Array, "B T h w C"]:
        """Returns the noise in latents at step ``t``.

        Args:
            latents: noisy, except in known frames.
            t: step of the forward process.
            actions: row t led to frame t; row 0 is not read.
            drop: clips whose actions are replaced by the learned embedding.
        """
        cfg = self.config
        if latents.shape[2:] != (cfg.rows, cfg.columns, cfg.inputs) or latents.shape[1] > cfg.frames:
            raise ValueError(f"latents are {latents.shape[1:]}, not {(cfg.frames, cfg.rows, cfg.columns, cfg.inputs)}")
        patch = (cfg.patch_size, cfg.patch_size)
        x = nn.Conv(cfg.width, patch, patch, "VALID", kernel_init=XAVIER, name="patches")(latents)
        x = x.reshape(*x.shape[:2], -1, cfg.width) + grid_positions(*cfg.grid, cfg.width)
        time = TimeEmbedding(cfg.width, name="time")(t)[:, None, None]
        acted = time + self._action(actions, drop)[:, :, None]
        # In the public Frame-Ada model the last layer does not see the actions. This is an oversight, but the public
        # weights were trained so.
        plain = time
        last = time
        if cfg.conditioning == "video":
            plain = acted
        if cfg.conditioning == "video" or cfg.final_frame_ada:
            last = acted
        pair = gathers(Pair)
        if cfg.remat == "blocks":
            pair = nn.remat(pair, prevent_cse=cfg.unroll > 1)
        pairs = cfg.blocks // 2
        scan = nn.scan(
            pair,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=(nn.broadcast, 0),
            unroll=min(cfg.unroll, pairs),
            check_constancy_invariants=False,  # else, the blocks are traced twice
        )
        x, _ = scan(cfg, name="blocks")(x, (acted, plain), jnp.arange(pairs) == 0)
        ada = nn.Dense(2 * cfg.width, kernel_init=ZEROS, name="final_ada")(nn.silu(last))
        shift, scale = jnp.split(ada, 2, axis=-1)
        p = cfg.patch_size
        x = nn.Dense(p**2 * cfg.outputs, kernel_init=ZEROS, name="final")(modulate(x, shift, scale))
        x = x.reshape(*x.shape[:2], *cfg.grid, p, p, cfg.outputs).swapaxes(3, 4)
        return x.reshape(*x.shape[:2], cfg.rows, cfg.columns, cfg.outputs)[..., : cfg.inputs]

    def _action(self, actions: Float[Array, "B T A"], drop: Bool[Array, " B"] | None) -> Float[Array, "B t D"]:
        """Returns the embedding of the actions: one for each frame, or one for all."""
        cfg = self.config
        unknown = self.param("unknown_action", nn.initializers.normal(1.0), (1, cfg.width))  # torch's default
        known = actions[:, 1:]
        dense = partial(nn.Dense, kernel_init=XAVIER)
        if cfg.conditioning == "video" and not cfg.clip_mlp:
            known = known.reshape(len(known), 1, -1)
        x = dense(cfg.mlp_ratio * cfg.width, name="action_fc1")(known)
        if cfg.action_activation == "gelu":
            x = nn.gelu(x, approximate=True)
        x = dense(cfg.width, name="action_fc2")(x)
        if cfg.clip_mlp:
            x = x.reshape(len(x), 1, -1)
            x = dense(cfg.width, name="clip_fc2")(nn.gelu(dense(x.shape[-1], name="clip_fc1")(x), approximate=True))
        if cfg.conditioning == "frame":
            x = jnp.concatenate([jnp.broadcast_to(unknown, (len(x), 1, cfg.width)), x], axis=1)
        if drop is None:
            return x
        return jnp.where(drop[:, None, None], unknown, x)

    def init_params(self, key: Key[Array, ""]) -> Params:
        """Returns initial parameters, with which the network predicts zeros."""
        cfg = self.config
        latents = jnp.zeros((1, cfg.frames, cfg.rows, cfg.columns, cfg.inputs))
        actions = jnp.zeros((1, cfg.frames, cfg.action_inputs))
        return self.init(key, latents, jnp.zeros(1, jnp.int32), actions)["params"]


def forward_flops(config: Architecture) -> int:
    """Returns the floating-point operations of one pass over a clip: its matrix products, 2·m·n·k each."""
    width = config.width
    cells = config.grid[0] * config.grid[1]
    frames = config.frames
    linear = (4 + 2 * config.mlp_ratio) * width**2  # qkv, proj, fc1, fc2
    attention = (cells + frames) * width  # scores and weighted sums, averaged over both kinds of blocks
    patches = 2 * config.patch_size**2 * config.inputs * width
    acted = frames
    rows = frames - 1  # of actions that the encoder takes one by one
    inputs = config.action_inputs
    joint = 0
    if config.conditioning == "video":
        acted = 1
    if config.clip_mlp:
        joint = rows * width * (rows * width + width)
    elif config.conditioning == "video":
        inputs = rows * config.action_inputs
        rows = 1
    conditions = config.blocks // 2 * (acted + 1) * 6 * width**2 + 2 * width**2 + (TIME_CHANNELS + width) * width
    encoder = rows * config.mlp_ratio * width * (inputs + width) + joint
    return 2 * (frames * cells * (config.blocks * (linear + attention) + patches) + conditions + encoder)
