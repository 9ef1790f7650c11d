"""Inputs made from shapes alone: speed does not depend on what clips show, so no data is needed.

Axes: B clips, T frames, H×W token cells, A action dimensions, N₀ tracks.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.clip import Batch
from rsjax.config import Config, ModelConfig
from rsjax.data.normalization import Normalization
from rsjax.data.order import Transform
from rsjax.data.store import Record
from rsjax.models.roboscape.world_model import WorldModel, branches
from rsjax.pipeline.transforms import token_batch, token_clip


def record(config: Config, rng: np.random.Generator) -> Record:
    """A token record as stage 3 writes it, with random contents."""
    frames, grid = config.clips.frames, config.model.grid
    tokens = rng.integers(0, 2**config.model.code_bits, (2, frames, grid, grid), np.int32)
    return {
        "rgb": tokens[0],
        "depth": tokens[1],
        "actions": rng.normal(size=(frames, config.clips.action_dim)).astype(np.float32),
        "tracks": rng.random((config.clips.tracks, frames, 2), np.float32),
        "visible": rng.random((config.clips.tracks, frames)) < 0.9,
        "task": "",
        "provenance": {},
    }


def batch(config: Config, size: int) -> Batch:
    """A batch of ``size`` clips, on the device."""
    rng = np.random.default_rng(0)
    rows = [transform(config)(record(config, rng), rng) for _ in range(size)]
    return jax.device_put(token_batch({name: np.stack([row[name] for row in rows]) for name in rows[0]}))


def transform(config: Config) -> Transform:
    """From token records to arrays, as training has it, with units that change nothing."""
    width = config.clips.action_dim
    return partial(
        token_clip, Normalization((0.0,) * width, (1.0,) * width, (0.1, 1.0)), config.model.integrate_actions
    )


def prompt(model: ModelConfig, size: int, frames: int) -> dict[str, Any]:
    """Tokens of ``frames`` given frames by branch, (B, T, H, W)."""
    keys = jax.random.split(jax.random.key(0), len(branches(model)))
    shape = (size, frames, model.grid, model.grid)
    drawn = (jax.random.randint(key, shape, 0, 2**model.code_bits, jnp.int32) for key in keys)
    return dict(zip(branches(model), drawn, strict=True))


def actions(model: ModelConfig, size: int, frames: int) -> Any:
    """Normalised actions, (B, T, A)."""
    return jax.random.normal(jax.random.key(1), (size, frames, model.action_dim))


def world_model_params(model: ModelConfig) -> Any:
    """Fresh parameters of the world model, made in one compiled call."""
    return jax.jit(WorldModel(model).init_params)(jax.random.key(0))
