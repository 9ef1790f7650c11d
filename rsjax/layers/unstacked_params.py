"""Splits stacks over the blocks of a network into the blocks' parts, for loops that run the network many times.

Networks scan over their blocks, whose parameters and caches are stacked along a leading axis. A loop around the
network, such as a rollout, then copies each block's part out of the stacks in every pass: that took more than half of
the time that iVideoGPT needs to sample a token. XLA removes the slices of a stack whose parts it knows. So where the
scan is fully unrolled, parts that are split before the loop and stacked inside it are read in place, without a copy.
"""

from typing import Any

import jax
import jax.numpy as jnp


def unstack_params(stacks: Any, blocks: int, unroll: int) -> Any:
    """Returns a list of the blocks' parts of a tree of stacks; the tree itself if the scan is not fully unrolled."""
    if unroll < blocks:
        return stacks
    # Without the barrier XLA puts the slices back into the loop.
    return jax.lax.optimization_barrier([block_part(stacks, i) for i in range(blocks)])


def stack_params(parts: Any) -> Any:
    """Returns the tree of stacks; the inverse of :func:`unstack_params`."""
    return jax.tree.map(lambda *each: jnp.stack(each), *parts) if isinstance(parts, list) else parts


def block_part(stacks: Any, number: int) -> Any:
    """Returns one block's part of a tree of stacks."""
    return jax.tree.map(lambda stack: stack[number], stacks)
