"""Pixels in, pixels out: the tokenizer, the world model and the units of the data around a rollout."""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.clip import Array
from rsjax.config import Config, SampleConfig, from_dict
from rsjax.data.depth_color import color_to_depth, depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.models.roboscape.rollout import encode_prompt, rollout, rollout_from
from rsjax.models.roboscape.world_model import WorldModel, branches
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training.checkpoint import load_weights

Tokens = dict[str, Int[Array, "B T h w"]]

CHUNK = 128  # images per pass of the tokenizer at the most: bounded memory


@dataclass(frozen=True)
class Codec:
    """The trained tokenizer on numpy images: RGB frames and depth maps to token grids and back."""

    config: Config
    params: Any
    units: Normalization

    def encode_rgb(self, frames: UInt8[np.ndarray, "*B H W 3"]) -> Int[np.ndarray, "*B h w"]:
        """Frames 0–255 to tokens."""
        return self._chunked(_encode, frames, 3)

    def encode_depth(self, depth: Float[np.ndarray, "*B H W"]) -> Int[np.ndarray, "*B h w"]:
        """Depth in metres to the tokens of its colour map.

        Raises:
            UserError: the clips of these units have no depth.
        """
        colors = depth_to_color(depth, *self._depth_range(), self.config.tokenizer.depth_scale)
        return self._chunked(_encode, colors.astype(np.uint8), 3)

    def decode_rgb(self, tokens: Int[Array, "*B h w"]) -> UInt8[np.ndarray, "*B H W 3"]:
        """Tokens to frames 0–255."""
        return np.round(self._chunked(_decode, np.asarray(tokens), 2)).astype(np.uint8)

    def decode_depth(self, tokens: Int[Array, "*B h w"]) -> Float32[np.ndarray, "*B H W"]:
        """Tokens of a depth colour map to metres.

        Raises:
            UserError: the clips of these units have no depth.
        """
        near, far = self._depth_range()
        colors = self._chunked(_decode, np.asarray(tokens), 2)
        return color_to_depth(colors, near, far, self.config.tokenizer.depth_scale)

    def _depth_range(self) -> tuple[float, float]:
        if self.units.depth_range is None:
            raise UserError(
                "depth_range is null: none of the clips that this run was trained on has depth, so a depth map has no "
                "tokens; give RGB alone, or train on clips with depth"
            )
        return self.units.depth_range

    def _chunked(self, function: Any, images: np.ndarray, item_axes: int) -> np.ndarray:
        lead, item = images.shape[:-item_axes], images.shape[-item_axes:]
        flat = images.reshape(-1, *item)
        size = min(CHUNK, 2 ** (len(flat) - 1).bit_length())  # few shapes, each compiled once
        out = []
        for start in range(0, len(flat), size):
            chunk = flat[start : start + size]
            padded = np.concatenate([chunk, np.repeat(chunk[-1:], size - len(chunk), axis=0)])
            out.append(np.asarray(function(self.config.tokenizer, self.params, padded))[: len(chunk)])
        joined = np.concatenate(out)
        return joined.reshape(*lead, *joined.shape[1:])


@partial(jax.jit, static_argnums=0)
def _encode(config: Any, params: Any, images: Array) -> Array:
    return Tokenizer(config).apply({"params": params}, images, method="encode")


@partial(jax.jit, static_argnums=0)
def _decode(config: Any, params: Any, tokens: Array) -> Array:
    return Tokenizer(config).apply({"params": params}, tokens, method="decode")


@dataclass(frozen=True)
class Generated:
    """A generated batch; the prompt's frames are the tokenizer's reconstruction of what was given."""

    tokens: Tokens
    rgb: UInt8[np.ndarray, "B T H W 3"]
    # Metres, NaN in clips without depth; None without a depth branch, where no clip has depth, or where not asked for.
    depth: Float32[np.ndarray, "B T H W"] | None


