"""What is looked at between training steps, against the same numbers found another way."""

import pickle
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.clip import Batch
from rsjax.config import Config, EvalConfig
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays, Transform
from rsjax.data.store import Record, StoreError, open_store, write_store
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.pixels import psnr
from rsjax.models.roboscape.losses import combine
from rsjax.pipeline import validation as module
from rsjax.pipeline.clips import readable
from rsjax.pipeline.generator import Generator
from rsjax.pipeline.run import Run
from rsjax.pipeline.tokens import token_record
from rsjax.pipeline.transforms import TOKEN_ARRAYS, token_clip
from rsjax.pipeline.validation import TokenizerHeldOut, WorldModelHeldOut, token_batches
from rsjax.training.checkpoint import save_weights
from rsjax.training.objectives import WorldModelObjective
from rsjax.training.validation import DRAWS, HeldOut, _terms, held_out_loss
from tests.pipeline import toy

CLIPS = toy.TEST


def config() -> Config:
    return replace(toy.config(), eval=EvalConfig(clips=CLIPS, batch_size=CLIPS, action_draws=1, report_clips=2))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run whose clips, tokenizer and tokens are there."""
    base = tmp_path_factory.mktemp("held_out")
    run = Run(config(), base / "run", base / "data")
    clips = toy.store(run.clips)
    codec = generator(run).codec
    (run.directory / "tokenizer").mkdir(parents=True)
    save_weights(run.output("tokenizer"), codec.params)
    records = (token_record(codec, clip) for _, clip in readable(clips.source("test")))
    write_store(run.output("tokens"), "tokens", {"test": records}, {})
    return run


def batches(run: Run, size: int) -> list[Batch]:
    return list(token_batches(run.open_tokens().source("test"), transform(run), size))


def transform(run: Run) -> Transform:
    return partial(token_clip, Normalization.create(run.open_clips()), run.config.model.integrate_actions)


def generator(run: Run) -> Generator:
    return replace(toy.generator(open_store(run.clips)), config=run.config)


def random_state() -> bytes:
    return pickle.dumps(np.random.get_state())


@pytest.fixture(scope="module")
def found(run: Run) -> HeldOut:
    return WorldModelHeldOut(run)(7, generator(run).params)


def test_the_loss_is_that_of_the_whole_split_in_one_batch(run: Run, found: HeldOut) -> None:
    objective, params = WorldModelObjective.create(run.config), generator(run).params
    (batch,) = batches(run, CLIPS)
    draws = [_terms(objective, params, batch, np.int32(draw)) for draw in range(DRAWS)]
    loss, terms = combine(jax.tree.map(lambda *x: sum(x), *draws), objective.weights)
    assert found.metric == found.scalars["held_out/loss"] == pytest.approx(float(loss), rel=1e-5)
    for name, term in terms.items():
        assert found.scalars[f"held_out/{name}"] == pytest.approx(float(term), rel=1e-5)


def test_batches_with_a_filled_up_last_one_change_the_loss_by_rounding_alone(run: Run, found: HeldOut) -> None:
    loss = held_out_loss(WorldModelObjective.create(run.config), generator(run).params, batches(run, 2))
    assert {f"held_out/{k}": pytest.approx(v, rel=1e-5) for k, v in loss.items()}.items() <= found.scalars.items()


def test_the_same_weights_score_the_same_at_any_step_and_are_left_alone(run: Run, found: HeldOut) -> None:
    params = jax.tree.map(jnp.asarray, generator(run).params)
    before, random = jax.device_get(params), random_state()
    evaluate = WorldModelHeldOut(run)
    again = evaluate(8, params)
    assert again.scalars == found.scalars
    jax.tree.map(np.testing.assert_array_equal, again.pictures, found.pictures)
    jax.tree.map(np.testing.assert_array_equal, params, before)
    assert random_state() == random
    other = jax.tree.map(lambda x: 1.01 * x, params)
    assert evaluate(10, other).metric != found.metric


def test_the_videos_score_as_in_the_final_evaluation(run: Run, found: HeldOut) -> None:
    final = evaluation.evaluate(generator(run), open_store(run.clips)).metrics
    assert found.scalars["held_out/psnr"] == pytest.approx(final["psnr"], rel=1e-5)
    assert found.scalars["held_out/depth_absrel"] == pytest.approx(final["depth_absrel"], rel=1e-5)


def test_there_is_a_picture_of_each_shown_clip_with_depth_only_where_the_model_has_it(
    run: Run, found: HeldOut, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(found.pictures) == ["clip_000", "clip_001"]
    cfg = run.config
    blind = Run(replace(cfg, model=replace(cfg.model, depth=False)), run.directory, run.data_directory)
    shapes = jax.eval_shape(WorldModelObjective.create(blind.config).init, jax.random.key(0))
    monkeypatch.setattr(module, "held_out_loss", lambda *_: {"loss": 0.5})
    seen = WorldModelHeldOut(blind)(7, jax.tree.map(lambda x: np.ones(x.shape, x.dtype), shapes))
    assert seen.scalars.keys() == {"held_out/loss", "held_out/psnr"}
    assert seen.pictures["clip_000"].shape[0] < found.pictures["clip_000"].shape[0]


def test_the_tokenizer_scores_as_its_codec_does(run: Run) -> None:
    codec = generator(run).codec
    clips = [clip for _, clip in readable(open_store(run.clips).source("test"))]
    rgb, depth = (np.stack([clip[name] for clip in clips]) for name in ("rgb", "depth"))
    colors = depth_to_color(depth, *toy.DEPTH_RANGE, run.config.tokenizer.depth_scale)
    found = TokenizerHeldOut(run)(3, codec.params)
    of_rgb = float(psnr(rgb, codec.decode_rgb(codec.encode_rgb(rgb))).mean())
    of_depth = float(psnr(colors, codec.decode_rgb(codec.encode_depth(depth))).mean())
    assert found.scalars == pytest.approx({"held_out/psnr": of_rgb, "held_out/psnr_depth": of_depth})
    share = run.config.tokenizer_train.depth_share
    assert found.metric == pytest.approx(-(1 - share) * of_rgb - share * of_depth)
    assert list(found.pictures) == ["clip_000", "clip_001"]


class Damaged:
    """A split of which some records cannot be read."""

    def __init__(self, count: int, bad: set[int]) -> None:
        self.count, self.bad = count, bad

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Record:
        if index in self.bad:
            raise StoreError(f"record {index} is damaged")
        return {name: np.full(2, index) for name in TOKEN_ARRAYS}


def plain(record: Record, rng: np.random.Generator) -> Arrays:
    return record


@given(st.integers(1, 9).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.integers(0, n - 1)))), st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_every_readable_clip_counts_once_and_under_its_own_number(split: tuple[int, set[int]], size: int) -> None:
    count, bad = split
    made = list(token_batches(Damaged(count, bad), plain, size))
    assert {batch.index.shape for batch in made} <= {(size,)}
    counted = [(int(i), int(x[0])) for b in made for i, x, w in zip(b.index, b.rgb, b.weight, strict=True) if w]
    assert counted == [(i, i) for i in range(count) if i not in bad]


def test_a_damaged_record_is_told_and_a_split_without_any_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    assert [number for number, _ in readable(Damaged(3, {1}), tell=told.append)] == [0, 2]
    assert told == ["record 1 is damaged; it is left out here"]
    none: Any = WorldModelObjective.create(config())
    with pytest.raises(ValueError, match="no held-out clips"):
        held_out_loss(none, {}, token_batches(Damaged(2, {0, 1}), plain, 2))
