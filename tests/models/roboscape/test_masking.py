from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import CorruptionConfig
from rsjax.models.roboscape.departures.action_dropout import dropped_actions
from rsjax.models.roboscape.masking import Masked, corrupt

T, GRID, BITS, VOCABULARIES = 10, 8, 18, 2
BATCHES, CLIPS = 64, 16
STEP_1 = CorruptionConfig(probability=0.0)
STEP_2 = CorruptionConfig(random_token_rate=0.0)
PROMPT = {STEP_1: 1, STEP_2: 4}  # frames given at generation


@partial(jax.jit, static_argnums=(0, 4))
def corrupt_one(config: CorruptionConfig, key: jax.Array, tokens: Any, index: Any, prefix: float = 0.0) -> Masked:
    return corrupt(config, prefix, PROMPT[config], BITS, VOCABULARIES, key, tokens, index)


dropped = jax.jit(dropped_actions, static_argnums=0)


def clean(clips: int, branches: tuple[str, ...] = ("rgb", "depth")) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {name: rng.integers(0, 2**BITS, (clips, T, GRID, GRID), np.int32) for name in branches}


@cache
def run(config: CorruptionConfig, prefix: float = 0.0) -> tuple[Masked, dict[str, np.ndarray], np.ndarray]:
    """Many batches: corrupted tokens and masks, the clean tokens, and which sub-tokens of RGB have changed."""
    tokens = clean(CLIPS)
    keys = jax.random.split(jax.random.key(1), BATCHES)
    each = [corrupt_one(config, key, tokens, jnp.arange(CLIPS), prefix) for key in keys]
    out = jax.tree.map(lambda *x: np.stack(x), *each)
    changed = np.stack([(out.tokens["rgb"] >> shift & 511) != (tokens["rgb"] >> shift & 511) for shift in (0, 9)], -1)
    return out, tokens, changed


def test_every_clip_and_frame_draws_its_own_rate_from_the_cosine() -> None:
    out, _, _ = run(STEP_1)
    assert not out.mask[:, :, 0].any()
    rates = out.mask[:, :, 1:].mean(axis=(-1, -2))
    for x in (0.1, 0.3, 0.5, 0.7, 0.9):  # v ~ U(0, 1), hence P(cos(πv/2) ≤ x) = 1 - 2·arccos(x)/π
        assert np.mean(rates <= x) == pytest.approx(1 - 2 / np.pi * np.arccos(x), abs=0.03)
    assert np.corrcoef(rates[:, :, 0].ravel(), rates[:, :, 1].ravel())[0, 1] < 0.1
    assert np.corrcoef(rates[:, 0].ravel(), rates[:, 1].ravel())[0, 1] < 0.1


def test_a_batch_shares_one_rate_of_random_sub_tokens_up_to_a_fifth_first_frame_included() -> None:
    _, _, changed = run(STEP_1)
    per_batch = changed.mean(axis=(1, 2, 3, 4, 5))
    assert per_batch.max() < 0.21
    assert per_batch.mean() == pytest.approx(0.1, abs=0.025)
    assert np.std(per_batch) == pytest.approx(0.2 / np.sqrt(12), rel=0.3)
    per_frame = changed.mean(axis=(1, 3, 4, 5))
    assert np.abs(per_frame - per_batch[:, None]).max() < 0.04  # noise alone


def test_half_of_the_batches_are_corrupted_and_the_others_mask_from_the_second_frame() -> None:
    out, _, changed = run(STEP_2)
    corrupted = changed.any(axis=(1, 2, 3, 4, 5))
    assert 0.3 < corrupted.mean() < 0.7
    assert out.mask.any(axis=(1, 3, 4))[~corrupted, 1:].all()
    assert not out.mask[:, :, 0].any()


