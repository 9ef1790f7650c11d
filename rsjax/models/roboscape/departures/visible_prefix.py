"""In some training clips all frames before a random one stay visible, as past frames are in sampling."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def after_prefix(rate: float, key: Array, frames: int, first_masked: Int[Array, ""]) -> Int[Array, ""]:
    """Returns a clip's first masked frame: later than the batch's in a share ``rate`` of the clips, U{1, …, T-1}."""
    if not rate:
        return first_masked
    happens_key, cut_key = jax.random.split(jax.random.fold_in(key, 0))
    cut = jnp.where(jax.random.bernoulli(happens_key, rate), jax.random.randint(cut_key, (), 1, frames), 1)
    return jnp.maximum(first_masked, cut)
