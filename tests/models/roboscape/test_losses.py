"""Each term against a loop written from its equation; s_t is one-hot, so s·log p is the log-probability of its code."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Departures, LossConfig, RoboScapeConfig, presets
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.objective import Batch, Keypoints, attention_map, loss_terms
from rsjax.tokenizers import lfq
from rsjax.trainable import Term
from rsjax.training.step import combine

B, T, GRID, BITS, VOCABULARIES = 3, 4, 3, 6, 2
ARCHITECTURE = Architecture(frames=T, grid=GRID, code_bits=BITS, vocabularies=VOCABULARIES, action_inputs=1)
SIZE = 2 ** (BITS // VOCABULARIES)
RNG = np.random.default_rng(0)
LOGITS = RNG.normal(scale=3, size=(B, T, GRID**2, VOCABULARIES, SIZE)).astype(np.float32)
TOKENS = RNG.integers(0, 2**BITS, (B, T, GRID, GRID), np.int32)
MASK = RNG.random((B, T, GRID, GRID)) < np.array([0.9, 0.5, 0.1])[:, None, None, None]  # uneven between clips
CLIP_WEIGHT = np.array([1, 1, 0], np.float32)
CELLS = RNG.integers(0, GRID**2, (B, 5, T))
SHOWN = RNG.random((B, 5, T)) < 0.6
KEYPOINTS = Keypoints(jnp.array(CELLS), jnp.array(SHOWN & SHOWN[..., :1]))  # those hidden at first never count


def log_p(clip: int, t: int, row: int, column: int) -> float:
    token, total = int(TOKENS[clip, t, row, column]), 0.0
    for k in range(VOCABULARIES):
        logits = LOGITS[clip, t, row * GRID + column, k].astype(np.float64)
        total += float(logits[(token // SIZE**k) % SIZE] - np.log(np.sum(np.exp(logits))))
    return total


def plain_cross_entropy(attention: np.ndarray) -> tuple[float, float]:
    """-Σ A·s·log p over the masked cells of the clips that count, and the number of those cells."""
    total = cells = 0.0
    for index in np.ndindex(B, T, GRID, GRID):
        if MASK[index] and CLIP_WEIGHT[index[0]]:
            total -= float(attention[index]) * log_p(*index)
            cells += 1
    return total, cells


def cross_entropy() -> jax.Array:
    return lfq.token_cross_entropy(jnp.array(LOGITS), jnp.array(TOKENS), BITS)


def terms(
    visible: Any = KEYPOINTS.visible, weight: Any = CLIP_WEIGHT, gamma: float = 5.0, **departures: bool
) -> dict[str, Term]:
    """The terms of both branches with the same logits and tokens, and these keypoints as the only tracks."""
    config = RoboScapeConfig(loss=LossConfig(gamma=gamma), departures=Departures(**departures))
    return terms_of(config, tracks_of(KEYPOINTS.cells), visible, weight)


def tracks_of(cells: Any) -> np.ndarray:
    """Tracks through the centres of these cells."""
    rows, columns = np.divmod(np.asarray(cells), GRID)
    return ((np.stack([columns, rows], axis=-1) + 0.5) / GRID).astype(np.float32)


def terms_of(config: RoboScapeConfig, tracks: Any, visible: Any, weight: Any) -> dict[str, Term]:
    still = jnp.zeros((B, T, 1))
    index = jnp.arange(B)
    tokens, logits, mask = jnp.array(TOKENS), jnp.array(LOGITS), jnp.array(MASK)
    batch = Batch(tokens, tokens, still, jnp.asarray(tracks), jnp.asarray(visible), jnp.asarray(weight), index)
    both = {"rgb": logits, "depth": logits}
    targets = {"rgb": tokens, "depth": tokens}
    return loss_terms(config, ARCHITECTURE, both, targets, mask, batch)


def assert_term(term: Term, expected: tuple[float, float]) -> None:
    np.testing.assert_allclose(term[0], expected[0], rtol=1e-5)
    assert float(term[1]) == expected[1] > 0


def test_cross_entropy_of_a_token_is_that_of_the_whole_vocabulary() -> None:
    """Factorised heads define p(token) as the product over vocabularies: over all 2^D tokens it sums to one."""
    one = jnp.array(LOGITS[:1, :1, :1])
    everything = [lfq.token_cross_entropy(one, jnp.full((1, 1, 1, 1), token), BITS) for token in range(2**BITS)]
    np.testing.assert_allclose(np.sum(np.exp(-np.array(everything))), 1.0, rtol=1e-5)
    np.testing.assert_allclose(cross_entropy()[1, 2, 0, 1], -log_p(1, 2, 0, 1), rtol=1e-5)


def test_rgb_and_depth_are_equation_4() -> None:
    found = terms()
    for name in ("rgb", "depth"):
        assert_term(found[name], plain_cross_entropy(np.ones((B, T, GRID, GRID))))


def test_attention_is_equation_7() -> None:
    attention = np.asarray(attention_map(KEYPOINTS, GRID, 5.0))
    assert_term(terms(visible_keypoints=True)["attention"], plain_cross_entropy(attention))


def plain_mean_codes() -> np.ndarray:
    """ŝ: Σ over all tokens of p(token) · its bits in {-1, +1}."""
    out = np.zeros((B, T, GRID**2, BITS))
    for index in np.ndindex(B, T, GRID**2):
        p = np.exp(LOGITS[index].astype(np.float64))
        p /= p.sum(-1, keepdims=True)
        for token in range(2**BITS):
            bits = np.array([2 * (token >> c & 1) - 1 for c in range(BITS)])
            out[index] += p[0, token % SIZE] * p[1, token // SIZE] * bits
    return out


def test_mean_codes_are_the_mean_over_all_tokens() -> None:
    np.testing.assert_allclose(lfq.mean_codes(jnp.array(LOGITS), BITS), plain_mean_codes(), atol=1e-5)


@pytest.mark.parametrize("observed", [False, True])
def test_keypoints_are_equation_5_where_they_count(observed: bool) -> None:
    s_hat = plain_mean_codes()
    total = weight = 0.0
    for clip in np.flatnonzero(CLIP_WEIGHT):
        for i in range(5):
            row, column = divmod(int(KEYPOINTS.cells[clip, i, 0]), GRID)
            code = np.array([2 * (int(TOKENS[clip, 0, row, column]) >> c & 1) - 1 for c in range(BITS)])
            first = code if observed else s_hat[clip, 0, row * GRID + column]
            for t in range(1, T):
                cell = int(KEYPOINTS.cells[clip, i, t])
                if KEYPOINTS.visible[clip, i, t]:
                    total += np.sum((s_hat[clip, t, cell] - first) ** 2)
                    weight += 1
    found = terms(observed_anchor=observed, visible_keypoints=True)
    assert_term(found["keypoint"], (total, weight))


def test_the_full_size_presets_have_the_printed_keypoint_terms() -> None:
    """M_i over all frames, Eq. 5 with ŝ_1 and all cells, divided by (T-1)K, and Eq. 6 wherever a track passes."""
    model, *others = (presets.get(f"roboscape_{size}").model for size in ("s", "m", "l"))
    assert isinstance(model, RoboScapeConfig)
    for other in others:
        assert isinstance(other, RoboScapeConfig)
        assert (other.loss, other.departures) == (model.loss, model.departures)
    k = 3
    config = replace(model, loss=replace(model.loss, num_keypoints=k))
    visible = np.array(KEYPOINTS.visible)
    visible[:, :, 0] = True  # as of every point that was sampled in the initial frame
    tracks = tracks_of(KEYPOINTS.cells)
    s_hat = plain_mean_codes()
    distance = 0.0
    attention = np.ones((B, T, GRID, GRID))
    for clip in range(B):
        motion = [sum(float(np.linalg.norm(path[t + 1] - path[t])) for t in range(T - 1)) for path in tracks[clip]]
        for i in np.argsort(motion)[-k:]:
            cells = np.asarray(KEYPOINTS.cells[clip, i])
            distance += sum(np.sum((s_hat[clip, t, cells[t]] - s_hat[clip, 0, cells[0]]) ** 2) for t in range(1, T))
            for t in range(T):
                attention[clip, t].ravel()[cells[t]] = model.loss.gamma
    found = terms_of(config, tracks, visible, np.ones(B, np.float32))
    assert_term(found["keypoint"], (distance, B * (T - 1) * k))
    everywhere = terms_of(config, tracks, visible, CLIP_WEIGHT)
    assert_term(everywhere["attention"], plain_cross_entropy(attention))


def test_a_track_that_begins_hidden_does_not_exist() -> None:
    """A clip without tracks has only such ones, of which no term may see anything."""
    absent = terms(visible=np.zeros((B, 5, T), bool))
    assert absent["keypoint"] == (0, 0)
    assert absent["attention"] == absent["rgb"]


def test_the_objective_is_equation_8() -> None:
    weights = RoboScapeConfig().loss_weights
    assert weights == {"rgb": 1, "depth": 1, "keypoint": 0.01, "attention": 1}  # the paper's λ
    terms = {"rgb": (6.0, 2.0), "depth": (5.0, 5.0), "keypoint": (300.0, 3.0), "attention": (8.0, 2.0)}
    loss, shares = combine({k: (jnp.float32(a), jnp.float32(b)) for k, (a, b) in terms.items()}, weights)
    np.testing.assert_allclose(loss, 3 + 1 * 1 + 0.01 * 100 + 1 * 4, rtol=1e-6)
    assert {name: float(x) for name, x in shares.items()} == {"rgb": 3, "depth": 1, "keypoint": 100, "attention": 4}


def test_shares_of_parts_add_up_to_the_whole_where_mean_of_ratios_would_not() -> None:
    parts = [(jnp.float32(90), jnp.float32(9)), (jnp.float32(1), jnp.float32(1))]
    whole, _ = combine({"rgb": (jnp.float32(91), jnp.float32(10))}, {"rgb": 2.0})
    share = lambda value, weight: combine({"rgb": (value, weight)}, {"rgb": 2.0}, "devices")[0]  # noqa: E731
    shares = jax.vmap(share, axis_name="devices")(*(jnp.stack(column) for column in zip(*parts, strict=True)))
    np.testing.assert_allclose(sum(shares), whole, rtol=1e-6)
    np.testing.assert_allclose(whole, 2 * 9.1, rtol=1e-6)


def test_a_term_without_weight_is_nothing_rather_than_no_number() -> None:
    term = lambda x: combine({"rgb": (x * 0, jnp.float32(0))}, {"rgb": 1.0})[0]  # noqa: E731
    value, gradient = jax.value_and_grad(term)(jnp.float32(3))
    assert (value, gradient) == (0, 0)


@pytest.mark.parametrize("terms", [{"rgb"}, {"rgb", "depth", "keypoint"}], ids=sorted)
def test_terms_and_weights_must_have_the_same_names(terms: set[str]) -> None:
    with pytest.raises(KeyError, match="rgb"):
        combine({name: (jnp.float32(1), jnp.float32(1)) for name in terms}, {"rgb": 1.0, "depth": 1.0})
