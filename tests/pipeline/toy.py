"""A run small enough to make in no time, on clips that no simulator made: coloured noise that drifts."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from rsjax.clip import Clip
from rsjax.config import Config, EvalConfig, SampleConfig, presets
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.models.roboscape.world_model import WorldModel
from rsjax.pipeline.generator import Codec, Generator
from rsjax.tokenizers.magvit2 import Tokenizer

TRAIN, TEST = 3, 5
SUCCESS = (False, False, True, False, True)  # of the test clips, at their end
DEPTH_RANGE = (0.5, 2.0)


def config() -> Config:
    """``debug``, decoded in a way that does not depend on a clip's place in its batch."""
    debug = presets.debug()
    return replace(
        debug,
        sim=replace(debug.sim, episodes=TRAIN + TEST, test_episodes=TEST),
        sample=SampleConfig(steps=2, unmask="greedy"),
        eval=EvalConfig(clips=TEST, batch_size=2, action_draws=2, report_clips=3),
    )


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


def store(path: Path) -> Store:
    """A store of clips."""
    train, test = [clip(i) for i in range(TRAIN)], [clip(TRAIN + i, SUCCESS[i]) for i in range(TEST)]
    actions = np.concatenate([c.actions[1:] for c in train])
    meta = {
        "key": "toy",
        "depth_range": list(DEPTH_RANGE),
        "action_mean": actions.mean(0).tolist(),
        "action_std": actions.std(0).tolist(),
        "success_share": 0.25,
    }
    write_store(path, "clips", {"train": map(encode_clip, train), "test": map(encode_clip, test)}, meta)
    return open_store(path)


def generator(clips: Store) -> Generator:
    """An untrained one."""
    cfg = config()
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(WorldModel(cfg.model).init_params, jax.random.key(0))
    # Fresh heads are so even that actions hardly change what is most probable.
    params = jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)
    tokenizer = jax.jit(Tokenizer(cfg.tokenizer).init_params)(jax.random.key(1))
    return Generator(cfg, Codec(cfg, tokenizer, Normalization.create(clips)), params)
