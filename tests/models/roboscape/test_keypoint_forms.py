"""The keypoint terms that the paper does not have, against loops from their equations; their minimum is the truth."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Departures, LossConfig, NoDepth, RoboScapeConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.objective import Batch, attention_map, loss_terms, select
from rsjax.tokenizers import lfq
from rsjax.trainable import Term

B, T, GRID, BITS, TRACKS = 3, 4, 3, 6, 5
ARCHITECTURE = Architecture(frames=T, grid=GRID, code_bits=BITS, vocabularies=2, action_inputs=1, depth="none")
RNG = np.random.default_rng(0)
LOGITS = RNG.normal(scale=3, size=(B, T, GRID**2, 2, 8)).astype(np.float32)
TOKENS = RNG.integers(0, 2**BITS, (B, T, GRID, GRID), np.int32)
MASK = RNG.random((B, T, GRID, GRID)) < 0.5
WEIGHT = np.array([1, 1, 0], np.float32)
CELLS = RNG.integers(0, GRID**2, (B, TRACKS, T))
TRACKED = ((np.stack([CELLS % GRID, CELLS // GRID], axis=-1) + 0.5) / GRID).astype(np.float32)  # centres of cells
VISIBLE = RNG.random((B, TRACKS, T)) < 0.7
TRUE_CODES = np.asarray(lfq.tokens_to_codes(jnp.array(TOKENS), BITS)).reshape(B, T, GRID**2, BITS)


def terms(
    keypoints: Any,
    logits: Any = LOGITS,
    tracks: Any = TRACKED,
    visible: Any = VISIBLE,
    departures: Departures = Departures(),  # noqa: B008
    **settings: Any,
) -> dict[str, Term]:
    """The terms of the objective with this keypoint term."""
    loss = LossConfig(keypoints=keypoints, **settings)
    config = RoboScapeConfig(depth=NoDepth(), loss=loss, departures=departures)
    tokens = jnp.array(TOKENS)
    still = jnp.zeros((B, T, 1))
    batch = Batch(tokens, tokens, still, jnp.array(tracks), jnp.array(visible), jnp.array(WEIGHT), jnp.arange(B))
    return loss_terms(config, ARCHITECTURE, {"rgb": jnp.array(logits)}, {"rgb": tokens}, jnp.array(MASK), batch)


def true_logits() -> np.ndarray:
    """Logits that put all mass on the true tokens."""
    sub_tokens = lfq.split_tokens(jnp.array(TOKENS), BITS, 2).reshape(B, T, GRID**2, 2)
    return 200 * np.asarray(jax.nn.one_hot(sub_tokens, 8))


@pytest.mark.parametrize("observed", [False, True])
def test_difference_is_its_equation(observed: bool) -> None:
    s_hat = np.array(lfq.mean_codes(jnp.array(LOGITS), BITS))
    if observed:
        s_hat[:, 0] = TRUE_CODES[:, 0]
    total = count = 0.0
    for clip in np.flatnonzero(WEIGHT):
        for i in range(TRACKS):
            for t in range(1, T):
                before = CELLS[clip, i, t - 1]
                here = CELLS[clip, i, t]
                if not (VISIBLE[clip, i, t - 1] and VISIBLE[clip, i, t]):
                    continue
                predicted = s_hat[clip, t, here] - s_hat[clip, t - 1, before]
                true = TRUE_CODES[clip, t, here] - TRUE_CODES[clip, t - 1, before]
                total += np.sum((predicted - true) ** 2)
                count += 1
    found = terms("difference", departures=Departures(observed_anchor=observed))["keypoint"]
    np.testing.assert_allclose(found, (total, count), rtol=1e-5)
    assert count > 0


def test_the_minimum_of_difference_is_the_truth_and_that_of_equation_5_is_not() -> None:
    truth = true_logits()
    assert terms("difference", truth)["keypoint"][0] < 1e-8
    at_truth = float(terms("printed", truth)["keypoint"][0])
    unsure = np.zeros_like(truth)  # a mean code of 0 everywhere
    assert at_truth > 10
    assert terms("printed", unsure)["keypoint"][0] < 1e-8
    assert terms("difference", unsure)["keypoint"][0] > 10


@pytest.mark.parametrize("seed", range(5))
def test_any_other_prediction_at_a_visible_step_raises_difference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = VISIBLE[..., 1:] & VISIBLE[..., :-1] & (WEIGHT > 0)[:, None, None]
    clip, track, step = rng.choice(np.argwhere(steps))
    logits = true_logits()
    cell = CELLS[clip, track, step + 1]
    logits[clip, step + 1, cell] = rng.normal(size=(2, 8))
    assert terms("difference", logits)["keypoint"][0] > 0.01


@pytest.mark.parametrize("keypoints", ["difference"])
def test_a_hidden_point_does_not_count(keypoints: str) -> None:
    moved = np.where(VISIBLE[..., None], TRACKED, 1 - TRACKED)
    np.testing.assert_array_equal(
        terms(keypoints, visible=VISIBLE)["keypoint"],
        terms(keypoints, tracks=moved, visible=VISIBLE)["keypoint"],
    )
    assert terms(keypoints, visible=VISIBLE & False)["keypoint"] == (0, 0)


@pytest.mark.parametrize("keypoints", ["difference"])
def test_all_tracks_count_whatever_k(keypoints: str) -> None:
    few = terms(keypoints, num_keypoints=1)
    many = terms(keypoints, num_keypoints=TRACKS)
    np.testing.assert_array_equal(few["keypoint"], many["keypoint"])
    assert few["attention"] != many["attention"]


def test_normalised_attention_is_a_cross_entropy_whose_weights_have_the_mean_1() -> None:
    loss = LossConfig(gamma=7.0, num_keypoints=2)
    points = select(jnp.array(TRACKED), jnp.array(VISIBLE), loss.num_keypoints, GRID)
    emphasis = np.asarray(attention_map(points, GRID, loss.gamma))
    nats = np.asarray(lfq.token_cross_entropy(jnp.array(LOGITS), jnp.array(TOKENS), BITS))
    counted = MASK & (WEIGHT > 0)[:, None, None, None]
    weights = emphasis[counted] / emphasis[counted].mean()
    assert len(set(weights.tolist())) == 2
    departures = Departures(visible_keypoints=True)
    found = terms("printed", attention="normalised", gamma=7.0, num_keypoints=2, departures=departures)
    total, weight = found["attention"]
    np.testing.assert_allclose(total / weight, np.mean(weights * nats[counted]), rtol=1e-5)
    np.testing.assert_allclose(found["rgb"][0] / found["rgb"][1], np.mean(nats[counted]), rtol=1e-5)


def test_a_flat_normalised_attention_is_the_objective_without_attention() -> None:
    flat = RoboScapeConfig(loss=LossConfig(attention="normalised", gamma=1.0, keypoint_weight=0.0), depth=NoDepth())
    without = RoboScapeConfig(loss=LossConfig(attention_weight=0.0, keypoint_weight=0.0), depth=NoDepth())
    assert without.loss_weights == {"rgb": 1.0}
    assert flat.loss_weights == {"rgb": 0.0, "attention": 1.0}
    found = terms("printed", attention="normalised", gamma=1.0)
    np.testing.assert_allclose(found["attention"], found["rgb"], rtol=1e-6)
    assert RoboScapeConfig(loss=LossConfig(attention="normalised", attention_weight=0.0)).loss_weights["rgb"] == 1.0
