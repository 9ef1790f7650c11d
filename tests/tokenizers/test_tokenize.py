"""The tokens of a store of clips, of which some are damaged."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from rsjax.config import TokenizerConfig
from rsjax.data.normalization import Normalization
from rsjax.data.quarantine import read_quarantine
from rsjax.data.shift import moved
from rsjax.data.store import Store, StoreError, encode_clip, open_store, write_store
from rsjax.data.token_sets import tokenizer_key
from rsjax.tokenizers.tokenize import fingerprint, tokenize_store
from rsjax.tools.commands import store as command
from rsjax.tools.pipeline.run import Run
from tests.tools.pipeline import toy
from tests.tools.pipeline.damage import damage


def tokenized(clips: Store, place: Path, max_damaged: float = 0.01) -> Store:
    return tokenize_store(clips, toy.codec(clips), toy.config().clips.image_size, place, max_damaged)


def test_a_damaged_test_clip_is_an_error(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    damage(clips, "test", 2)
    with pytest.raises(StoreError, match="number 2 of the split"):
        tokenized(clips, tmp_path)
    assert not (tmp_path / "quarantine.jsonl").exists()


def test_a_damaged_validation_clip_is_listed(tmp_path: Path) -> None:
    meta = toy.store(tmp_path / "toy").manifest
    splits = {
        split: [encode_clip(toy.clip(number)) for number in range(3)] for split in ("train", "validation", "test")
    }
    names = ("key", "depth_range", "action_mean", "action_std")
    write_store(tmp_path / "clips", "clips", splits, {name: meta[name] for name in names})
    clips = open_store(tmp_path / "clips")
    damage(clips, "validation", 1)
    assert len(tokenized(clips, tmp_path).source("validation")) == 2
    (row,) = read_quarantine(tmp_path / "quarantine.jsonl")
    assert (row["split"], row["record"]) == ("validation", 1)


def test_every_run_lists_the_clips_that_lack_tokens_until_they_are_mended(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    sound = (clips.path / "train-00000.array_record").read_bytes()
    damage(clips, "train", 1)
    first = tokenized(clips, tmp_path / "a")
    made = (first.path / "manifest.json").stat().st_mtime_ns
    assert tokenized(clips, tmp_path / "b").path == first.path
    assert (first.path / "manifest.json").stat().st_mtime_ns == made, "they were there"
    rows = [[row["record"] for row in read_quarantine(tmp_path / run / "quarantine.jsonl")] for run in "ab"]
    assert rows == [[1], [1]]
    with pytest.raises(StoreError, match="max_damaged"):
        tokenized(clips, tmp_path / "c", max_damaged=0.0)
    (clips.path / "train-00000.array_record").write_bytes(sound)
    again = tokenized(clips, tmp_path / "b")
    assert len(again.source("train")) == toy.TRAIN and not (tmp_path / "b" / "quarantine.jsonl").exists()


def test_weights_that_differ_anywhere_have_another_fingerprint() -> None:
    params = {"a": np.zeros(3, np.float32), "b": {"c": np.ones((2, 2), np.float32)}}
    other = jax.tree.map(np.copy, params)
    assert fingerprint(params) == fingerprint(other)
    other["b"]["c"][1, 1] += 1e-6  # type: ignore[index, call-overload]
    assert fingerprint(params) != fingerprint(other)


def test_tokens_that_are_computed_in_another_type_have_a_set_of_their_own() -> None:
    keys = {tokenizer_key(TokenizerConfig(compute_dtype=dtype), "weights") for dtype in ("float32", "bfloat16")}
    assert len(keys) == 2


def test_training_clips_have_tokens_of_moved_copies_in_a_set_of_their_own(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    codec, size = toy.codec(clips), toy.config().clips.image_size
    plain = tokenized(clips, tmp_path)
    moved_too = tokenize_store(clips, codec, size, tmp_path, 0.01, (2, 3))
    assert moved_too.path != plain.path
    assert "shifts" not in moved_too.source("test")[0]
    record, clip = moved_too.source("train")[1], clips.source("train")[1]
    np.testing.assert_array_equal(record["rgb"], plain.source("train")[1]["rgb"])
    moves = np.round(record["shifts"] * size).astype(int)
    assert moves.shape == (2, 2) and moves.any(axis=1).all()
    assert (moved_too.source("train")[0]["shifts"] != record["shifts"]).any(), "each clip has its own"
    for number, move in enumerate(moves):
        assert abs(move).max() <= 3
        np.testing.assert_array_equal(record["rgb_shifted"][number], codec.encode_rgb(moved(clip["rgb"], *move)))
        np.testing.assert_array_equal(record["depth_shifted"][number], codec.encode_depth(moved(clip["depth"], *move)))


def test_the_command_makes_the_tokens_that_training_on_the_store_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the depth range of these clips, not in that of the run's own."""
    clips, run = toy.store(tmp_path / "clips"), Run(toy.config(), tmp_path / "run", tmp_path)
    toy.save_tokenizer(run)
    run.prepare(overwrite=False)
    (run.directory / "tokens").mkdir()
    replace(Normalization.create(clips), depth_range=(5.0, 9.0)).save(run.directory / "tokens")
    monkeypatch.setattr(command, "tune_process", lambda: None)
    (made,) = command.tokenize(command.Tokenize(clips.path, run.directory))
    depth = toy.codec(clips).encode_depth(clips.source("test")[0]["depth"])
    np.testing.assert_array_equal(made.source("test")[0]["depth"], depth)
