"""Generates frame by frame from pixels to pixels: one compiled program decodes the tokens, and then their pictures.

Axes: B clips, N of them, A action dimensions.
"""

from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rsjax.clip import Video
from rsjax.config import TokenizerConfig, TokenModelConfig
from rsjax.data.depth_color import color_to_depth
from rsjax.data.normalization import Normalization, with_sums
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.stepping import Network, State, advance, begin, last_frame, restart
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.trainable import Params


class Imagined:
    """Implements :class:`rsjax.models.base.Imagination`. Frames have depth if the model and its training clips have it.

    Raises:
        ConfigError: the model does not support these sampling settings.
    """

    def __init__(self, config: TokenModelConfig, arch: Architecture, codec: Codec, params: Params, clips: int) -> None:
        arch.check_sampling(config.sample)
        self._config, self._codec, self._params = config, codec, params
        self._net = Network(arch, config.sample, codec.normalization.depth_range is not None)
        self._has_depth = arch.use_depth and self._net.has_depth
        self._state = begin(self._net, clips)
        self._sums = np.zeros((clips, len(codec.normalization.action_mean)))

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " N"]) -> Video:
        video = first if self._has_depth else Video(first.rgb)
        found = self._codec.encode(video)
        rows = np.zeros(len(which), int)
        rows[which] = np.arange(len(first))
        tokens = {name: jnp.asarray(grid.reshape(len(first), -1)[rows]) for name, grid in found.items()}
        if self._net.arch.use_depth:
            tokens.setdefault("depth", jnp.zeros_like(tokens["rgb"]))
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(self._config.sample.seed)))(jnp.asarray(index)[rows])
        self._state = restart(self._state, jnp.asarray(which), tokens, keys)
        self._sums[which] = 0
        return self._codec.decode(found, np.full(len(first), self._has_depth))

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        scaled = self._codec.normalization.scaled(actions)
        self._sums += scaled
        rows = with_sums(scaled, self._sums if self._config.departures.integrate_actions else None)
        norm = self._codec.normalization if self._has_depth else None
        self._state, rgb, depth = _step(
            self._net, self._codec.config, norm, self._params, self._codec.params, self._state, rows
        )
        return Video(np.asarray(rgb)[:, None], None if depth is None else np.asarray(depth)[:, None])


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=(5,))
def _step(
    net: Network,
    tokenizer: TokenizerConfig,
    normalization: Normalization | None,
    params: Params,
    tokenizer_params: Params,
    state: State,
    actions: Float[Array, "B A"],
) -> tuple[State, Array, Array | None]:
    """Returns the state after the next frame, and the frame: uint8, and metres if ``normalization`` is given."""
    state = advance(net, params, state, actions)

    def pixels(name: str) -> Array:
        made = last_frame(net, state, name)
        return cast(Array, Tokenizer(tokenizer).apply({"params": tokenizer_params}, made, method="decode"))

    rgb = jnp.round(pixels("rgb")).astype(jnp.uint8)
    if normalization is None or normalization.depth_range is None:
        return state, rgb, None
    return state, rgb, color_to_depth(pixels("depth"), *normalization.depth_range, tokenizer.depth_scale)
