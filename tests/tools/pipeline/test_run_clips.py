"""Training on a store that was not simulated: clips without depth, of another length and width of actions."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rsjax.config import ConfigError, RoboScapeConfig, presets
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store, StoreError, encode_clip, open_store, write_store
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.metrics.depth import depth_scores
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.tokenizers.tokenize import tokenize_store
from rsjax.tools.commands import train
from rsjax.tools.commands.cli import parse
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store, relocated
from rsjax.tools.pipeline.stages import prepare
from rsjax.tools.pipeline.validation import record_batches
from tests.bridge import BRIDGE, needs_bridge
from tests.tools.pipeline import toy
from tests.tools.pipeline.conftest import printed_by
from tests.tools.pipeline.damage import damage


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    return toy.store(tmp_path / "clips").path


def test_what_has_to_fit_the_clips_follows_from_them(clips: Path) -> None:
    debug, sim = presets.debug(), toy.config().sim
    made = on_store(debug, clips)
    assert made.clips == dataclasses.replace(sim.clips, test_clips=toy.TEST)
    assert Architecture.create(made).action_inputs == sim.action_dim
    tiny = on_store(presets.get("tiny"), clips)
    assert Architecture.create(tiny).action_inputs == 2 * sim.action_dim, "their sums come with the actions"
    assert Architecture.create(tiny).frames == 6, "positions for the clips' frames, of which the preset's have more"
    roomy = on_store(toy.with_model(presets.get("tiny"), max_frames=16), clips)
    assert Architecture.create(roomy).frames == 16, "fewer frames leave positions over"
    large = on_store(presets.get("roboscape_s"), clips)
    assert (large.clips.image_size, large.grid) == (64, 4)
    few = dataclasses.replace(debug, sim=dataclasses.replace(debug.sim, frames=4))
    assert Architecture.create(on_store(few, clips)).frames == 6


def test_fields_on_the_command_line_are_checked_against_the_store(clips: Path) -> None:
    argv = ["debug", "--store", str(clips), "--model.max-frames", "7", "--model.loss.num-keypoints", "3"]
    config, _ = parse(argv, "train", "", train.Options())
    assert isinstance(config.model, RoboScapeConfig)
    assert config.data is not None
    assert (config.model.max_frames, config.model.loss.num_keypoints, config.data.key) == (7, 3, "toy")
    assert config.data.store == str(clips.absolute())
    with pytest.raises(ConfigError, match="clips have 6 frames but model.max_frames is 5"):
        parse(["debug", f"--store={clips}", "--model.max-frames", "5"], "train", "", train.Options())


def test_a_store_that_cannot_be_trained_on_is_refused(tmp_path: Path) -> None:
    debug = presets.debug()
    write_store(tmp_path / "few", "clips", {"train": [encode_clip(toy.clip(0))], "test": []}, {"key": "few"})
    with pytest.raises(StoreError, match="1 train and 0 test clips.*--test-share"):
        on_store(debug, tmp_path / "few")
    write_store(tmp_path / "tokens", "tokens", {"train": [{"x": 1}]}, {"key": "t"})
    with pytest.raises(StoreError, match="is of tokens"):
        on_store(debug, tmp_path / "tokens")


@pytest.mark.parametrize(
    "changes",
    [{"action_mean": [0.0] * 3}, {"action_std": ["a"] * 28}, {"depth_range": "abc"}, {"depth_range": [2.0, 1.0]}],
)
def test_statistics_that_are_none_are_refused(clips: Path, changes: dict[str, Any]) -> None:
    place = clips / "manifest.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | changes))
    with pytest.raises(StoreError, match=r"manifest.json: .*(action|depth).*make (it|the store) again"):
        Normalization.create(open_store(clips))


def test_tokens_of_other_clips_do_not_count_as_this_runs(tmp_path: Path) -> None:
    """The store is moved, and another one with tokens of the same tokenizer is put in its place."""
    own, other = (toy.store(tmp_path / name) for name in ("own", "other"))
    place = other.path / "manifest.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {"key": "other"}))
    config = on_store(toy.config(), own.path)
    run = Run(config, tmp_path / "run", tmp_path)
    toy.save_tokenizer(run)
    with run.stage("tokens"):
        prepare(run)
    assert run.finished("tokens")
    own.path.rename(tmp_path / "moved")
    other.path.rename(own.path)
    tokenized(open_store(own.path), tmp_path)
    there = Run(relocated(config, tmp_path / "moved"), run.directory, tmp_path)
    assert not there.finished("tokens")
    with pytest.raises(StoreError, match="holds tokens of other clips"):
        there.open_prepared()
    prepare(there)
    assert there.finished("tokens")
    assert there.open_prepared().path.parents[1] == tmp_path / "moved"


def test_a_moved_store_is_the_same_and_another_one_in_its_place_is_not(clips: Path, tmp_path: Path) -> None:
    config = on_store(presets.debug(), clips)
    keys = Run(config, tmp_path / "run", tmp_path).keys()
    clips.rename(tmp_path / "moved")
    with pytest.raises(StoreError, match="the store is missing; if it was moved, name its new path with --store"):
        Run(config, tmp_path / "run", tmp_path).open_clips()
    there = relocated(config, tmp_path / "moved")
    assert Run(there, tmp_path / "run", tmp_path).keys() == keys
    assert Run(there, tmp_path / "run", tmp_path).open_clips().path == tmp_path / "moved"
    records = {"train": [encode_clip(toy.clip(0))], "test": [encode_clip(toy.clip(1))]}
    write_store(clips, "clips", records, {"key": "another"})
    with pytest.raises(StoreError, match=r"is not the store that the run began with \(key another, not toy\)"):
        Run(config, tmp_path / "run", tmp_path).open_clips()
    with pytest.raises(StoreError, match="this run's clips were simulated"):
        relocated(presets.debug(), clips)


BLIND = {"train": (0,), "test": (1, 3)}  # clips without depth


def partly_blind(path: Path) -> Store:
    """The toy's clips, some without depth."""
    whole = toy.store(path.with_name("whole"))
    splits = {}
    for split, blind in BLIND.items():
        source = whole.source(split)
        splits[split] = [source[i] | ({"depth": None} if i in blind else {}) for i in range(len(source))]
    meta = {name: value for name, value in whole.manifest.items() if name not in ("splits", "format", "kind")}
    write_store(path, "clips", splits, meta)
    return open_store(path)


