"""The keypoint terms that the paper does not have, against loops from their equations; their minimum is the truth."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Departures, LossConfig, NoDepth, RoboScapeConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.normalised_attention import moved_by_others
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
FEATURES = RNG.normal(size=(B, T, GRID**2, 8)).astype(np.float32)
MOTION = RNG.normal(scale=2, size=(B, T, GRID**2, 3)).astype(np.float32)
TRUE_CODES = np.asarray(lfq.tokens_to_codes(jnp.array(TOKENS), BITS)).reshape(B, T, GRID**2, BITS)


def terms(
    keypoints: Any,
    logits: Any = LOGITS,
    tracks: Any = TRACKED,
    visible: Any = VISIBLE,
    departures: Departures = Departures(),  # noqa: B008
    trunk: Any = FEATURES,
    motion: Any = MOTION,
    **settings: Any,
) -> dict[str, Term]:
    """The terms of the objective with this keypoint term."""
    loss = LossConfig(keypoints=keypoints, **settings)
    config = RoboScapeConfig(depth=NoDepth(), loss=loss, departures=departures)
    tokens = jnp.array(TOKENS)
    still = jnp.zeros((B, T, 1))
    batch = Batch(tokens, tokens, still, jnp.array(tracks), jnp.array(visible), jnp.array(WEIGHT), jnp.arange(B))
    targets = {"rgb": tokens}
    return loss_terms(config, ARCHITECTURE, {"rgb": jnp.array(logits)}, targets, jnp.array(MASK), batch, trunk, motion)


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


def huber(x: float) -> float:
    return 0.5 * x**2 if abs(x) < 1 else abs(x) - 0.5


def test_motion_is_its_equation() -> None:
    total = count = 0.0
    for clip in np.flatnonzero(WEIGHT):
        for i in range(TRACKS):
            for t in range(1, T):
                if not VISIBLE[clip, i, t - 1]:
                    continue
                x, y, logit = MOTION[clip, t, CELLS[clip, i, t - 1]].astype(np.float64)
                probability = 1 / (1 + np.exp(-logit))
                count += 1
                if VISIBLE[clip, i, t]:
                    moved = GRID * (TRACKED[clip, i, t] - TRACKED[clip, i, t - 1]).astype(np.float64)
                    total += huber(x - moved[0]) + huber(y - moved[1]) - np.log(probability)
                else:
                    total -= np.log(1 - probability)
    np.testing.assert_allclose(terms("motion")["keypoint"], (BITS * total, count), rtol=1e-5)


def test_feature_is_its_equation_for_the_tracks_that_move_most() -> None:
    k = 3
    f = FEATURES.astype(np.float64)
    f = f - f.mean(axis=2, keepdims=True)
    f /= np.linalg.norm(f, axis=-1, keepdims=True)
    total = count = 0.0
    for clip in np.flatnonzero(WEIGHT):
        steps = np.linalg.norm(np.diff(TRACKED[clip], axis=1), axis=-1)
        motion = np.sum(steps * (VISIBLE[clip, :, 1:] & VISIBLE[clip, :, :-1]), axis=1)
        for i in np.argsort(-motion, kind="stable")[:k]:
            for t in range(1, T):
                if VISIBLE[clip, i, 0] and VISIBLE[clip, i, t]:
                    total += 2 - 2 * f[clip, t, CELLS[clip, i, t]] @ f[clip, 0, CELLS[clip, i, 0]]
                    count += 1
    found = terms("feature", num_keypoints=k)["keypoint"]
    np.testing.assert_allclose(found, (BITS * total, count), rtol=1e-4)


def test_no_gradient_reaches_the_teacher_of_feature() -> None:
    gradient = jax.grad(lambda x: terms("feature", trunk=x)["keypoint"][0])(jnp.array(FEATURES))
    assert not np.any(gradient[:, 0])
    assert np.any(gradient[:, 1:])


@pytest.mark.parametrize("keypoints", ["difference", "motion", "feature"])
def test_where_nothing_is_visible_nothing_counts(keypoints: str) -> None:
    assert terms(keypoints, visible=VISIBLE & False)["keypoint"] == (0, 0)


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


def test_attention_to_contact_weighs_the_cells_of_points_that_rest_before_they_move() -> None:
    steps = np.zeros((B, TRACKS, T, 2), np.float32)
    steps[:, 0, 1:, 0] = 0.9  # moves from the start
    steps[:, 1, 2:, 0] = 0.9  # is moved later
    steps[:, 2, 2:, 0] = 0.2  # trembles
    steps[:, 3, 2:, 1] = 0.9  # is moved later, and was hidden at first
    places = np.tile(np.array([0.5, 1.5, 2.5, 0.5, 1.5])[:, None, None], (1, T, 2))
    tracks = ((places + steps) / GRID).astype(np.float32)
    visible = np.ones((B, TRACKS, T), bool)
    visible[:, 3, 0] = False
    visible[1, 1, 3] = False  # in the second clip, the point is not seen in the last frame
    emphasis = np.ones((B, T, GRID, GRID))
    for clip in range(B):
        for t in range(T):
            if visible[clip, 1, t]:
                column, row = (tracks[clip, 1, t] * GRID).astype(int)
                emphasis[clip, t, row, column] = 7.0
    nats = np.asarray(lfq.token_cross_entropy(jnp.array(LOGITS), jnp.array(TOKENS), BITS))
    counted = MASK & (WEIGHT > 0)[:, None, None, None]
    weights = emphasis[counted] / emphasis[counted].mean()
    total, weight = terms("printed", tracks=tracks, visible=visible, attention="contact", gamma=7.0)["attention"]
    np.testing.assert_allclose(total / weight, np.mean(weights * nats[counted]), rtol=1e-5)
    loss = LossConfig(attention="contact", keypoint_weight=0.0)
    assert RoboScapeConfig(loss=loss, depth=NoDepth()).loss_weights == {"rgb": 0.0, "attention": 1.0}


def test_a_point_of_a_longer_clip_rests_for_its_first_quarter() -> None:
    tracks = np.full((1, 2, 16, 2), 0.5 / GRID, np.float32)
    tracks[:, 0, 3:, 0] += 0.9 / GRID
    tracks[:, 1, 4:, 0] += 0.9 / GRID
    marked = moved_by_others(jnp.array(tracks), jnp.ones((1, 2, 16), bool), GRID)
    np.testing.assert_array_equal(marked, np.broadcast_to([[[False], [True]]], marked.shape))


def test_a_flat_normalised_attention_is_the_objective_without_attention() -> None:
    flat = RoboScapeConfig(loss=LossConfig(attention="normalised", gamma=1.0, keypoint_weight=0.0), depth=NoDepth())
    without = RoboScapeConfig(loss=LossConfig(attention_weight=0.0, keypoint_weight=0.0), depth=NoDepth())
    assert without.loss_weights == {"rgb": 1.0}
    assert flat.loss_weights == {"rgb": 0.0, "attention": 1.0}
    found = terms("printed", attention="normalised", gamma=1.0)
    np.testing.assert_allclose(found["attention"], found["rgb"], rtol=1e-6)
    assert RoboScapeConfig(loss=LossConfig(attention="normalised", attention_weight=0.0)).loss_weights["rgb"] == 1.0