def test_corruption_spares_the_prompt_and_grows_from_a_frame_drawn_after_it() -> None:
    out, _, changed = run(STEP_2)
    firsts = []
    ratios = []
    for batch in np.flatnonzero(changed.any(axis=(1, 2, 3, 4, 5))):
        masked = out.mask[batch].any(axis=(0, 2, 3))
        first = int(masked.argmax())
        assert masked[first:].all()
        assert not changed[batch, :, :first].any()
        survive = 1 - changed[batch].mean(axis=(0, 2, 3, 4))[first:]
        assert 0.25 * 0.9 - 0.03 < survive[0] <= 1
        ratio = survive[1:] / survive[:-1]
        assert np.all((ratio > 0.8) & (ratio < 1.1))  # it shrinks by U(0.9, 1), and noise
        assert ratio.size == 0 or np.mean(ratio) < 1.03
        firsts.append(first)
        ratios.extend(ratio)
    assert 0.93 < np.mean(ratios) < 0.97
    assert set(firsts) == set(range(PROMPT[STEP_2], T))


def test_sub_tokens_are_replaced_each_for_itself_by_codes_of_the_whole_vocabulary() -> None:
    out, _, changed = run(STEP_2)
    rate = changed.mean(axis=(1, 3, 4))  # batch, frame, vocabulary
    both = changed.all(-1).mean(axis=(1, 3, 4))
    assert rate.max() > 0.7
    np.testing.assert_allclose(rate[..., 0], rate[..., 1], atol=0.1)
    np.testing.assert_allclose(both, rate[..., 0] * rate[..., 1], atol=0.06)
    for k, shift in enumerate((0, 9)):
        drawn = np.bincount((out.tokens["rgb"] >> shift & 511)[changed[..., k]], minlength=512)
        assert drawn.min() > 0.5 * drawn.mean()
        assert drawn.max() < 1.5 * drawn.mean()


def test_branches_share_their_mask_and_not_their_noise() -> None:
    out, tokens, _ = run(STEP_2)
    assert out.mask.shape == out.tokens["rgb"].shape == out.tokens["depth"].shape
    noisy = {name: out.tokens[name] != tokens[name] for name in tokens}
    np.testing.assert_allclose(noisy["rgb"].mean((1, 3, 4)), noisy["depth"].mean((1, 3, 4)), atol=0.1)
    assert np.mean(noisy["rgb"] != noisy["depth"]) > 0.02


def test_tokens_stay_in_range() -> None:
    for config in (STEP_1, STEP_2):
        for tokens in run(config)[0].tokens.values():
            assert 0 <= tokens.min() < tokens.max() < 2**BITS


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**31 - 1))
def test_a_clips_draws_follow_its_place_in_the_global_batch_not_its_device(seed: int) -> None:
    key, tokens, index = jax.random.key(seed), clean(CLIPS), jnp.arange(CLIPS)[::-1]
    whole = corrupt_one(STEP_1, key, tokens, index)
    half = CLIPS // 2
    parts = [
        corrupt_one(STEP_1, key, {name: x[i : i + half] for name, x in tokens.items()}, index[i : i + half])
        for i in (0, half)
    ]
    jax.tree.map(lambda a, *b: np.testing.assert_array_equal(a, np.concatenate(b)), whole, *parts)
    assert not np.array_equal(whole.mask[0], whole.mask[1])


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**31 - 1))
def test_dropped_actions_follow_a_clips_place_too(seed: int) -> None:
    key = jax.random.key(seed)
    whole = dropped(0.5, key, jnp.arange(8))
    np.testing.assert_array_equal(dropped(0.5, key, jnp.array([6, 1])), whole[jnp.array([6, 1])])


def test_the_given_share_of_actions_is_dropped() -> None:
    drop = dropped(0.2, jax.random.key(0), jnp.arange(4000))
    assert np.mean(drop) == pytest.approx(0.2, abs=0.02)


def test_a_visible_prefix_ends_at_a_frame_drawn_per_clip_and_changes_nothing_else() -> None:
    before, after = (run(STEP_1, prefix)[0].mask for prefix in (0.0, 0.5))
    masked = after.any((-1, -2))  # batches, clips, T
    first = np.where(masked.any(-1), masked.argmax(-1), T)
    np.testing.assert_array_equal(after, before & (np.arange(T) >= first[..., None])[..., None, None])
    assert np.mean(first > 1) == pytest.approx(0.5 * (T - 2) / (T - 1), abs=0.06)
    assert set(range(1, T)) <= set(np.unique(first))