def test_depth_is_scored_where_clips_have_it_and_nothing_else_changes(tmp_path: Path) -> None:
    """In the store that has depth, a train clip is damaged, which does not keep a run from its scores."""
    some = partly_blind(tmp_path / "some")
    all_ = open_store(tmp_path / "whole")
    damage(all_, "train", 0)
    data = on_store(presets.debug(), all_.path).data
    assert data is not None and data.key == "toy"
    trained = toy.trained(all_)
    found, whole = evaluation.evaluate(trained, some), evaluation.evaluate(trained, all_)
    seen = [i for i in range(toy.TEST) if i not in BLIND["test"]]
    one_by_one = []
    for i in seen:
        clip = all_.source("test")[i]
        made = trained.generate(clip["rgb"][:1], clip["actions"], clip["depth"][:1])
        assert made.depth is not None
        one_by_one.append(
            float(depth_scores(clip["depth"][None, 1:], made.depth[None, 1:], alignment="none").abs_rel.mean())
        )
    assert found.metrics["depth_absrel"] == pytest.approx(np.mean(one_by_one), rel=1e-4)
    assert found.metrics["psnr_tokenizer"] == whole.metrics["psnr_tokenizer"]
    assert np.isfinite(whole.metrics["delta_psnr_uniform"])
    shown = {int(clip): bool(has) for clip, has in zip(found.shown["clip"], found.shown["has_depth"], strict=True)}
    assert shown == {clip: clip in seen for clip in shown}


def test_a_store_without_any_depth_has_no_scores_of_it(tmp_path: Path) -> None:
    blind = toy.store(tmp_path / "blind", depth=False)
    found = evaluation.evaluate(toy.trained(blind), blind)
    assert not [name for name in found.metrics if "depth" in name]
    reasons = {reason for name, reason in found.reasons.items() if name.startswith("depth") and "estimator" not in name}
    assert reasons == {"no test clip has depth in metres"}
    assert "predicted_depth" not in found.shown
    assert np.isfinite(found.metrics["psnr"])


def test_tokens_of_clips_without_depth_train_with_that_term_masked(tmp_path: Path) -> None:
    clips = partly_blind(tmp_path / "some")
    config = on_store(toy.config(), clips.path)
    model, normalization = create_model(config), Normalization.create(clips)
    tokens = tokenized(clips, tmp_path / "run")
    assert tokens.path.parent == (clips.path / "tokens")
    assert tokenized(clips, tmp_path / "run").path == tokens.path, "they are there already"
    for split, blind in BLIND.items():
        source = tokens.source(split)
        (batch,) = record_batches(model, normalization, source, len(source), range(len(source)))
        assert np.flatnonzero(np.asarray(batch.has_depth) == 0).tolist() == list(blind)


def tokenized(clips: Store, place: Path) -> Store:
    return tokenize_store(clips, toy.codec(clips), toy.config().clips.image_size, place, 0.01)


@needs_bridge
def test_real_episodes_from_recording_to_video(tmp_path: Path) -> None:
    """The README's commands, shortened: ingest, train ``debug`` instead of ``tiny``, generate."""
    store, run = tmp_path / "bridge", tmp_path / "run"
    printed_by("experiments.ingest", "rlds", BRIDGE, "--out", store, "--windows.rate", 0, "--windows.frames", 8)
    few = ["--tokenizer-train.steps", 2, "--train.steps", 2, "--model.sample.steps", 2]
    few += ["--eval.clips", 2, "--eval.batch-size", 2, "--eval.action-draws", 1]
    told = printed_by("experiments.train", "debug", "--store", store, "--run-dir", run, *few)
    assert "no clip has depth, so depth trains with its loss masked" in told
    log = [json.loads(line) for line in (run / "world_model" / "log.jsonl").read_text().splitlines()]
    trained = [row for row in log if "loss" in row]
    assert trained and all(row["depth"] == 0 and np.isfinite(row["loss"]) for row in trained)
    scores = json.loads((run / "metrics.json").read_text())
    assert np.isfinite(scores["psnr"])
    assert {scores[name] for name in scores if name.startswith("depth")} == {None}
    page = (run / "report.html").read_text()
    assert open_store(store).source("test")[0]["task"] in page
    tokens = run / "tokens" / "store"
    assert tokens.resolve().parent == store / "tokens"
    assert len(open_store(tokens).source("train")) == len(open_store(store).source("train"))

    store.rename(tmp_path / "moved")
    moved = ("--store", tmp_path / "moved")
    told = printed_by("experiments.generate", run, *moved, "--clips", 1, "--out", tmp_path / "out")
    (video,) = (tmp_path / "out").glob("*.mp4")
    assert str(video) in told
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) == 8
