import itertools
import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import SampleConfig
from rsjax.models.roboscape.maskgit import Frame, keep_top, masked_after, sample_tokens, unmask_step
from rsjax.tokenizers import lfq

B, CELLS, BITS = 2, 12, 6
LOGITS = {name: jax.random.normal(jax.random.key(i), (B, CELLS, 2, 8)) * 3 for i, name in enumerate(("rgb", "depth"))}
Order = Literal["random", "greedy"]


@settings(deadline=None, max_examples=50)
@given(steps=st.integers(1, 16), cells=st.integers(1, 256))
def test_the_schedule_follows_the_cosine_down_to_nothing(steps: int, cells: int) -> None:
    left = masked_after(steps, cells).tolist()
    assert len(left) == steps
    assert left[-1] == 0
    assert all(a >= b for a, b in itertools.pairwise(left))
    for step, count in enumerate(left[:-1]):
        exact = math.cos((step + 1) / steps * math.pi / 2) * cells
        assert exact - 1e-3 <= count < exact + 1 + 1e-3


def clip_keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), B)


def decode(config: SampleConfig, seed: int = 0) -> list[Frame]:
    """The frames before the first and after every step, each step with other logits, as a model would give."""
    tokens = {name: jnp.zeros((B, CELLS), jnp.int32) for name in LOGITS}
    means = {name: jnp.zeros((B, CELLS, BITS)) for name in LOGITS}
    frame = Frame(tokens, jnp.ones((B, CELLS), bool), jnp.zeros((B, CELLS)), means)
    frames = [frame]
    for step in range(config.steps):
        frame = unmask_step(config, BITS, clip_keys(100 * seed + step), step, frame, logits_at(step))
        frames.append(frame)
    return frames


def logits_at(step: int) -> dict[str, jax.Array]:
    return {name: jnp.roll(x, step, axis=1) for name, x in LOGITS.items()}


@pytest.mark.parametrize(("steps", "left"), [(2, [182, 0]), (3, [222, 129, 0]), (6, [248, 222, 182, 129, 67, 0])])
def test_the_schedule_is_the_references_in_float64(steps: int, left: list[int]) -> None:
    """cos(π/3) is slightly above ½ in float64, so the public code leaves 129 of 256 cells; float32 gives 128."""
    assert masked_after(steps, 256).tolist() == left


@pytest.mark.parametrize(
    "config",
    [SampleConfig(steps=5, unmask="greedy"), SampleConfig(steps=2 * CELLS, temperature=1.0)],
    ids=["greedy", "more steps than cells"],
)
def test_a_cell_is_decided_once_and_the_schedule_is_kept(config: SampleConfig) -> None:
    frames = decode(config)
    assert not frames[-1].mask.any()
    for step, (before, after) in enumerate(itertools.pairwise(frames)):
        np.testing.assert_array_equal(after.mask.sum(-1), masked_after(config.steps, CELLS)[step])
        assert not np.any(after.mask & ~before.mask)
        decided = ~np.asarray(before.mask)
        logits = logits_at(step)
        for name in LOGITS:
            np.testing.assert_array_equal(after.tokens[name][decided], before.tokens[name][decided])
            means = np.where(decided[..., None], before.means[name], lfq.mean_codes(logits[name], BITS))
            np.testing.assert_allclose(after.means[name], means, atol=1e-6)
        assert before.entropy is not None and after.entropy is not None
        p = np.asarray(jax.nn.softmax(logits["rgb"]))
        entropy = -np.sum(p * np.log(p), axis=(-2, -1))
        np.testing.assert_allclose(after.entropy, np.where(decided, before.entropy, entropy), rtol=1e-4)


def test_greedy_leaves_open_where_the_branches_together_are_least_sure() -> None:
    before, after = decode(SampleConfig(steps=2, unmask="greedy"))[:2]
    p = {name: np.asarray(jax.nn.softmax(x)).max(-1).prod(-1) for name, x in LOGITS.items()}  # of both vocabularies
    joint = p["rgb"] * p["depth"]
    left = int(masked_after(2, CELLS)[0])
    for clip in range(B):
        assert set(np.flatnonzero(after.mask[clip])) == set(np.argsort(joint[clip])[:left])
    assert before.mask.all()


def test_random_order_does_not_look_at_the_logits() -> None:
    config = SampleConfig(steps=2)
    start, keys = decode(config)[0], clip_keys(7)
    flipped = {name: -x for name, x in LOGITS.items()}
    one, other = (unmask_step(config, BITS, keys, 0, start, x) for x in (LOGITS, flipped))
    np.testing.assert_array_equal(one.mask, other.mask)
    assert not np.array_equal(one.mask, unmask_step(config, BITS, clip_keys(8), 0, start, LOGITS).mask)


