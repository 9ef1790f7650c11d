"""A model small enough to roll out in no time, with parameters that make its actions and its memory count."""

from collections import Counter
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.models.roboscape import sample
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer

DUAL = Architecture(frames=6, grid=3, code_bits=6, action_inputs=3, width=16, blocks=2, heads=2)
RGB = replace(DUAL, depth="none")
HEAD = replace(DUAL, depth="head")
SMALL = replace(DUAL, depth_width=8, depth_blocks=1, depth_cells=3)
BATCH, KEY = 2, jax.random.key(5)
NO_PARAMS: dict[str, Any] = {"blocks": {}}  # of a model that is taken out


def random_params(model: Architecture) -> Any:
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(Transformer(model).init_params, KEY)
    return jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)


def given(model: Architecture, prompt: int, frames: int = 6, batch: int = BATCH) -> tuple[dict[str, Any], np.ndarray]:
    """Prompt tokens and actions."""
    rng = np.random.default_rng(1)
    shape = (batch, prompt, model.grid, model.grid)
    tokens = {name: rng.integers(0, 2**model.code_bits, shape, np.int32) for name in model.modalities}
    actions = rng.normal(size=(batch, frames, model.action_inputs)).astype(np.float32)
    actions[:, 0] = 0.0
    return tokens, actions


def count_model(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Takes model and decoding out; counts the calls, and the frames of all clips, that would go to the model."""
    seen: Counter[str] = Counter()

    def apply(*inputs: Any, **_: Any) -> Any:
        tokens, mask, cache = inputs[3], inputs[4], inputs[7]
        seen.update(calls=1, frames=mask.shape[0] * mask.shape[1])
        return {name: jnp.zeros((*mask.shape, 2, 8)) for name in tokens}, cache, None

    monkeypatch.setattr(sample, "apply_network", apply)
    monkeypatch.setattr(sample, "unmask_step", lambda config, code_bits, keys, step, frame, *_, **__: frame)
    return seen
