"""Takes the parameters of stacked blocks apart, for loops that run the network many times.

Networks scan over their blocks' parameters, which are stacked along a leading axis. A loop around the network, such as
a rollout, then copies each block's parameters out of the stacks in every pass: that was more than half of the time in
which iVideoGPT samples a token. XLA drops the slices of a stack whose parts it knows, so where the scan is fully
unrolled, parameters that are taken apart before the loop and stacked in it are read where they lie.
"""

import jax
import jax.numpy as jnp

from rsjax.trainable import Params


def apart(params: Params, blocks: int, unroll: int) -> Params:
    """Returns parameters with ``blocks`` as one entry for each block; as they are if the scan is not fully unrolled."""
    if unroll < blocks:
        return params
    parts = [jax.tree.map(lambda stack, i=i: stack[i], params["blocks"]) for i in range(blocks)]
    return params | {"blocks": jax.lax.optimization_barrier(parts)}  # else XLA puts the slices back into the loop


def together(params: Params) -> Params:
    """Returns parameters with stacked blocks; the inverse of :func:`apart`."""
    if not isinstance(params["blocks"], list):
        return params
    return params | {"blocks": jax.tree.map(lambda *parts: jnp.stack(parts), *params["blocks"])}
