"""From damaged clips to a curriculum of tokens, with the tokenizer left untrained."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import LoopConfig
from rsjax.config.stages import parse_stage
from rsjax.data.quarantine import read_quarantine
from rsjax.data.store import Store, StoreError, encode_clip, open_store, write_store
from rsjax.pipeline import jobs, stages
from rsjax.pipeline.feeding import fingerprint, planned, token_transform
from rsjax.pipeline.run import Run
from rsjax.pipeline.tokens import tokenize_store
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training.checkpoint import save_weights
from tests.pipeline import toy


def damage(store: Store, split: str, index: int) -> None:
    """Changes a byte in which no other record has a part."""
    shard = store.path / f"{split}-00000.array_record"
    sound, count = shard.read_bytes(), len(store.source(split))
    for share in np.linspace(0.2, 0.8, 7):
        payload = bytearray(sound)
        payload[int(len(sound) * (index + share) / count)] ^= 255
        shard.write_bytes(bytes(payload))
        if [number for number in range(count) if not can_read(store, split, number)] == [index]:
            return
    raise AssertionError("no byte found")


def can_read(store: Store, split: str, index: int) -> bool:
    try:
        return bool(store.source(split)[index])
    except StoreError:
        return False


def test_tokens_are_labelled_as_their_clips_and_lack_the_damaged_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(toy.config(), tmp_path / "run", tmp_path / "data")
    clips = toy.store(run.clips)
    damage(clips, "train", 1)
    params = jax.jit(Tokenizer(run.config.tokenizer).init_params)(jax.random.key(0))
    (run.directory / "tokenizer").mkdir(parents=True)
    save_weights(run.directory / "tokenizer" / "weights", params)
    stages.tokenize(run)
    tokens = run.open_tokens()
    assert tokens.path.parent == clips.path.resolve() / "tokens"
    assert tokens.manifest["tokenizer"] == fingerprint(params)
    source = tokens.source("train")
    assert [source[i]["provenance"]["episode"] for i in range(len(source))] == [0, 2]
    assert tokens.labels("train").counts() == {"task": {"drift": 2}, "difficulty": {"unknown": 2}}
    (line,) = (run.directory / "tokens" / "quarantine.jsonl").read_text().splitlines()
    assert '"record": 1' in line
    with pytest.raises(StoreError, match="task 'drift' 2×; difficulty 'unknown' 2×"):
        planned(loop("simple:2"), tokens, partial(token_transform, tokens, False), tmp_path)
    planned(loop("unknown/dri*:3"), tokens, partial(token_transform, tokens, False), tmp_path)
    assert "note: stage unknown/dri*:3: 2 clips, steps 1 to 3" in capsys.readouterr().out


def loop(*words: str) -> LoopConfig:
    return LoopConfig(batch_size=2, stages=tuple(map(parse_stage, words)))


def test_a_clip_that_scores_need_is_not_left_out(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    damage(clips, "test", 2)
    params = jax.jit(Tokenizer(toy.config().tokenizer).init_params)(jax.random.key(0))
    with pytest.raises(StoreError, match="number 2 of the split"):
        tokenize_store(clips, toy.config(), params, tmp_path)
    assert not (tmp_path / "quarantine.jsonl").exists()


def test_every_run_lists_the_clips_that_lack_tokens_until_they_are_mended(tmp_path: Path) -> None:
    clips, config = toy.store(tmp_path / "clips"), toy.config()
    sound = (clips.path / "train-00000.array_record").read_bytes()
    params = jax.jit(Tokenizer(config.tokenizer).init_params)(jax.random.key(0))
    damage(clips, "train", 1)
    first = tokenize_store(clips, config, params, tmp_path / "a")
    made = (first / "manifest.json").stat().st_mtime_ns
    assert tokenize_store(clips, config, params, tmp_path / "b") == first
    assert (first / "manifest.json").stat().st_mtime_ns == made, "they were there"
    rows = [[row["record"] for row in read_quarantine(tmp_path / run / "quarantine.jsonl")] for run in "ab"]
    assert rows == [[1], [1]]
    strict = replace(config, train=replace(config.train, max_damaged=0.0))
    with pytest.raises(StoreError, match="max_damaged"):
        tokenize_store(clips, strict, params, tmp_path / "c")
    (clips.path / "train-00000.array_record").write_bytes(sound)
    again = open_store(tokenize_store(clips, config, params, tmp_path / "b"))
    assert len(again.source("train")) == toy.TRAIN and not (tmp_path / "b" / "quarantine.jsonl").exists()


def test_weights_that_differ_anywhere_have_another_fingerprint() -> None:
    params = {"a": np.zeros(3, np.float32), "b": {"c": np.ones((2, 2), np.float32)}}
    other = jax.tree.map(np.copy, params)
    assert fingerprint(params) == fingerprint(other)
    other["b"]["c"][1, 1] += 1e-6  # type: ignore[index, call-overload]
    assert fingerprint(params) != fingerprint(other)


@pytest.mark.parametrize(
    ("changes", "told"),
    [({}, 0), ({"action_mean": [1.0]}, 0), ({"depth_range": [0, 9]}, 1), ({"depth_range": None}, 0)],
)
def test_another_stores_tokens_come_in_this_stores_units(
    changes: dict[str, Any], told: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meta = {"action_mean": [0.5], "action_std": [2.0], "depth_range": [0.5, 2.0]}
    grid, actions = np.zeros((3, 2, 2), np.int32), np.array([[0], [1], [3]], np.float32)
    record = {"rgb": grid, "depth": grid, "actions": actions, "tracks": grid, "visible": grid}
    for name, more in (("own", {}), ("other", changes)):
        write_store(tmp_path / name, "tokens", {"train": [record]}, meta | more)
    own, other = (open_store(tmp_path / name) for name in ("own", "other"))
    made = token_transform(own, False, other)(other.source("train")[0], np.random.default_rng(0))
    np.testing.assert_allclose(made["actions"], np.array([[0], [0.25], [1.25]]))
    assert capsys.readouterr().out.count("its depth tokens stand for") == told


def test_a_mistyped_stage_is_told_before_the_tokenizer_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cfg = toy.config()
    cfg = replace(cfg, train=replace(cfg.train, stages=loop("hard:1").stages))
    run = Run(cfg, tmp_path / "run", tmp_path / "data")
    write_store(
        run.clips, "clips", {"train": [encode_clip(toy.clip(0))]}, {}, lambda clip: {"task": "", "difficulty": "simple"}
    )
    monkeypatch.setattr(jobs, "fit", lambda *_, **__: pytest.fail("it was trained"))
    with pytest.raises(StoreError, match="no train record has a difficulty like hard"):
        stages.train_tokenizer(run, resume=True)
