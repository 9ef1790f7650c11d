"""Scores and pictures between training steps, against the same numbers computed another way."""

import pickle
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import Config, EarlyStopConfig, EvalConfig, NoDepth
from rsjax.data.clips import readable
from rsjax.data.depth_color import depth_to_color
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.data.store import Record, StoreError, write_store
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.models.base import create_model
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.objective import Batch
from rsjax.models.roboscape.records import ARRAYS, token_batch
from rsjax.models.trained import TrainedModel
from rsjax.tokenizers.tokenize import token_record
from rsjax.tools.pipeline import validation as module
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.validation import TokenizerValidation, WorldModelValidation, record_batches
from rsjax.training.step import combine
from rsjax.training.validation import DRAWS, Validation, _terms, validation_loss
from tests.tools.pipeline import toy

CLIPS = toy.TEST


def config() -> Config:
    return replace(toy.config(), eval=EvalConfig(clips=CLIPS, batch_size=CLIPS, action_draws=1))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run whose clips, tokenizer and tokens are there."""
    base = tmp_path_factory.mktemp("validation")
    run = Run(config(), base / "run", base / "data")
    clips = toy.store(run.clips)
    toy.save_tokenizer(run)
    codec = toy.codec(clips)
    records = (token_record(codec, clip) for _, clip in readable(clips.source("test")))
    write_store(run.output("tokens"), "tokens", {"test": records}, {})
    return run


def batches(run: Run, size: int) -> list[Batch]:
    source, normalization = run.open_prepared().source("test"), Normalization.create(run.open_clips())
    return list(record_batches(create_model(run.config), normalization, source, size, range(CLIPS)))


def trained(run: Run) -> TrainedModel:
    return toy.trained(run.open_clips(), run.config)


def random_state() -> bytes:
    return pickle.dumps(np.random.get_state())


@pytest.fixture(scope="module")
def found(run: Run) -> Validation:
    return WorldModelValidation(run)(7, trained(run).params)


def test_the_loss_is_that_of_the_whole_split_in_one_batch(run: Run, found: Validation) -> None:
    model, params = RoboScape.create(run.config), trained(run).params
    (batch,) = batches(run, CLIPS)
    draws = [_terms(model, params, batch, np.int32(draw)) for draw in range(DRAWS)]
    loss, terms = combine(jax.tree.map(lambda *x: sum(x), *draws), model.loss_weights)
    assert found.metric == found.scalars["validation/loss"] == pytest.approx(float(loss), rel=1e-5)
    for name, term in terms.items():
        assert found.scalars[f"validation/{name}"] == pytest.approx(float(term), rel=1e-5)


def test_batches_with_a_filled_up_last_one_change_the_loss_by_rounding_alone(run: Run, found: Validation) -> None:
    loss = validation_loss(RoboScape.create(run.config), trained(run).params, batches(run, 2))
    assert {f"validation/{k}": pytest.approx(v, rel=1e-5) for k, v in loss.items()}.items() <= found.scalars.items()


def test_the_same_weights_score_the_same_at_any_step_and_are_left_alone(run: Run, found: Validation) -> None:
    params = jax.tree.map(jnp.asarray, trained(run).params)
    before, random = jax.device_get(params), random_state()
    evaluate = WorldModelValidation(run)
    again = evaluate(8, params)
    assert again.scalars == found.scalars
    jax.tree.map(np.testing.assert_array_equal, again.pictures, found.pictures)
    jax.tree.map(np.testing.assert_array_equal, params, before)
    assert random_state() == random
    other = jax.tree.map(lambda x: 1.01 * x, params)
    assert evaluate(10, other).metric != found.metric


def test_the_videos_score_as_in_the_final_evaluation(run: Run, found: Validation) -> None:
    final = evaluation.evaluate(trained(run), run.open_clips()).metrics
    assert found.scalars["validation/psnr"] == pytest.approx(final["psnr"], rel=1e-5)
    assert found.scalars["validation/depth_absrel"] == pytest.approx(final["depth_absrel"], rel=1e-5)


def test_there_is_a_picture_of_each_shown_clip_with_depth_only_where_the_model_has_it(
    run: Run, found: Validation, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(found.pictures) == [f"clip_{number:03d}" for number in range(toy.TEST)]
    blind = Run(toy.with_model(run.config, depth=NoDepth()), run.directory, run.data_directory)
    monkeypatch.setattr(module, "validation_loss", lambda *_: {"loss": 0.5})
    seen = WorldModelValidation(blind)(7, trained(blind).params)
    assert seen.scalars.keys() == {"validation/loss", "validation/psnr", "validation/psnr_motion"}
    assert seen.metric == 0.5
    early = replace(blind.config, train=replace(blind.config.train, early_stop=EarlyStopConfig()))
    by_video = WorldModelValidation(replace(blind, config=early))(7, trained(blind).params)
    assert by_video.metric == -seen.scalars["validation/psnr_motion"]
    assert seen.pictures["clip_000"].shape[0] < found.pictures["clip_000"].shape[0]


def test_the_tokenizer_scores_as_its_codec_does(run: Run) -> None:
    codec = toy.codec(run.open_clips())
    clips = [clip for _, clip in readable(run.open_clips().source("test"))]
    rgb, depth = (np.stack([clip[name] for clip in clips]) for name in ("rgb", "depth"))
    colors = depth_to_color(depth, *toy.DEPTH_RANGE, run.config.tokenizer.depth_scale)
    found = TokenizerValidation(run)(3, codec.params)
    of_rgb = float(psnr(rgb, codec.decode_rgb(codec.encode_rgb(rgb))).mean())
    of_depth = float(psnr(colors, codec.decode_rgb(codec.encode_depth(depth))).mean())
    assert found.scalars == pytest.approx({"validation/psnr": of_rgb, "validation/psnr_depth": of_depth})
    share = run.config.tokenizer_train.depth_share
    assert found.metric == pytest.approx(-(1 - share) * of_rgb - share * of_depth)
    assert list(found.pictures) == [f"clip_{number:03d}" for number in range(toy.TEST)]


class Damaged:
    """A split of which some records cannot be read."""

    def __init__(self, count: int, bad: set[int]) -> None:
        self.count, self.bad = count, bad

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Record:
        if index in self.bad:
            raise StoreError(f"record {index} is damaged")
        return {name: np.full(2, index) for name in ARRAYS}


class Plain:
    """A model whose records are their own arrays."""

    def transform(self, normalization: Normalization) -> Transform:
        return _arrays

    def batch(self, arrays: Arrays) -> Batch:
        return token_batch(arrays)


def _arrays(record: Record, rng: np.random.Generator) -> Arrays:
    return record


def plain_batches(count: int, bad: set[int], size: int) -> list[Batch]:
    model: Any = Plain()
    return list(record_batches(model, Normalization((), (), None), Damaged(count, bad), size, range(count)))


@given(st.integers(1, 9).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.integers(0, n - 1)))), st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_every_readable_clip_counts_once_and_under_its_own_number(split: tuple[int, set[int]], size: int) -> None:
    count, bad = split
    made = plain_batches(count, bad, size)
    assert {batch.index.shape for batch in made} <= {(size,)}
    counted = [(int(i), int(x[0])) for b in made for i, x, w in zip(b.index, b.rgb, b.weight, strict=True) if w]
    assert counted == [(i, i) for i in range(count) if i not in bad]


def test_a_damaged_record_is_named_and_a_split_without_any_is_an_error() -> None:
    told: list[str] = []
    assert [number for number, _ in readable(Damaged(3, {1}), tell=told.append)] == [0, 2]
    assert told == ["record 1 is damaged; it is left out here"]
    with pytest.raises(ValueError, match="no validation clips"):
        validation_loss(RoboScape.create(config()), {}, plain_batches(2, {0, 1}, 2))
