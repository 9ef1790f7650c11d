"""A second view: another stream of tokens on the RGB branch."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import Config, ConfigError, GenieConfig, SampleConfig
from rsjax.data.clips import load_clips
from rsjax.data.store import Store, StoreError, encode_clip, open_store, write_store
from rsjax.evaluation.generation import with_baselines
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.models.roboscape import objective, pretrained
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.second_view import NoSecondView
from rsjax.models.roboscape.objective import Batch
from rsjax.models.roboscape.sample import rollout
from rsjax.models.trained import TrainedModel
from rsjax.tokenizers import lfq
from rsjax.tools.convert.directory import save
from tests.models.roboscape.toy import depart, forward, random_inputs
from tests.models.roboscape.toy_sample import BATCH, HEAD, KEY, RGB, given, random_params
from tests.tools.pipeline import toy

ONE = depart(HEAD, read_previous=True, whole_frames=True)
TWO = replace(ONE, second_view=True)
ALONE = replace(RGB, second_view=True)
MEANS = SampleConfig(steps=1, mean_codes=True, read_means=True)


def with_view(config: Config) -> Config:
    return replace(config, sim=replace(config.sim, second_view="wrist"))


def seen_twice(path: Path, one: Store) -> Store:
    """The same clips, with noise as their second view."""
    rng = np.random.default_rng(0)
    splits = {}
    for split in ("train", "test"):
        source = one.source(split)
        records = [source[number] for number in range(len(source))]
        splits[split] = [record | {"second": rng.integers(0, 256, record["rgb"].shape, np.uint8)} for record in records]
    meta = {name: value for name, value in one.manifest.items() if name not in ("format", "splits", "kind")}
    write_store(path, "clips", splits, meta | {"key": "twice"})
    return open_store(path)


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, Store]:
    folder = tmp_path_factory.mktemp("views")
    one = toy.store(folder / "one")
    return one, seen_twice(folder / "two", one)


@pytest.fixture(scope="module")
def trained(stores: tuple[Store, Store]) -> TrainedModel:
    return toy.trained(stores[1], with_view(toy.with_model(toy.config(), sample=MEANS)))


def test_a_cached_rollout_is_one_that_recomputes_every_pass() -> None:
    params, (tokens, actions) = random_params(TWO), given(TWO, 2)
    cached, plain = (rollout(TWO, MEANS, params, tokens, actions, KEY, cached=each) for each in (True, False))
    assert cached.keys() == set(TWO.modalities)
    for branch, grid in cached.items():
        np.testing.assert_allclose(grid, plain[branch], atol=1e-4, err_msg=branch)
        assert np.ptp(np.asarray(grid)[:, 2:]) > 0


def test_each_view_is_predicted_from_both() -> None:
    params, (tokens, mask, actions) = random_params(TWO), random_inputs(TWO)
    both = forward(TWO, params, (tokens, mask, actions))
    for changed in ("rgb", "second"):
        other = forward(TWO, params, (tokens | {changed: tokens[changed] ^ 9}, mask, actions))
        for name in ("rgb", "second"):
            assert np.abs(other[name] - both[name]).max() > 0.01


def test_training_continues_a_model_of_one_view(tmp_path: Path) -> None:
    saved = random_params(ONE)
    save(tmp_path, ONE, saved)
    assert pretrained.shapes(TWO, tmp_path).keys() == saved.keys()
    params = pretrained.start(random_params(TWO), saved, tmp_path)
    tokens, mask, actions = random_inputs(TWO)
    begun = forward(TWO, params, (tokens, mask, actions))
    single = forward(ONE, saved, ({name: tokens[name] for name in ("rgb", "depth")}, mask, actions))
    for name, logits in single.items():
        np.testing.assert_array_equal(begun[name], logits)


def test_its_loss_is_the_cross_entropy_of_its_masked_tokens() -> None:
    config = GenieConfig()
    inputs: Any = random_inputs(ALONE)
    tokens, mask, actions = inputs
    shape = (BATCH, ALONE.frames, ALONE.grid**2, ALONE.vocabularies, ALONE.vocabulary_size)
    logits: Any = {name: np.random.default_rng(i).normal(size=shape) for i, name in enumerate(ALONE.modalities)}
    tracks = np.zeros((BATCH, 1, ALONE.frames, 2), np.float32)
    weight = np.array([1, 0], np.float32)  # the second clip is padding
    seen = np.ones(tracks.shape[:3], bool)
    batch = Batch(
        tokens["rgb"], tokens["rgb"], actions, tracks, seen, weight, np.arange(BATCH), second=tokens["second"]
    )
    terms = objective.loss_terms(config, ALONE, logits, tokens, mask, batch)
    assert terms.keys() == objective.loss_weights(config, ALONE).keys() == {"rgb", "second"}
    for name in terms:
        nats = lfq.token_cross_entropy(logits[name], tokens[name], ALONE.code_bits)
        np.testing.assert_allclose(terms[name][0], np.sum((nats * mask)[0]), rtol=1e-5)
        assert terms[name][1] == mask[0].sum()


def test_tokens_of_both_views_are_kept_and_the_first_are_those_of_one_view(
    stores: tuple[Store, Store], trained: TrainedModel, tmp_path: Path
) -> None:
    one, two = stores
    codec = toy.codec(two)
    models = (trained.model, toy.trained(one).model)
    made: Any = [
        model.prepare(store, trained.assets, tmp_path, 0.0) for model, store in zip(models, (two, one), strict=True)
    ]
    tokens, alone = (each.source("test")[0] for each in made)
    assert tokens.keys() == alone.keys() | {"second"}
    for name in ("rgb", "depth"):
        np.testing.assert_array_equal(tokens[name], alone[name])
    np.testing.assert_array_equal(tokens["second"], codec.encode_rgb(two.source("test")[0]["second"]))
    with pytest.raises(StoreError) as refused:
        trained.model.prepare(one, trained.assets, tmp_path, 0.0)
    assert "its clips have no second view" in str(refused.value)


def test_both_views_are_generated_and_both_prompts_are_needed(
    stores: tuple[Store, Store], trained: TrainedModel
) -> None:
    clip = stores[1].source("test")[0]
    first = Video(clip["rgb"][None, :1], clip["depth"][None, :1], second=clip["second"][None, :1])
    inputs = (trained.params, trained.assets)
    actions = clip["actions"][None]
    video = trained.model.generate(*inputs, first, actions)
    assert video.second is not None
    assert video.second.shape == video.rgb.shape == clip["rgb"][None].shape
    assert np.ptp(video.second[:, 1:], axis=1).max() > 0
    imagination = trained.model.imagine(*inputs, clips=1)
    imagination.restart(np.array([True]), first, np.zeros(1, int))
    for number in range(1, 3):
        frame = imagination.step(actions[:, number])
        assert np.abs(frame.rgb[:, 0].astype(int) - video.rgb[:, number]).max() <= 1
    blind = replace(first, second=None)
    branching = trained.model.branching(*inputs, has_depth=True)
    assert branching.begin(first).tokens.keys() == {"rgb", "depth", "second"}
    for refused in (
        lambda: trained.model.generate(*inputs, blind, actions),
        lambda: imagination.restart(np.array([True]), blind, np.zeros(1, int)),
        lambda: branching.begin(blind),
        lambda: trained.generate(clip["rgb"][:1], clip["actions"], clip["depth"][:1]),
    ):
        with pytest.raises(NoSecondView):
            refused()


def test_an_evaluation_scores_the_first_view_alone(stores: tuple[Store, Store], trained: TrainedModel) -> None:
    clips = load_clips(stores[1], toy.TEST)
    assert clips.second is not None
    later = np.concatenate([clips.second[:, :1], np.zeros_like(clips.second[:, 1:])], axis=1)
    scores = []
    for each in (clips, replace(clips, second=later)):
        video = trained.model.generate(*(trained.params, trained.assets), each.video.frames(0, 1), each.actions)
        shown = with_baselines(trained, each, video, 1)
        scores.append([psnr(each.rgb, other.rgb) for other in shown.values()])
    np.testing.assert_array_equal(scores[0], scores[1])


def test_other_families_and_other_arms_refuse_it() -> None:
    debug = toy.config()
    genie = with_view(replace(debug, model=GenieConfig()))
    assert Architecture.create(genie).modalities == ("rgb", "second")
    irasim = debug.with_family("irasim")
    meta = replace(debug.sim, env="metaworld", camera="near")
    for refused in (lambda: with_view(irasim), lambda: replace(meta, second_view="wrist")):
        with pytest.raises(ConfigError) as error:
            refused()
        assert str(error.value).startswith("sim.second_view is wrist, ")


def test_a_clip_without_a_second_view_is_stored_as_before() -> None:
    assert "second" not in encode_clip(toy.clip(0))
    seen = replace(toy.clip(0), second=toy.clip(1).rgb)
    assert encode_clip(seen).keys() == encode_clip(toy.clip(0)).keys() | {"second"}
