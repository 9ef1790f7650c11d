"""State heads against their equations, and their readings in every way of generating against recomputed passes."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import RoboScapeConfig, SampleConfig, StateHeadsConfig
from rsjax.data.state_labels import STATE, state_labels
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures import state_heads
from rsjax.models.roboscape.sample import encode_prompt, rollout, rollout_from
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.models.roboscape.transformer import Transformer, run_with_trunk
from rsjax.tokenizers.flops import products
from rsjax.trainable import StepContext
from tests.models.roboscape.toy import depart, layer_norm, random_inputs, roboscape
from tests.models.roboscape.toy_sample import BATCH, KEY, given, random_params

HEADS = Architecture(
    frames=6, grid=3, code_bits=6, action_inputs=4, width=16, blocks=2, heads=2, depth="none", state_heads=True
)
DUAL = replace(HEADS, depth="branch")
WHOLE = depart(HEADS, integrate_actions=True, read_previous=True, whole_frames=True)
GUIDED = depart(HEADS, action_dropout=0.1, rotary=True, read_previous=True)
WINDOWS = SampleConfig(steps=2, unmask="greedy", window_stride=2)
CONTEXT = StepContext(jnp.int32(0), None, None)


def sigmoid(x: Any) -> Any:
    return 1 / (1 + np.exp(-x))


def plain_outputs(params: Any, features: np.ndarray) -> np.ndarray:
    """The equations of the heads, cell by cell."""
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params["state_heads"])
    out = np.zeros((*features.shape[:2], len(STATE)))
    for (clip, t, k), _ in np.ndenumerate(out):
        normed = [layer_norm(cell, p["norm"]) for cell in np.asarray(features[clip, t], np.float64)]
        scores = np.exp([p["query"]["kernel"][:, k] @ n for n in normed])
        values = [p["out"]["kernel"][:, k] @ n for n in normed]
        out[clip, t, k] = (scores / scores.sum()) @ values + p["out"]["bias"][k]
    return out


def test_each_quantity_is_read_from_the_cells_that_its_query_finds() -> None:
    params = random_params(HEADS)
    features = np.random.default_rng(0).normal(size=(2, 3, 9, 16)).astype(np.float32)
    y = plain_outputs(params, features)
    np.testing.assert_allclose(state_heads.outputs(params, features), y, rtol=1e-4, atol=1e-5)
    read = np.concatenate([sigmoid(y[..., :1]), 0.1 * y[..., 1:]], axis=-1)
    np.testing.assert_allclose(state_heads.readings(params, features), read, rtol=1e-4, atol=1e-5)
    fresh = jax.jit(Transformer(HEADS).init_params)(KEY)["state_heads"]
    mean = layer_norm(features, fresh["norm"]).mean(2)
    linear = mean @ fresh["out"]["kernel"] + fresh["out"]["bias"]
    np.testing.assert_allclose(state_heads.outputs({"state_heads": fresh}, features), linear, rtol=1e-4, atol=1e-5)


def test_losses_are_means_over_the_frames_that_have_labels() -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(scale=2, size=(3, 4, 3)).astype(np.float32)
    labels = np.stack(
        [rng.random((3, 4)) < 0.5, rng.uniform(0, 0.3, (3, 4)), rng.uniform(0, 0.08, (3, 4))], axis=-1
    ).astype(np.float32)
    labels[0, :, 1:] = np.nan  # a recording that says only whether it succeeds
    labels[1, 2, 0] = np.nan
    weight = np.array([1, 1, 0], np.float32)
    expected = dict.fromkeys(STATE, 0.0)
    counts = dict.fromkeys(STATE, 0)
    for clip, t in np.ndindex(3, 4):
        for k, name in enumerate(STATE):
            label = float(labels[clip, t, k])
            if np.isnan(label) or not weight[clip]:
                continue
            if name == "success":
                p = sigmoid(float(y[clip, t, k]))
                error = -np.log(p if label else 1 - p)
            else:
                gap = abs(float(y[clip, t, k]) - label / 0.1)
                error = gap**2 / 2 if gap <= 1 else gap - 0.5
            expected[name] += error
            counts[name] += 1
    terms = state_heads.loss_terms(y, labels, weight)
    for name in STATE:
        np.testing.assert_allclose(terms[name], (expected[name], counts[name]), rtol=1e-5, err_msg=name)
    gradient = jax.grad(lambda y: sum(x[0] for x in state_heads.loss_terms(y, labels, weight).values()))(y)  # type: ignore[misc]
    assert np.isfinite(gradient).all()
    assert not np.any(np.asarray(gradient)[np.isnan(labels)])


def batch_of(arch: Architecture, state: np.ndarray | None) -> Any:
    tokens, _, actions = random_inputs(arch)
    clips, frames = len(actions), arch.frames
    arrays = {
        "rgb": tokens["rgb"],
        "depth": tokens.get("depth", np.zeros_like(tokens["rgb"])),
        "actions": actions,
        "tracks": np.random.default_rng(2).random((clips, 5, frames, 2)).astype(np.float32),
        "visible": np.ones((clips, 5, frames), bool),
        "has_depth": np.ones(clips, np.float32),
    }
    if state is not None:
        arrays["state"] = state
    return roboscape(arch).batch(arrays)


def terms_of(arch: Architecture, heads: StateHeadsConfig | None, params: Any, state: np.ndarray | None) -> Any:
    config = RoboScapeConfig(departures=arch.departures, state_heads=heads)
    model = roboscape(arch, config)
    batch = batch_of(arch, state)
    return jax.jit(lambda params, batch: model.loss_terms(params, batch, KEY, CONTEXT))(params, batch), model


def test_the_heads_add_their_terms_and_leave_all_others_to_the_bit() -> None:
    params = random_params(DUAL)
    plain = {name: part for name, part in params.items() if name != "state_heads"}
    labels = np.random.default_rng(3).random((2, DUAL.frames, 3)).astype(np.float32)
    labels[..., 0] = labels[..., 0] > 0.5
    on, model = terms_of(DUAL, StateHeadsConfig(height_weight=0), params, labels)
    off, without = terms_of(replace(DUAL, state_heads=False), None, plain, None)
    assert on.keys() - off.keys() == {"success", "opening"}
    assert on.keys() == model.loss_weights.keys()
    assert off.keys() == without.loss_weights.keys()
    for name, term in off.items():
        np.testing.assert_array_equal(on[name], term, err_msg=name)


def test_the_terms_teach_the_trunk_and_clips_without_labels_teach_nothing() -> None:
    params = random_params(DUAL)
    labels = np.full((2, DUAL.frames, 3), np.nan, np.float32)
    labels[0] = 0.0
    model = roboscape(DUAL, RoboScapeConfig(state_heads=StateHeadsConfig()))

    def total(params: Any, labels: Any) -> Any:
        terms = model.loss_terms(params, batch_of(DUAL, labels), KEY, CONTEXT)
        return sum(terms[name][0] for name in STATE)

    gradient_of = jax.jit(jax.grad(total))
    gradient = gradient_of(params, labels)
    assert np.any(gradient["blocks"]["rgb"]["fc1"]["kernel"])
    assert np.any(gradient["state_heads"]["query"]["kernel"])
    assert not np.any(gradient["rgb_head"]["kernel"])
    none = gradient_of(params, np.full_like(labels, np.nan))
    assert not any(np.any(x) for x in jax.tree.leaves(none))


@pytest.mark.parametrize(
    ("arch", "sample", "prompt"),
    [
        (DUAL, WINDOWS, 2),
        (WHOLE, SampleConfig(steps=1, mean_codes=True, read_means=True, window_stride=2), 1),
        (GUIDED, SampleConfig(steps=2, guidance=2.0), 3),
    ],
    ids=["windows", "whole-frames", "rotary-guided"],
)
def test_what_is_read_with_the_cache_is_what_full_passes_read(
    arch: Architecture, sample: SampleConfig, prompt: int
) -> None:
    params = random_params(arch)
    tokens, actions = given(arch, prompt, 11)
    made = rollout(arch, sample, params, tokens, actions, KEY)
    full = rollout(arch, sample, params, tokens, actions, KEY, cached=False)
    read = np.asarray(made["state"])
    assert read.shape == (BATCH, 11, len(STATE))
    assert np.isnan(read[:, : prompt - 1]).all()
    assert np.ptp(read[:, prompt - 1 :], axis=1).min() > 0
    np.testing.assert_allclose(read, full["state"], atol=1e-4)


def test_the_heads_change_no_token_and_read_a_prompts_last_frame_from_a_full_pass_over_it() -> None:
    params = random_params(DUAL)
    tokens, actions = given(DUAL, 2, 11)
    made = rollout(DUAL, WINDOWS, params, tokens, actions, KEY)
    others = rollout(replace(DUAL, state_heads=False), WINDOWS, params, tokens, actions, KEY)
    for name, grid in others.items():
        np.testing.assert_array_equal(made[name], grid, err_msg=name)
    visible = np.zeros(tokens["rgb"].shape, bool)
    _, _, trunk = jax.jit(partial(run_with_trunk, DUAL))(params, tokens, visible, actions[:, :2])
    np.testing.assert_allclose(made["state"][:, 1], state_heads.readings(params, trunk)[:, 1], atol=1e-5)
    first = encode_prompt(DUAL, WINDOWS, params, {name: x[:1] for name, x in tokens.items()}, actions[:1, :2])
    again = rollout_from(DUAL, WINDOWS, params, first, actions[:1, 2:], KEY)
    np.testing.assert_allclose(again["state"], made["state"][:1], atol=1e-4)


@pytest.mark.parametrize("arch", [DUAL, WHOLE], ids=["dual", "sums-of-whole-frames"])
def test_teacher_forcing_on_a_greedy_rollout_reads_what_the_rollout_read(arch: Architecture) -> None:
    sample = SampleConfig(steps=1)
    params = random_params(arch)
    tokens, actions = given(arch, 1)
    made = rollout(arch, sample, params, tokens, actions, KEY)
    grids = {name: made[name] for name in arch.modalities}
    scores = score_tokens(arch, sample, params, grids, actions, np.zeros(BATCH, bool), 1)
    assert scores.state is not None and scores.features is not None
    np.testing.assert_allclose(scores.state, np.asarray(made["state"])[:, 1:], atol=1e-4)
    assert scores.features.shape == (BATCH, 5, arch.width)


def test_the_heads_cost_their_formula() -> None:
    plain = replace(HEADS, state_heads=False)
    params = jax.eval_shape(Transformer(HEADS).init_params, KEY)
    features = jax.ShapeDtypeStruct((1, HEADS.frames, HEADS.grid**2, HEADS.width), jnp.float32)
    cost = products(jax.make_jaxpr(state_heads.readings)(params, features).jaxpr)
    without = roboscape(plain).flops(HEADS.frames)
    assert roboscape(HEADS).flops(HEADS.frames) == {
        "forward": without["forward"] + cost,
        "train": without["train"] + 3 * cost,
    }


def test_labels_of_a_record_are_nan_where_it_has_none() -> None:
    actions = np.zeros((2, 3), np.float32)
    objects = {"cube": [[0, 0]] * 2, "height": [0.02, 0.1], "opening": [0.08, 0.04]}
    simulated = {"actions": actions, "success": np.array([False, True]), "provenance": {"objects": objects}}
    np.testing.assert_allclose(state_labels(simulated), [[0, 0.02, 0.08], [1, 0.1, 0.04]])
    older = simulated | {"provenance": {"objects": {"cube": [[0, 0]] * 2}}}
    np.testing.assert_array_equal(state_labels(older), [[0, np.nan, np.nan], [1, np.nan, np.nan]])
    for other in ({}, {"objects": ["cup", "plate"]}, {"objects": {"height": [1.0], "opening": "wide"}}):
        assert np.isnan(state_labels({"actions": actions, "provenance": other})).all()
