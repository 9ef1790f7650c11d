"""Samples later frames token by token, also in rollouts that are longer than a sequence.

Each pass of the network takes one token; the pass of a frame's last token also takes the next frame's slot. A rollout
beyond ``positions`` continues in a new sequence, whose context is the last decoded frames.

Axes: B clips, T frames (the first P are the prompt), c context frames, F later frames, A action inputs, V vocabulary.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt8

from rsjax.clip import Video
from rsjax.devices import divide
from rsjax.layers.attention import KeyValues
from rsjax.layers.unstacked_params import stack_params, unstack_params
from rsjax.models.ivideogpt.autoencoder import ConditionalCodec
from rsjax.models.ivideogpt.config import TopKConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA, empty_cache, folded
from rsjax.trainable import Params


def generate(
    arch: Architecture,
    codec: ConditionalCodec,
    params: Params,
    prompt: UInt8[np.ndarray, "B P H W 3"],
    actions: Float[np.ndarray, "B T A"],
    index: Int[np.ndarray, " B"],
) -> UInt8[np.ndarray, "B T H W 3"]:
    """Returns all frames, the first P as the tokenizer reconstructs them.

    Args:
        actions: inputs of the network; row t led to frame t. T may exceed the frames of a sequence.
        index: each clip's number, which determines its random draws.
    """
    layout = arch.layout
    past = prompt.shape[1]
    lacking = max(0, layout.context - past)  # a prompt shorter than the context is padded with its first frame
    frames = np.concatenate([np.repeat(prompt[:, :1], lacking, axis=1), prompt], axis=1)
    rows = np.concatenate([np.repeat(actions[:, :1], lacking, axis=1), actions], axis=1)
    count = min(rows.shape[1], layout.most_frames)  # frames of a sequence
    encoded_frames = layout.context
    if frames.shape[1] < count:
        encoded_frames = frames.shape[1]
    begin = frames.shape[1] - encoded_frames
    made = []
    # The first sequence is decoded as a whole and usually has all frames of the prompt.
    if begin or frames.shape[1] == rows.shape[1]:
        made.append(codec.decode(codec.encode(Video(frames))).rgb)
    window = frames[:, begin:]
    keys = folded(jnp.broadcast_to(jax.random.key(arch.config.sample.seed), index.shape), jnp.asarray(index))
    while begin + encoded_frames < rows.shape[1]:
        tokens = codec.encode(Video(window))
        used = rows[:, begin : begin + count].copy()  # may be shorter in the last sequence; surplus frames are cut
        if arch.config.integrate_actions:  # sums begin with the sequence, as in training
            used[..., used.shape[-1] // 2 :] -= used[:, :1, used.shape[-1] // 2 :]
        used = np.pad(used, ((0, 0), (0, count - used.shape[1]), (0, 0)))[:, layout.context :]
        sequence = layout.join(tokens["context"], tokens["future"])
        inputs = (sequence, used, folded(keys, jnp.full(len(index), begin)))
        drawn = sample(arch, params, *divide(inputs, params))
        whole = codec.decode({"context": tokens["context"], "future": layout.future(np.asarray(drawn))}).rgb
        if made:
            made.append(whole[:, encoded_frames:])
        else:
            made.append(whole)
        begin = begin + count - layout.context
        encoded_frames = layout.context
        window = whole[:, -layout.context :]
    return np.concatenate(made, axis=1)[:, lacking : rows.shape[1]]


@partial(jax.jit, static_argnums=0)
def sample(
    arch: Architecture,
    params: Params,
    prefix: Int[Array, "B L"],
    actions: Float[Array, "B F A"],
    keys: Key[Array, " B"],
) -> Int[Array, "B N"]:
    """Continues the sequences of given frames, and returns their part after the context: F later frames.

    Args:
        prefix: sequences of the context and possibly of later frames.
        actions: actions of all later frames.
        keys: keys of each clip's draws.
    """
    layout = arch.layout
    clips, begin = prefix.shape
    network = LLaMA(arch)
    later = actions.shape[1] - (begin - layout.first_slot) // layout.per_frame
    end = layout.length(layout.context + actions.shape[1])

    blocks = arch.config.blocks
    unroll = arch.config.unroll
    parts = unstack_params(params["blocks"], blocks, unroll)

    def forward(cache: KeyValues, tokens: Int[Array, "B K"], first: Array | int) -> tuple[KeyValues, Array]:
        whole = params | {"blocks": stack_params(parts)}
        out: Any = network.apply({"params": whole}, tokens, actions, first, cache, skip=tokens.shape[1] - 1)
        logits, new = out
        return new, logits[:, 0]

    def draw(logits: Float[Array, "B V"], place: Array) -> Int[Array, " B"]:
        return pick(arch.config.sample, logits, folded(keys, jnp.full(clips, place)))

    def token(carry: tuple[KeyValues, Array], place: Array) -> tuple[tuple[KeyValues, Array], Array]:
        cache, logits = carry
        drawn = draw(logits, place)
        return forward(cache, drawn[:, None], place), drawn

    def frame(carry: tuple[KeyValues, Array], first: Array) -> tuple[tuple[KeyValues, Array], Array]:
        """Draws the tokens of a frame whose slot is at position ``first``."""
        places = first + 1 + jnp.arange(layout.tokens)
        (cache, logits), drawn = jax.lax.scan(token, carry, places[:-1])
        last = draw(logits, places[-1])
        pair = jnp.stack([last, jnp.full_like(last, layout.slot)], axis=1)
        return forward(cache, pair, places[-1]), jnp.concatenate([pair[None, :, 1], drawn, last[None]])

    # One more position, because a slot follows the last frame too.
    cache = unstack_params(empty_cache(arch, clips, end + 1), blocks, unroll)
    slot = jnp.full((clips, 1), layout.slot, prefix.dtype)
    start = forward(cache, jnp.concatenate([prefix, slot], axis=1), 0)
    slots = begin + layout.per_frame * jnp.arange(later)
    _, drawn = jax.lax.scan(frame, start, slots)
    return jnp.concatenate([prefix[:, layout.first_slot :], drawn.transpose(2, 0, 1).reshape(clips, -1)], axis=1)


def pick(settings: TopKConfig, logits: Float[Array, "B V"], keys: Key[Array, " B"]) -> Int[Array, " B"]:
    """Draws a number for each clip from its ``top_k`` most probable ones; at temperature 0, the most probable one."""
    if settings.temperature == 0:
        return jnp.argmax(logits, axis=-1).astype(jnp.int32)
    if 0 < settings.top_k < logits.shape[-1]:
        least = jax.lax.top_k(logits, settings.top_k)[0][:, -1:]
        logits = jnp.where(logits < least, -jnp.inf, logits)
    return jax.vmap(jax.random.categorical)(keys, logits / settings.temperature).astype(jnp.int32)
