"""Our group normalisation against flax's."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers.group_norm import GroupNorm


@pytest.mark.parametrize(
    ("shape", "groups", "local", "affine"),
    [
        ((3, 5, 8), 1, False, False),
        ((2, 4, 6, 8), 4, False, True),
        ((2, 3, 4, 6, 8), 2, True, True),
    ],
)
def test_results_and_gradients_are_flaxs(shape: tuple[int, ...], groups: int, local: bool, affine: bool) -> None:
    keys = jax.random.split(jax.random.key(0), 4)
    x, weights = 30 + 2 * jax.random.normal(keys[0], shape), jax.random.normal(keys[1], shape)
    scale, bias = jax.random.normal(keys[2], (8,)), jax.random.normal(keys[3], (8,))
    params = {"scale": scale, "bias": bias} if affine else {}
    axes = (-1,) if local else None
    flaxs = nn.GroupNorm(
        groups, epsilon=1e-3, use_scale=affine, use_bias=affine, use_fast_variance=False, reduction_axes=axes
    )
    ours = GroupNorm(groups, 1e-3, affine, local)
    assert jax.tree.map(jnp.shape, ours.init(keys[0], x)) == jax.tree.map(jnp.shape, flaxs.init(keys[0], x))

    def run(layer: nn.Module) -> object:
        def apply(params: dict[str, Any], x: jax.Array) -> Any:
            return layer.apply({"params": params}, x)

        gradient = jax.grad(lambda *inputs: jnp.sum(weights * apply(*inputs)), argnums=(0, 1))
        return apply(params, x), gradient(params, x)

    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=2e-4), run(ours), run(flaxs))
