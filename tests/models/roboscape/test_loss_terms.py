from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import CorruptionConfig, Departures, LossConfig, RoboScapeConfig
from rsjax.config.config_fields import with_values
from rsjax.models.roboscape import masking
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.action_dropout import dropped_actions
from rsjax.models.roboscape.departures.visible_keypoints import counted_frames
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.objective import Batch, attention_map, select
from rsjax.models.roboscape.transformer import Transformer, run_transformer, run_with_trunk
from rsjax.tokenizers.flops import products
from rsjax.trainable import StepContext, Term
from rsjax.training.step import combine
from tests.models.roboscape.toy import depart, random_params, roboscape

MODEL = Architecture(frames=4, grid=2, code_bits=4, action_inputs=3, width=8, blocks=1, heads=2)
CORRUPTION, LOSS = CorruptionConfig(), LossConfig(num_keypoints=3)
KEY, CONTEXT = jax.random.key(3), StepContext(jnp.int32(0), None, None)


def model_of(architecture: Architecture, loss: LossConfig) -> RoboScape:
    departures = architecture.departures
    config = RoboScapeConfig(departures=departures, loss=loss, corruption=CORRUPTION)
    return roboscape(architecture, with_values(config, {"depth": architecture.depth}))


@partial(jax.jit, static_argnums=(0, 1))
def terms_of(architecture: Architecture, loss: LossConfig, params: Any, batch: Batch) -> dict[str, Term]:
    return model_of(architecture, loss).loss_terms(params, batch, KEY, CONTEXT)


def random_batch(clips: int = 3) -> Batch:
    rng = np.random.default_rng(2)
    tokens = [rng.integers(0, 2**MODEL.code_bits, (clips, 4, 2, 2), np.int32) for _ in range(2)]
    fields: dict[str, Any] = {
        "rgb": tokens[0],
        "depth": tokens[1],
        "actions": rng.normal(size=(clips, 4, 3)).astype(np.float32),
        "tracks": rng.random((clips, 7, 4, 2)).astype(np.float32),
        "visible": rng.random((clips, 7, 4)) < 0.7,
        "weight": np.array([1, 1, 0] + [1] * (clips - 3), np.float32)[:clips],
        "index": np.arange(clips, dtype=np.int32),
    }
    return Batch(**fields)


@pytest.mark.parametrize(
    ("depth", "settings", "names"),
    [
        ("branch", {"keypoints": "none"}, {"depth"}),
        ("none", {"keypoints": "difference"}, {"keypoint", "attention"}),
        ("branch", {"keypoints": "motion", "attention_weight": 0.0}, {"depth", "keypoint"}),
        ("head", {"keypoints": "feature", "keypoint_weight": 0.0}, {"depth", "attention"}),
        ("head", {"keypoint_weight": 0.0, "attention_weight": 0.0, "depth_weight": 0.0}, set()),
    ],
)
def test_what_is_off_or_has_a_weight_of_0_has_no_term(depth: Any, settings: dict[str, Any], names: set[str]) -> None:
    model = replace(MODEL, depth=depth, motion_head=settings.get("keypoints") == "motion")
    loss = replace(LOSS, **settings)
    shapes = jax.eval_shape(Transformer(model).init_params, KEY)
    terms = jax.eval_shape(partial(terms_of, model, loss), shapes, random_batch())
    assert terms.keys() == model_of(model, loss).loss_weights.keys() == {"rgb"} | names


def test_points_that_the_first_frame_hides_never_count() -> None:
    visible = jnp.array([[[True, False, True], [False, True, True]]])
    for departures, rows in ((Departures(), [True] * 3), (Departures(visible_keypoints=True), [True, False, True])):
        np.testing.assert_array_equal(counted_frames(departures, visible), [[rows, [False] * 3]])


corrupt = jax.jit(partial(masking.corrupt, CORRUPTION, 0.0, 1, MODEL.code_bits, MODEL.vocabularies))


