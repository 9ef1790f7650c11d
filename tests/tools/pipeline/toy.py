"""A run small enough to make in no time, on clips that no simulator made: coloured noise that drifts."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.clip import Clip
from rsjax.config import Config, EvalConfig, SampleConfig, presets
from rsjax.data.labels import Label
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.models.base import Assets, create_model
from rsjax.models.trained import TrainedModel
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.pipeline.run import Run
from rsjax.trainable import Params
from rsjax.training.checkpoint import save_weights

TRAIN, TEST = 3, 5
SUCCESS = (False, False, True, False, True)  # of the test clips, at their end
DEPTH_RANGE = (0.5, 2.0)


def config() -> Config:
    """``debug``, decoded in a way that does not depend on a clip's place in its batch."""
    debug = presets.debug()
    return replace(
        with_model(debug, sample=SampleConfig(steps=2, unmask="greedy")),
        sim=replace(debug.sim, episodes=TRAIN + TEST, test_episodes=TEST),
        eval=EvalConfig(clips=TEST, batch_size=2, action_draws=2, weights=""),
    )


def with_model(config: Config, **changes: Any) -> Config:
    """The configuration with fields of its model changed."""
    return replace(config, model=replace(config.model, **changes))


def clip(number: int, success: bool = False) -> Clip:
    cfg, rng = config().sim, np.random.default_rng(number)
    size, frames = cfg.image_size, cfg.frames
    base = rng.integers(0, 256, (size // 8, size // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    actions = rng.normal(0.1, 0.5, (frames, cfg.action_dim)).astype(np.float32)
    actions[0] = 0.0
    return Clip(
        rgb=np.stack([np.roll(base, 2 * t, axis=1) for t in range(frames)]),
        depth=rng.uniform(*DEPTH_RANGE, (frames, size, size)).astype(np.float32),
        actions=actions,
        tracks=rng.random((cfg.tracks, frames, 2)).astype(np.float32),
        visible=np.ones((cfg.tracks, frames), bool),
        success=np.arange(frames) >= (frames - 1 if success else frames),
        task="drift",
        provenance={"episode": number, "depth_range": list(DEPTH_RANGE)},
    )


def store(path: Path, depth: bool = True, label: Label | None = None) -> Store:
    """A store of clips."""
    train, test = [clip(i) for i in range(TRAIN)], [clip(TRAIN + i, SUCCESS[i]) for i in range(TEST)]
    actions = np.concatenate([c.actions[1:] for c in train])
    if not depth:
        train, test = ([replace(c, depth=None) for c in clips] for clips in (train, test))
    meta = {
        "key": "toy",
        "depth_range": list(DEPTH_RANGE) if depth else None,
        "action_mean": actions.mean(0).tolist(),
        "action_std": actions.std(0).tolist(),
        "success_share": 0.25,
    }
    write_store(path, "clips", {"train": map(encode_clip, train), "test": map(encode_clip, test)}, meta, label)
    return open_store(path)


def trained(clips: Store, cfg: Config | None = None) -> TrainedModel:
    """A model with random parameters; that of :func:`config` if not given."""
    cfg = cfg or config()
    return TrainedModel(cfg, create_model(cfg), world_model_params(cfg), assets(clips))


def assets(clips: Store) -> Assets:
    return Assets(Normalization.create(clips), tokenizer_params())


def codec(clips: Store) -> Codec:
    """That of :func:`trained`."""
    return Codec(config().tokenizer, tokenizer_params(), Normalization.create(clips))


@cache
def world_model_params(config: Config) -> Params:
    """Random parameters: fresh heads are so even that actions hardly change what is most probable."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(create_model(config).init, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)


@cache
def tokenizer_params() -> Params:
    """Those of an untrained tokenizer."""
    return jax.jit(Tokenizer(config().tokenizer).init_params)(jax.random.key(1))


def save_tokenizer(run: Run) -> None:
    """Puts the untrained tokenizer where the run's own would be."""
    run.output("tokenizer").parent.mkdir(parents=True)
    save_weights(run.output("tokenizer"), tokenizer_params())
