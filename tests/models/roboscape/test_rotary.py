"""Rotary temporal positions, and the cache that rolls on with them."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import ConfigError, Departures, PublicCodeConfig
from rsjax.layers.attention import frames_held, rotate
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer, empty_cache
from tests.models.roboscape.toy import random_params

ROTARY = Architecture(
    frames=4,
    grid=2,
    code_bits=4,
    action_inputs=3,
    width=8,
    blocks=2,
    heads=2,
    departures=Departures(rotary=True),
    public_code=PublicCodeConfig(qk_norm=True),
)
LENGTH = 11  # frames, more than twice the window


def random_inputs(config: Architecture) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    shape = (2, LENGTH, config.grid, config.grid)
    tokens = {name: rng.integers(0, 2**config.code_bits, shape, np.int32) for name in config.branches}
    return tokens, rng.random(shape) < 0.4, rng.normal(size=(2, LENGTH, config.action_inputs)).astype(np.float32)


@jax.jit
def rotary(params: Any, tokens: Any, mask: Any, actions: Any, start: Any = 0, cache: Any = None) -> Any:
    return Transformer(ROTARY).apply({"params": params}, tokens, mask, actions, start, cache)


def test_rotation_is_that_of_complex_numbers_and_products_depend_on_the_distance() -> None:
    rng = np.random.default_rng(0)
    q, k = rng.normal(size=(2, 1, 5, 1, 1, 6)).astype(np.float32)
    positions = np.array([0, 1, 2, 7, 40])
    turns = np.exp(1j * positions[:, None] * 10_000.0 ** (-np.arange(3) / 3))
    expected = (q[0, :, 0, 0, :3] + 1j * q[0, :, 0, 0, 3:]) * turns
    turned = np.asarray(rotate(q, jnp.asarray(positions)))[0, :, 0, 0]
    np.testing.assert_allclose(turned, np.concatenate([expected.real, expected.imag], -1), rtol=1e-4, atol=1e-4)
    moved = [jnp.asarray(positions + at) for at in (0, 13)]
    products = [(rotate(q, at) * rotate(k, at + 3)).sum(-1) for at in moved]
    np.testing.assert_allclose(products[0], products[1], atol=1e-4)


def test_only_the_distance_in_time_matters() -> None:
    params, (tokens, mask, actions) = random_params(ROTARY), random_inputs(ROTARY)
    here, later = (rotary(params, tokens, mask, actions, start)[0] for start in (0, 9))
    for name in here:
        np.testing.assert_allclose(here[name], later[name], rtol=1e-3, atol=1e-3)
    assert params["pos_embed"].shape == (1, 4, 8)  # positions within a frame stay learned


def test_a_frame_reaches_one_window_a_block() -> None:
    params, (tokens, mask, actions) = random_params(ROTARY), random_inputs(ROTARY)
    other = actions.copy()
    other[:, 1] += 1
    before, after = (rotary(params, tokens, mask, x)[0]["rgb"] for x in (actions, other))
    changed = np.abs(after - before).max(axis=(0, 2, 3, 4)) > 0
    reach = 1 + ROTARY.blocks * (ROTARY.frames - 1)
    np.testing.assert_array_equal(changed, [1 <= t <= reach for t in range(LENGTH)])


def test_pieces_through_a_rolling_cache_are_the_whole() -> None:
    """Pieces of two frames need one slot more than the window; the first may fill all slots."""
    params, (tokens, mask, actions) = random_params(ROTARY), random_inputs(ROTARY)
    whole, _ = rotary(params, tokens, mask, actions)
    cache, start = empty_cache(ROTARY, 2, ROTARY.frames + 1), 0
    for length in (5, 2, 1, 2, 1):
        here = slice(start, start + length)
        piece = ({name: x[:, here] for name, x in tokens.items()}, mask[:, here], actions[:, here])
        logits, cache = rotary(params, *piece, start, cache)
        for name in whole:
            np.testing.assert_allclose(logits[name], whole[name][:, here], rtol=1e-3, atol=1e-3)
        start += length


def test_slots_hold_the_last_frames() -> None:
    np.testing.assert_array_equal(frames_held(4, 9), [8, 9, 6, 7])
    assert (np.asarray(frames_held(4, 1)) < 0).tolist() == [False, False, True, True]


def test_what_cannot_be_is_refused() -> None:
    params, inputs = random_params(ROTARY), random_inputs(ROTARY)
    with pytest.raises(ValueError, match="11 frames do not fit a cache of 5"):
        rotary(params, *inputs, 0, empty_cache(ROTARY, 2, 5))
    with pytest.raises(ConfigError, match=r"model.departures.rotary .* a head has 3"):
        replace(ROTARY, width=6)
