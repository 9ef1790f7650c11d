from collections import Counter
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import ModelConfig, SampleConfig
from rsjax.model.world_model import WorldModel, branches
from rsjax.sample import rollout as module
from rsjax.sample.rollout import rollout

DUAL = ModelConfig(frames=6, grid=3, code_bits=6, action_dim=3, width=16, blocks=2, heads=2)
RGB = replace(DUAL, depth=False)
BATCH, KEY = 2, jax.random.key(5)


def random_params(model: ModelConfig) -> Any:
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(WorldModel(model).init_params, KEY)
    return jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)


def given(model: ModelConfig, prompt: int, frames: int = 6) -> tuple[dict[str, np.ndarray], np.ndarray]:
    rng = np.random.default_rng(1)
    shape = (BATCH, prompt, model.grid, model.grid)
    tokens = {name: rng.integers(0, 2**model.code_bits, shape, np.int32) for name in branches(model)}
    return tokens, rng.normal(size=(BATCH, frames, model.action_dim)).astype(np.float32)


@pytest.mark.parametrize(
    ("model", "prompt", "sample"),
    [
        (DUAL, 1, SampleConfig(steps=2)),
        (DUAL, 3, SampleConfig(steps=4, unmask="greedy")),
        (DUAL, 3, SampleConfig(steps=1)),
        (RGB, 1, SampleConfig(steps=3, unmask="greedy")),
        (RGB, 3, SampleConfig(steps=2, temperature=1.0)),
    ],
    ids=["dual-2-random", "dual-3-prompt-4-greedy", "dual-3-prompt-1", "rgb-3-greedy", "rgb-3-prompt-2-warm"],
)
def test_cached_is_uncached(model: ModelConfig, prompt: int, sample: SampleConfig) -> None:
    params, (tokens, actions) = random_params(model), given(model, prompt)
    cached, plain = (rollout(model, sample, params, tokens, actions, KEY, cached=c) for c in (True, False))
    assert cached.keys() == tokens.keys()
    for name, grid in cached.items():
        np.testing.assert_array_equal(grid, plain[name], err_msg=name)
        np.testing.assert_array_equal(grid[:, :prompt], tokens[name])
        assert grid.shape == (BATCH, 6, 3, 3)
        assert np.ptp(grid[:, prompt:]) > 0


def test_a_single_greedy_step_is_the_models_most_probable_frame() -> None:
    """One decoding step from the definition: mask frame t, keep the frames before, take the argmax."""
    model, params, (tokens, actions) = DUAL, random_params(DUAL), given(DUAL, 1)
    out = rollout(model, SampleConfig(steps=1), params, tokens, actions, KEY)
    apply = jax.jit(WorldModel(model).apply)
    for t in range(1, 6):
        mask = np.zeros((BATCH, 6, 3, 3), bool)  # a new one: jax may still be reading the one before
        mask[:, t:] = True
        logits, _ = apply({"params": params}, out, mask, actions)
        for name in out:
            codes = np.asarray(logits[name][:, t]).argmax(-1)
            np.testing.assert_array_equal(out[name][:, t].reshape(BATCH, -1), codes[..., 0] + 8 * codes[..., 1])


def test_the_key_decides_the_draws_and_actions_the_video() -> None:
    model, sample, params, (tokens, actions) = (
        RGB,
        SampleConfig(steps=2, temperature=1.0),
        random_params(RGB),
        given(RGB, 3),
    )
    make = lambda actions, key: np.asarray(rollout(model, sample, params, tokens, actions, key)["rgb"])  # noqa: E731
    first = make(actions, KEY)
    np.testing.assert_array_equal(first, make(actions, KEY))
    assert not np.array_equal(first, make(actions, jax.random.key(6)))

    later = actions.copy()
    later[:, 5:] += 3
    np.testing.assert_array_equal(first[:, :5], make(later, KEY)[:, :5])
    assert not np.array_equal(first, make(later, KEY))


@pytest.mark.parametrize(("prompt", "frames"), [(1, 7), (3, 3), (4, 3)])
def test_more_frames_than_positions_or_none_to_make_are_refused(prompt: int, frames: int) -> None:
    tokens, actions = given(RGB, prompt, frames)
    with pytest.raises(ValueError, match=f"{frames} frames asked for with {prompt} given.*positions for 6"):
        rollout(RGB, SampleConfig(), random_params(RGB), tokens, actions, KEY)


# Frame passes of one rollout: a pass over f frames counts f.
PUBLISHED = [(1, 16, 30), (2, 16, 45), (8, 16, 135), (2, 48, 141)]


@pytest.mark.parametrize(("steps", "frames", "cached_passes"), PUBLISHED)
def test_a_rollout_costs_the_frame_passes_that_it_should(
    steps: int, frames: int, cached_passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = replace(RGB, frames=frames, grid=1)
    passes: Counter[str] = Counter()

    def count(name: str) -> Any:
        def apply(model: Any, params: Any, tokens: Any, mask: Any, actions: Any, start: Any, cache: Any) -> Any:
            passes[name] += mask.shape[1]
            return {"rgb": jnp.zeros((*mask.shape, 2, 8))}, cache

        return apply

    tokens = {"rgb": np.zeros((1, 1, 1, 1), np.int32)}
    with jax.disable_jit():
        for name, cached in (("cached", True), ("uncached", False)):
            monkeypatch.setattr(module, "_apply", count(name))
            rollout(model, SampleConfig(steps=steps), {}, tokens, np.zeros((1, frames, 3)), KEY, cached=cached)
    assert passes == {"cached": cached_passes, "uncached": steps * (frames - 1) * frames}