@pytest.mark.parametrize("model", [MODEL, replace(MODEL, depth="head")], ids=["branch", "head"])
def test_each_modality_is_scored_on_its_own_clean_tokens_where_masked(model: Architecture) -> None:
    """Of clips without depth RGB alone, by a model to which all their depth is hidden."""
    has = np.array([1, 0, 1], np.float32)
    params = random_params(model)
    batch = random_batch().replace(has_depth=has)  # type: ignore[attr-defined]
    clean = {name: jnp.asarray(getattr(batch, name)) for name in model.modalities}
    given = corrupt(KEY, clean, batch.index)
    inputs = (given.tokens, given.mask, batch.actions)
    logits, _ = jax.jit(Transformer(model).apply)({"params": params}, *inputs, no_depth=has == 0)
    counted = counted_frames(Departures(), batch.visible)
    points = select(batch.tracks, counted, LOSS.num_keypoints, model.grid)
    emphasis = np.asarray(attention_map(points, model.grid, LOSS.gamma))

    expected = dict.fromkeys(("rgb", "depth", "attention"), 0.0)
    cells = dict.fromkeys(expected, 0)
    for clip, t, row, column in np.argwhere(np.asarray(given.mask)):
        if not batch.weight[clip]:
            continue
        for name in clean:
            if name == "depth" and not has[clip]:
                continue
            score, token = 0.0, int(clean[name][clip, t, row, column])
            for k in range(2):
                x = np.asarray(logits[name][clip, t, 2 * row + column, k])
                score += float(np.log(np.exp(x).sum()) - x[(token // 4**k) % 4])
            expected[name] += score
            cells[name] += 1
            if name == "rgb":
                expected["attention"] += score * emphasis[clip, t, row, column]
                cells["attention"] += 1

    terms = terms_of(model, LOSS, params, batch)
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name], (value, cells[name]), rtol=1e-4, err_msg=name)


def test_whole_frames_are_scored_in_every_cell_after_the_first_frame() -> None:
    model = depart(MODEL, read_previous=True, whole_frames=True)
    batch = random_batch()
    scored = {name: float(weight) for name, (_, weight) in terms_of(model, LOSS, random_params(model), batch).items()}
    frames, cells = MODEL.frames - 1, MODEL.grid**2
    assert scored["rgb"] == scored["depth"] == scored["attention"] == batch.weight.sum() * frames * cells


WEIGHTS = model_of(MODEL, LOSS).loss_weights


def objective(params: Any, batch: Batch, weights: dict[str, float]) -> tuple[Any, Any]:
    return combine(terms_of(MODEL, LOSS, params, batch), weights)


GRADIENT = jax.jit(jax.value_and_grad(objective, has_aux=True))


def test_where_every_clip_has_depth_it_is_as_if_nothing_was_said() -> None:
    params, batch = random_params(MODEL), random_batch()
    told = batch.replace(has_depth=np.ones(3, np.float32))  # type: ignore[attr-defined]
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)  # two programs, which may round differently
    jax.tree.map(close, GRADIENT(params, told, WEIGHTS), GRADIENT(params, batch, WEIGHTS))


def test_of_a_batch_without_depth_the_branch_learns_by_what_it_tells_rgb_alone() -> None:
    params, batch = random_params(MODEL), random_batch()
    none = batch.replace(has_depth=np.zeros(3, np.float32))  # type: ignore[attr-defined]
    (loss, shares), gradient = GRADIENT(params, none, WEIGHTS)
    assert shares["depth"] == 0
    assert np.isfinite(loss)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(gradient))
    learns = lambda tree: any(np.any(x) for x in jax.tree.leaves(tree))  # noqa: E731
    embed = gradient["depth_embed"]
    assert not learns([gradient["depth_head"], embed["factored_embed_0"], embed["factored_embed_1"]])
    assert learns(embed["mask_token_embed"])
    assert learns(gradient["blocks"]["depth"])


def test_depth_tokens_of_a_clip_without_depth_change_nothing() -> None:
    params, batch = random_params(MODEL), random_batch()
    has = np.array([1, 0, 1], np.float32)
    other = np.r_[batch.depth[:1], batch.depth[1:2] ^ 15, batch.depth[2:]]
    before, after = (
        GRADIENT(params, batch.replace(has_depth=has, depth=depth), WEIGHTS)  # type: ignore[attr-defined]
        for depth in (batch.depth, other)
    )
    jax.tree.map(np.testing.assert_array_equal, before, after)
    all_told = batch.replace(has_depth=np.ones(3, np.float32))  # type: ignore[attr-defined]
    assert GRADIENT(params, all_told, WEIGHTS)[0][1]["rgb"] != before[0][1]["rgb"]


