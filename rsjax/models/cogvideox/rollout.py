"""Generates videos chunk by chunk: the image of each chunk is the last frame of the chunk before.

Axes: B clips, T frames, P prompt frames, F latent frames of h×w cells with C channels.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt8

from rsjax.clip import Video
from rsjax.devices import divide
from rsjax.models.cogvideox.autoencoder import CausalCodec
from rsjax.models.cogvideox.text import empty_texts, known_tasks, texts_of
from rsjax.models.cogvideox.transformer import Architecture, Transformer
from rsjax.models.diffusion.samplers import denoise, sampler_coefficients
from rsjax.trainable import Params


def rollout(
    arch: Architecture,
    codec: CausalCodec,
    clip_frames: int,
    params: Params,
    prompt: Video,
    frames: int,
    index: Int[np.ndarray, " B"],
) -> UInt8[np.ndarray, "B T H W 3"]:
    """Returns T frames: the P prompt frames as the autoencoder reconstructs them, and what follows the last of them.

    Args:
        clip_frames: frames of a training clip; a chunk adds one frame less.
        index: each clip's number, which determines its noise.
    """
    made = [codec.decode(codec.encode(Video(prompt.rgb))).rgb]
    image = prompt.rgb[:, -1]
    count = len(prompt)
    text = arch.model.text
    texts = texts_of(text, known_tasks(text, prompt.tasks, count), count)
    empty = empty_texts(text, count)
    for number in range(-(-(frames - prompt.rgb.shape[1]) // (clip_frames - 1))):
        key = jax.random.fold_in(jax.random.key(arch.model.sample.seed), number)
        first_latent = codec.images(image)["mean"][:, 0]
        latents = np.asarray(_chunk(arch, params, key, *divide((first_latent, texts, empty, index), params)))
        made.append(codec.decode({"mean": latents}).rgb[:, 1:clip_frames])
        image = made[-1][:, -1]
    return np.concatenate(made, axis=1)[:, :frames]


@partial(jax.jit, static_argnums=0)
def _chunk(
    arch: Architecture,
    params: Params,
    key: Key[Array, ""],
    image: Float[Array, "B h w C"],
    texts: Any,
    empty: Any,
    index: Int[Array, " B"],
) -> Float[Array, "B F h w C"]:
    """Returns the latents of a chunk that begins with an image."""
    cfg = arch.model
    shape = (arch.frames, *image.shape[1:])
    guidance = cfg.sample.guidance
    start = jax.vmap(lambda number: jax.random.normal(jax.random.fold_in(key, number), shape))(index)
    in_channels = cfg.image == "channels"

    def velocity(x: Array, t: Int[Array, ""], text: Array, image: Array) -> Array:
        known = None
        if in_channels:
            known = image
        made: Any = Transformer(arch).apply({"params": params}, x, jnp.full(len(text), t), text, known)
        return made

    def predict(x: Float[Array, "B F h w C"], t: Int[Array, ""]) -> Float[Array, "B F h w C"]:
        if guidance == 1:
            return velocity(x, t, texts, image)
        twice = velocity(jnp.concatenate([x, x]), t, jnp.concatenate([texts, empty]), jnp.concatenate([image, image]))
        with_text, without = jnp.split(twice, 2)
        return without + guidance * (with_text - without)

    def restore(x: Float[Array, "B F h w C"]) -> Float[Array, "B F h w C"]:
        if in_channels:
            return x
        return x.at[:, 0].set(image)

    return denoise(sampler_coefficients(cfg.noise, cfg.sample), predict, start, restore)
