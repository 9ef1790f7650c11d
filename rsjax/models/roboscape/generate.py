"""Generates videos from pixels to pixels (encodes the prompt, rolls out tokens, decodes them); scores recorded ones."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from rsjax.clip import Video
from rsjax.config import TokenModelConfig
from rsjax.devices import divide
from rsjax.models.base import TeacherForced
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.rollout import Tokens, encode_prompt, rollout, rollout_from
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.tokenizers.codec import Codec
from rsjax.trainable import Params


def generate(
    config: TokenModelConfig,
    arch: Architecture,
    codec: Codec,
    params: Params,
    prompt: Video,
    actions: Float[np.ndarray, "B T A"],
    index: Int[np.ndarray, " B"] | None,
    depth: bool,
) -> Video:
    """Implements :meth:`rsjax.models.base.WorldModel.generate`. T may exceed the trained positions."""
    tokens, has_depth = _prompt(arch, codec, prompt)
    tokens, inputs = divide((tokens, _inputs(config, codec, actions)), params)
    sample, no_depth = config.sample, ~has_depth
    key = jax.random.key(sample.seed)
    made = rollout(arch, sample, params, tokens, inputs, key, index=index, no_depth=no_depth)
    return codec.decode(made, has_depth & depth)


def plan(
    config: TokenModelConfig,
    arch: Architecture,
    codec: Codec,
    params: Params,
    prompt: Video,
    actions: Float[np.ndarray, "N T A"],
    depth: bool,
    last: int | None = None,
) -> Video:
    """Implements :meth:`rsjax.models.base.WorldModel.plan`; the prompt is encoded once.

    Raises:
        ValueError: the candidates' actions into the prompt's frames differ.
    """
    past, n = prompt.rgb.shape[1], len(actions)
    if np.any(actions[:, 1:past] != actions[:1, 1:past]):
        raise ValueError(f"the candidates' actions differ in rows before {past}, which led into the one prompt")
    tokens, has_depth = _prompt(arch, codec, prompt)
    sample, inputs = config.sample, _inputs(config, codec, actions)
    start = encode_prompt(arch, sample, params, tokens, inputs[:1, :past], no_depth=~has_depth)
    key, index = jax.random.key(sample.seed), jnp.zeros(n, jnp.int32)
    made = rollout_from(arch, sample, params, start, inputs[:, past:], key, index)
    if last is not None:
        made = {name: grid[:, -last:] for name, grid in made.items()}
    return codec.decode(made, np.repeat(has_depth & depth, n))


def teacher_forced(
    config: TokenModelConfig,
    arch: Architecture,
    codec: Codec,
    params: Params,
    video: Video,
    actions: Float[np.ndarray, "B T A"],
    past: int,
) -> TeacherForced:
    """Implements :meth:`rsjax.models.base.WorldModel.teacher_forced`. T may exceed the trained positions."""
    tokens, has_depth = _prompt(arch, codec, video)
    if arch.use_depth and "depth" not in tokens:
        tokens["depth"] = jnp.zeros_like(tokens["rgb"])
    tokens, inputs = divide((tokens, _inputs(config, codec, actions)), params)
    return score_tokens(arch, config.sample, params, tokens, inputs, ~has_depth, past)


def _prompt(arch: Architecture, codec: Codec, prompt: Video) -> tuple[Tokens, np.ndarray]:
    """Returns the prompt's tokens by branch (depth if the model and a clip have it), and which clips have depth."""
    video = prompt if arch.use_depth else Video(prompt.rgb)
    return {name: jnp.asarray(grid) for name, grid in codec.encode(video).items()}, video.has_depth


def _inputs(config: TokenModelConfig, codec: Codec, actions: Float[np.ndarray, "B T A"]) -> Float32[Array, "B T A2"]:
    return jnp.asarray(codec.normalization.action_inputs(actions, config.departures.integrate_actions))