@dataclass(frozen=True)
class Generator:
    """A trained world model with its tokenizer."""

    config: Config
    codec: Codec
    params: Any

    @classmethod
    def load(cls, run: Path) -> "Generator":
        """The generator of a finished run directory.

        Raises:
            UserError: the run is missing, unfinished or damaged.
        """
        config, units = load_config(run), Normalization.load(run / "tokens")
        return cls(config, Codec(config, load_tokenizer(config, run), units), load_world_model(config, run))

    def generate(
        self,
        prompt: Tokens,
        actions: Float[np.ndarray, "B T A"],
        sample: SampleConfig,
        depth: bool = True,
        index: Int[np.ndarray, " B"] | None = None,
        has_depth: Bool[np.ndarray, " B"] | None = None,
    ) -> Generated:
        """The video that follows the prompt under these actions; T may exceed ``model.frames``.

        Args:
            prompt: tokens of the given frames by branch, (B, P, h, w); without "depth", no clip has it.
            actions: in the data's units; row t leads into frame t, row 0 is not used.
            depth: decode depth too; it costs as much as the frames.
            index: each clip's number, which with ``sample.seed`` decides its draws; 0, 1, … if not given.
            has_depth: which clips have depth; the prompt's depth tokens of the others are not read. All, if not given.

        Raises:
            ValueError: ``has_depth`` is not of B clips, or names some where the prompt has no depth.
        """
        given, key = self._given(prompt), jax.random.key(sample.seed)
        has = np.full(len(given["rgb"]), "depth" in given) if has_depth is None else np.asarray(has_depth, bool)
        inputs = self._action_inputs(actions)
        tokens = rollout(self.config.model, sample, self.params, given, inputs, key, index=index, no_depth=~has)
        metres = self._metres(tokens["depth"], has) if depth and "depth" in tokens and has.any() else None
        return Generated(tokens, self.codec.decode_rgb(tokens["rgb"]), metres)

    def _metres(self, tokens: Int[Array, "B T h w"], has: Bool[np.ndarray, " B"]) -> Float32[np.ndarray, "B T H W"]:
        of_some = self.codec.decode_depth(np.asarray(tokens)[has])
        metres = np.full((len(has), *of_some.shape[1:]), np.nan, np.float32)
        metres[has] = of_some
        return metres

    def plan(self, prompt: Tokens, actions: Float[np.ndarray, "N T A"], sample: SampleConfig) -> Tokens:
        """Tokens of the videos that follow one prompt under N action sequences; the prompt is encoded once.

        All candidates draw alike: they differ by their actions alone. ``codec`` decodes those that are worth it.

        Args:
            prompt: tokens of the given frames by branch, (1, P, h, w); without "depth", the clip has none.
            actions: in the data's units; row t leads into frame t, row 0 is not used.

        Raises:
            ValueError: the candidates' actions into the prompt's frames differ.
        """
        given, n = self._given(prompt), len(actions)
        past = given["rgb"].shape[1]
        if np.any(actions[:, 1:past] != actions[:1, 1:past]):
            raise ValueError(f"the candidates' actions differ in rows before {past}, which led into the one prompt")
        inputs = self._action_inputs(actions)
        start = encode_prompt(self.config.model, sample, self.params, given, inputs[:1, :past])
        key, alike = jax.random.key(sample.seed), jnp.zeros(n, jnp.int32)
        return rollout_from(self.config.model, sample, self.params, start, inputs[:, past:], key, alike)

    def _given(self, prompt: Tokens) -> Tokens:
        return {name: jnp.asarray(prompt[name]) for name in branches(self.config.model) if name in prompt}

    def _action_inputs(self, actions: Float[np.ndarray, "B T A"]) -> Float32[Array, "B T A2"]:
        return jnp.asarray(self.codec.units.action_inputs(actions, self.config.model.integrate_actions))


def load_config(run: Path) -> Config:
    """The configuration that a run directory was made with.

    Raises:
        UserError: there is none, it is damaged, or of another version.
    """
    path = run / "config.json"
    if not path.exists():
        raise UserError(f"{path}: missing, so {run} is not a run directory; make one with python -m experiments.train")
    try:
        return from_dict(Config, json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise UserError(
            f"{path}: not a configuration ({error}); the train command of this run writes it again"
        ) from error


def load_tokenizer(config: Config, run: Path) -> Any:
    """The trained tokenizer's parameters."""
    like = jax.eval_shape(Tokenizer(config.tokenizer).init_params, jax.random.key(0))
    return load_weights(run / "tokenizer" / "weights", like)


def load_world_model(config: Config, run: Path) -> Any:
    """The trained world model's parameters."""
    like = jax.eval_shape(WorldModel(config.model).init_params, jax.random.key(0))
    return load_weights(run / "world_model" / "weights", like)
