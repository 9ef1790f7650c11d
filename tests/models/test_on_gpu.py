"""Compares programs on a GPU with the same on the CPU; skipped where there is no GPU."""

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

import rsjax
from rsjax.config import presets
from rsjax.config.config_fields import with_values
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.models.base import create_model
from rsjax.tools.bench import inputs
from rsjax.training.state import create_state
from rsjax.training.step import train_step

pytestmark = pytest.mark.skipif(jax.default_backend() != "gpu", reason="there is no GPU here")

CLIPS = 2
STEPS = 2


@pytest.mark.parametrize(
    ("preset", "blocks"),
    [("roboscape_tiny", 2), ("roboscape_s", 2), ("genie_35m", 2), ("tiny", 4), ("roboscape_l", 1)],
)
def test_a_training_takes_the_same_course(preset: str, blocks: int) -> None:
    config = with_values(presets.get(preset), {"model.blocks": blocks})
    loop = dataclasses.replace(config.loop("world_model"), batch_size=CLIPS, sharding="jit")
    model = create_model(config)
    gpu = jax.devices("gpu")[0]
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu):
        start = jax.device_get((create_state(model, loop), inputs.batch(model, config, CLIPS)))

    def metrics(device: Any) -> list[dict[str, float]]:
        state, batch = jax.device_put(start, device)
        step = jax.jit(partial(train_step, model, loop))
        found = []
        for _ in range(STEPS):
            state, numbers = step(state, batch)
            found.append({name: float(np.mean(value)) for name, value in numbers.items()})
        return found

    for ours, theirs in zip(metrics(gpu), metrics(cpu), strict=True):
        assert ours["loss"] == pytest.approx(theirs["loss"], rel=5e-3)
        assert ours["grad_norm"] == pytest.approx(theirs["grad_norm"], rel=5e-2)


def test_a_generated_video_is_as_good() -> None:
    clips = [rsjax.examples("tiny")[number] for number in range(8)]
    frames, actions, depth = (np.stack([clip[name] for clip in clips]) for name in ("rgb", "actions", "depth"))
    found = {}
    for kind in ("gpu", "cpu"):
        with jax.default_device(jax.devices(kind)[0]):
            video = rsjax.load("tiny").generate(frames[:, :1], actions, depth[:, :1])
        found[kind] = float(np.mean(psnr(frames[:, 1:], video.rgb[:, 1:])))
    assert found["gpu"] == pytest.approx(found["cpu"], abs=0.3)
