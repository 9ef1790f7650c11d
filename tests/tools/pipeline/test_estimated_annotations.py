"""Copies of clips with estimated depth and tracks, and world models that train on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import ComponentConfig, CurriculumStageConfig
from rsjax.config.config_fields import with_values
from rsjax.data.loader import place_of
from rsjax.data.store import StoreError, encode_clip, write_store
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.depth_stage import check_depth
from rsjax.tools.pipeline.estimated_annotations import ERRORS, errors, estimated_clips
from rsjax.tools.pipeline.run import Run
from tests.tools.pipeline import toy
from tests.tools.pipeline.test_depth_stage import config

TRACKS = {"tracks", "visible"}
KINDS = {"estimated_tracks": TRACKS, "estimated_depth": {"depth"}, "estimated": TRACKS | {"depth"}}


def training_on(run: Run, annotations: str) -> Run:
    part = ComponentConfig(annotations=annotations)  # type: ignore[arg-type]
    train = replace(run.config.train, batch_size=2, curriculum=(CurriculumStageConfig((part,), 2.0),))
    return replace(run, config=replace(run.config, train=train))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("annotations")
    toy.store(folder / "clips")
    return Run(config(folder / "clips"), folder / "run", folder)


@pytest.mark.parametrize("annotations", KINDS)
def test_the_training_clips_have_these_estimates_and_nothing_else_changes(annotations: str, run: Run) -> None:
    own = run.open_clips()
    copy = estimated_clips(run, annotations)
    rows = []
    for split, changing in (("train", KINDS[annotations]), ("test", set[str]())):
        assert len(copy.source(split)) == len(own.source(split))
        for number in range(len(own.source(split))):
            clip, made = (store.source(split)[number] for store in (own, copy))
            assert {name for name in clip if not np.array_equal(clip[name], made[name])} == changing
            rows += [errors(clip, {name: made[name] for name in changing})] if changing else []
    means = copy.manifest[ERRORS]
    assert means == pytest.approx({name: np.mean([row[name] for row in rows]) for name in rows[0]})
    assert min(means.values()) > 0


def test_both_estimates_are_those_that_each_copy_has_alone(run: Run) -> None:
    both, depth, tracks = (
        estimated_clips(run, name).source("train")[0] for name in ("estimated", "estimated_depth", "estimated_tracks")
    )
    np.testing.assert_array_equal(both["depth"], depth["depth"])
    np.testing.assert_array_equal(both["tracks"], tracks["tracks"])
    np.testing.assert_array_equal(both["visible"], tracks["visible"])


def test_no_clips_own_depth_has_a_part_in_its_estimate(run: Run, tmp_path: Path) -> None:
    """A clip of another depth gets the same estimate, and changes that of clips in the other half."""
    clips = [toy.clip(number) for number in range(toy.TRAIN)]
    assert clips[0].depth is not None
    deeper = [replace(clips[0], depth=2 * clips[0].depth), *clips[1:]]
    splits = {"train": map(encode_clip, deeper), "test": map(encode_clip, clips)}
    meta = {name: run.open_clips().manifest[name] for name in ("key", "depth_range", "action_mean", "action_std")}
    write_store(tmp_path / "clips", "clips", splits, meta)
    other = Run(config(tmp_path / "clips"), tmp_path / "run", tmp_path)
    before, after = (estimated_clips(each, "estimated_depth").source("train") for each in (run, other))
    np.testing.assert_array_equal(before[0]["depth"], after[0]["depth"])
    assert np.any(before[2]["depth"] != after[2]["depth"])


def test_a_world_model_reads_the_estimates_in_training_alone(run: Run) -> None:
    toy.save_tokenizer(run)
    stages.prepare(run)
    loader = stages.world_model_loader(training_on(run, "estimated"))
    (part,) = loader.stages[0].components
    copy = estimated_clips(run, "estimated")
    assert place_of(part.source, 0)["store"].startswith(str(copy.path))
    tokens = part.source[0]
    np.testing.assert_array_equal(tokens["tracks"], copy.source("train")[0]["tracks"])
    expected = toy.codec(run.open_clips()).encode_depth(copy.source("train")[0]["depth"])
    np.testing.assert_array_equal(tokens["depth"], expected)
    own = run.open_prepared()
    np.testing.assert_array_equal(tokens["rgb"], own.source("train")[0]["rgb"])
    np.testing.assert_array_equal(own.source("train")[0]["tracks"], run.open_clips().source("train")[0]["tracks"])
    assert loader.loop.steps == toy.TRAIN


def test_depth_cannot_be_estimated_without_clips_to_learn_it_from(tmp_path: Path) -> None:
    toy.store(tmp_path / "clips", depth=False)
    without = with_values(config(tmp_path / "clips"), {"eval.depth_estimator": ""})
    run = Run(without, tmp_path / "run", tmp_path)
    for look in (lambda: check_depth(training_on(run, "estimated")), lambda: estimated_clips(run, "estimated_depth")):
        with pytest.raises(StoreError) as caught:
            look()
        assert "no depth in metres" in str(caught.value)
    check_depth(training_on(run, "estimated_tracks"))