def test_a_padding_clip_changes_nothing() -> None:
    params, batch = random_params(MODEL), random_batch()
    other = batch.replace(  # type: ignore[attr-defined]
        rgb=np.r_[batch.rgb[:2], batch.rgb[2:] ^ 15],
        depth=np.r_[batch.depth[:2], batch.depth[2:] ^ 15],
        actions=np.r_[batch.actions[:2], batch.actions[2:] + 1],
        tracks=np.r_[batch.tracks[:2], 1 - batch.tracks[2:]],
    )
    before, after = (terms_of(MODEL, LOSS, params, x) for x in (batch, other))
    jax.tree.map(np.testing.assert_array_equal, before, after)
    counted = terms_of(MODEL, LOSS, params, other.replace(weight=np.ones(3, np.float32)))
    for name, (total, weight) in counted.items():
        assert total > after[name][0]
        assert weight > after[name][1]


def test_rgb_terms_teach_the_depth_branch_and_not_the_other_way_round() -> None:
    params, batch = random_params(MODEL), random_batch()
    for term in WEIGHTS:
        _, gradient = GRADIENT(params, batch, dict.fromkeys(WEIGHTS, 0.0) | {term: 1.0})
        assert np.any(gradient["blocks"]["depth"]["fc1"]["kernel"])  # of RGB's through the projection of Eq. 3
        assert np.any(gradient["blocks"]["rgb"]["fc1"]["kernel"]) == (term != "depth")


@pytest.mark.parametrize("keypoints", ["motion", "feature"])
def test_a_keypoint_term_on_features_teaches_the_trunk_and_not_the_heads_of_tokens(keypoints: Any) -> None:
    model = replace(MODEL, motion_head=keypoints == "motion")
    loss = replace(LOSS, keypoints=keypoints)
    params = random_params(model)
    batch = random_batch()
    gradient = jax.jit(jax.grad(lambda params: terms_of(model, loss, params, batch)["keypoint"][0]))(params)
    for branch in ("rgb", "depth"):  # depth by Eq. 3
        assert np.any(gradient["blocks"][branch]["fc1"]["kernel"])
    assert np.any(gradient["action_encoder"]["kernel"])
    assert not np.any(gradient["rgb_head"]["kernel"])
    assert ("motion_head" in gradient) == (keypoints == "motion")
    if keypoints == "motion":
        assert np.any(gradient["motion_head"]["out"]["kernel"])


def test_a_motion_head_changes_no_logit_and_is_not_run_in_sampling() -> None:
    model = replace(MODEL, motion_head=True)
    params = random_params(model)
    plain = {name: part for name, part in params.items() if name != "motion_head"}
    tokens = {name: jnp.asarray(getattr(random_batch(), name)) for name in MODEL.branches}
    inputs = (tokens, tokens["rgb"] % 2 == 0, random_batch().actions)
    programs = [
        jax.make_jaxpr(partial(run_transformer, model))(params, *inputs),
        jax.make_jaxpr(partial(run_transformer, MODEL))(plain, *inputs),
    ]
    assert len({products(program.jaxpr) for program in programs}) == 1
    logits = jax.jit(partial(run_with_trunk, model))(params, *inputs)[0]
    jax.tree.map(np.testing.assert_array_equal, logits, jax.jit(partial(run_transformer, MODEL))(plain, *inputs)[0])


def test_training_on_dropped_actions_teaches_the_null_action_and_the_encoder() -> None:
    model, loss = depart(MODEL, action_dropout=0.5), LossConfig(keypoints="none")
    params, batch = random_params(model), random_batch(8)
    drop = dropped_actions(0.5, KEY, batch.index)
    assert {False, True} == set(np.asarray(drop).tolist())
    gradient = jax.jit(jax.grad(lambda params: terms_of(model, loss, params, batch)["rgb"][0]))(params)
    assert np.any(gradient["null_action"])
    assert np.any(gradient["action_encoder"]["kernel"])
