"""IRASim's transformer against an independent implementation, and by what must and must not change its output."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.models.irasim.dit import Architecture, DiT
from rsjax.tools.convert.irasim import Variant, from_public, to_public
from tests.models.irasim import public

RNG = np.random.default_rng(1)
BATCH = 3
VARIANTS = {
    "frame": public.Network(),
    "video": public.Network(video=True),
    "linear": public.Network(linear=True, actions=2),
    "linear video": public.Network(linear=True, video=True, actions=2),
    "whole": public.Network(final_frame_ada=True, learn_sigma=True),
}


def inputs(net: public.Network) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Latents (B, F, C, h, w), steps, actions (B, F - 1, A), dropped clips."""
    rows, columns = (net.patch * size for size in net.grid)
    latents = RNG.normal(size=(BATCH, net.frames, net.channels, rows, columns)).astype(np.float32)
    actions = RNG.normal(size=(BATCH, net.frames - 1, net.actions)).astype(np.float32)
    return latents, np.array([0, 17, 999]), actions, np.array([False, True, False])


def rows_of(actions: np.ndarray) -> np.ndarray:
    """Actions with row 0, which nobody reads."""
    return np.concatenate([np.full_like(actions[:, :1], 1e3), actions], axis=1)


def variant_of(net: public.Network) -> Variant:
    """What a user tells of a network whose tensors do not reveal it."""
    return Variant(net.heads, "video" if net.video and not net.linear else None, net.final_frame_ada)


@cache
def model(variant: str) -> tuple[Architecture, Any]:
    net = VARIANTS[variant]
    config, params, aside = from_public("file", public.random_weights(net), variant=variant_of(net))
    assert aside == 2
    return config, params


@pytest.mark.parametrize("variant", VARIANTS)
def test_output_is_the_public_networks(variant: str) -> None:
    net = VARIANTS[variant]
    latents, t, actions, drop = inputs(net)
    expected = public.forward(net, public.random_weights(net), latents, t, actions, drop)
    assert expected.std() > 0.3
    config, params = model(variant)
    made: Any = jax.jit(DiT(config).apply)(
        {"params": params}, latents.transpose(0, 1, 3, 4, 2), t, rows_of(actions), drop
    )
    np.testing.assert_allclose(made, expected.transpose(0, 1, 3, 4, 2), atol=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_export_returns_the_public_file(variant: str) -> None:
    tensors = public.random_weights(VARIANTS[variant])
    exported = to_public(*model(variant))
    assert exported.keys() == tensors.keys()
    for name, x in tensors.items():
        assert exported[name].tobytes() == x.tobytes(), name


@pytest.mark.parametrize("grid", [(3, 8), (8, 3), (1, 24), (18, 32)])
def test_the_files_positions_identify_its_grid(grid: tuple[int, int]) -> None:
    net = public.Network(depth=2, grid=grid)
    config, params, _ = from_public("file", public.random_weights(net), variant=variant_of(net))
    assert config.grid == grid
    exported = to_public(config, params)
    assert exported["pos_embed"].tobytes() == public.random_weights(net)["pos_embed"].tobytes()


@pytest.mark.usefixtures("bf16_units")
def test_bf16_rounds_and_neither_remat_nor_unrolling_changes_anything() -> None:
    config, params = model("frame")
    latents, t, actions, _ = inputs(VARIANTS["frame"])
    args = (jnp.asarray(latents.transpose(0, 1, 3, 4, 2)), t, rows_of(actions))

    def out(**changes: Any) -> Any:
        return jax.jit(DiT(replace(config, **changes)).apply)({"params": params}, *args)

    plain, rounded = out(), out(compute_dtype="bfloat16")
    assert 0 < np.abs(rounded - plain).max() < 0.05 * np.abs(plain).max()
    np.testing.assert_allclose(out(unroll=8, remat="blocks"), plain, atol=1e-6)


@pytest.mark.parametrize(
    ("width", "blocks", "heads", "total"),
    [(384, 12, 6, 33_206_416), (768, 12, 12, 132_178_192), (1024, 24, 16, 461_372_432), (1152, 28, 16, 679_397_776)],
)
def test_counts_are_the_public_ones(width: int, blocks: int, heads: int, total: int) -> None:
    config = Architecture(width=width, blocks=blocks, heads=heads, rows=32, columns=40)
    shapes = jax.eval_shape(DiT(config).init_params, jax.random.key(0))
    trained, fixed = sum(x.size for x in jax.tree.leaves(shapes)), (16 * 20 + 16) * width
    net = public.Network(width, blocks, heads, frames=16, grid=(16, 20))
    assert sum(map(math.prod, public.shapes(net).values())) == total
    assert trained + fixed == total