def test_greedy_is_sure_of_a_clip_without_depth_by_its_rgb_alone_and_draws_alike() -> None:
    config = SampleConfig(steps=2, unmask="greedy", temperature=1.0)
    start, keys = decode(config)[0], clip_keys(0)
    plain, one = (unmask_step(config, BITS, keys, 0, start, LOGITS, x) for x in (None, jnp.array([True, False])))
    np.testing.assert_array_equal(one.tokens["rgb"], plain.tokens["rgb"])
    log_p = np.asarray(jax.nn.log_softmax(LOGITS["rgb"][0]))
    codes = np.stack([one.tokens["rgb"][0] & 7, one.tokens["rgb"][0] >> 3], -1)
    sure = np.take_along_axis(log_p, codes[..., None], -1)[..., 0].sum(-1)
    assert set(np.flatnonzero(one.mask[0])) == set(np.argsort(sure)[: int(masked_after(2, CELLS)[0])])
    assert not np.array_equal(one.mask[0], plain.mask[0])
    np.testing.assert_array_equal(one.mask[1], plain.mask[1])


def test_at_temperature_zero_the_most_probable_codes_are_taken_whatever_the_key() -> None:
    for seed in range(2):
        tokens, log_p = sample_tokens(jax.random.key(seed), LOGITS["rgb"], 0.0, BITS)
        best = np.asarray(LOGITS["rgb"]).argmax(-1)
        np.testing.assert_array_equal(tokens, best[..., 0] + 8 * best[..., 1])
        expected = np.log(np.asarray(jax.nn.softmax(LOGITS["rgb"])).max(-1).prod(-1))
        np.testing.assert_allclose(log_p, expected, rtol=1e-5)


def test_temperature_divides_logits() -> None:
    temperature = 3.0
    logits = np.array([[2.0, 0.0, 1.0, -1.0], [0.0, 0.5, -2.0, 1.5]], np.float32)
    many = jnp.broadcast_to(logits, (1, 20_000, 2, 4))
    tokens, log_p = sample_tokens(jax.random.key(0), many, temperature, 4)
    for k in range(2):
        p = np.exp(logits[k] / temperature)
        frequency = np.bincount(np.asarray(tokens[0] >> 2 * k & 3), minlength=4) / 20_000
        np.testing.assert_allclose(frequency, p / p.sum(), atol=0.02)
    codes = np.stack([tokens[0] & 3, tokens[0] >> 2], -1)
    plain = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    np.testing.assert_allclose(log_p[0], plain[0, codes[:, 0]] + plain[1, codes[:, 1]], rtol=1e-4)


@pytest.mark.parametrize("unmask", ["random", "greedy"])
def test_a_clips_draws_do_not_depend_on_the_clips_beside_it(unmask: Order) -> None:
    config = SampleConfig(steps=3, temperature=1.0, top_k=4, unmask=unmask)
    start, keys = decode(config)[0], clip_keys(3)
    together = unmask_step(config, BITS, keys, 0, start, LOGITS)
    for clip in range(B):
        only = lambda x, clip=clip: x[clip : clip + 1]  # noqa: E731
        alone = unmask_step(config, BITS, only(keys), 0, jax.tree.map(only, start), jax.tree.map(only, LOGITS))
        jax.tree.map(np.testing.assert_array_equal, alone, jax.tree.map(only, together))


@settings(deadline=None)
@given(seed=st.integers(0, 99), top_k=st.integers(1, 8))
def test_top_k_keeps_the_k_largest_logits_as_they_are(seed: int, top_k: int) -> None:
    logits = np.random.default_rng(seed).normal(size=(5, 2, 8)).astype(np.float32)
    kept = np.asarray(keep_top(logits, top_k))
    smallest = np.sort(logits, axis=-1)[..., -top_k, None]
    np.testing.assert_array_equal(kept, np.where(logits >= smallest, logits, -np.inf))
    np.testing.assert_array_equal(keep_top(logits, 0), logits)
    np.testing.assert_array_equal(keep_top(logits, 9), logits)


def test_of_the_top_k_codes_each_is_drawn_in_proportion_and_no_other() -> None:
    logits = np.array([2.0, 0.0, 1.0, -1.0], np.float32)
    many = jnp.broadcast_to(logits, (1, 5_000, 1, 4))
    tokens, log_p = sample_tokens(jax.random.key(0), many, 1.0, 2, top_k=2)
    frequency = np.bincount(np.asarray(tokens[0]), minlength=4) / 5_000
    p = np.exp(logits) * (logits >= 1)
    np.testing.assert_allclose(frequency, p / p.sum(), atol=0.03)
    assert set(np.unique(tokens)) == {0, 2}
    np.testing.assert_allclose(log_p[0], np.asarray(jax.nn.log_softmax(logits))[tokens[0]], rtol=1e-5)
    best, _ = sample_tokens(jax.random.key(1), LOGITS["rgb"], 1.0, BITS, top_k=1)
    np.testing.assert_array_equal(best, sample_tokens(jax.random.key(0), LOGITS["rgb"], 0.0, BITS)[0])
