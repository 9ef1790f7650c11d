"""Generates and scores clips on four devices; :mod:`tests.training.four_devices` runs this."""

import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from rsjax.clip import Video
from rsjax.data.clips import Clips
from rsjax.data.normalization import Normalization
from rsjax.devices import replicate
from rsjax.evaluation.generation import teacher_forced
from rsjax.models.base import Assets
from rsjax.models.ivideogpt import autoencoder, rollout
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.models.roboscape import teacher_forcing as teacher
from tests.models.ivideogpt.toy import CLIPS, MODEL, frames, llama_params, vq_params
from tests.tools.pipeline import toy

IN_ROWS: dict[str, list[bool]] = {}


def watch(module: ModuleType, name: str) -> None:
    """Notes of every result of this function whether each device has only its rows."""
    plain, seen = getattr(module, name), IN_ROWS.setdefault(f"{module.__name__}.{name}", [])

    def watched(*inputs: Any) -> Any:
        out = plain(*inputs)
        seen.append(not jax.tree.leaves(out)[0].sharding.is_fully_replicated)
        return out

    setattr(module, name, watched)


def ivideogpt() -> None:
    model = IVideoGPT(MODEL, CLIPS)
    assets = Assets(Normalization((0.0,) * 3, (1.0,) * 3, None), replicate(vq_params()))
    params = replicate(llama_params(model.architecture))
    model.generate(params, assets, Video(frames(4, 1)), np.zeros((4, 3, 3), np.float32))


def teacher_forcing() -> None:
    """Scores five clips, in batches of one that are rounded up to four."""
    with tempfile.TemporaryDirectory() as folder:
        store = toy.store(Path(folder) / "clips")
        trained, source = toy.trained(store), store.source("test")
        clips = Clips.stacked([source[i] for i in range(5)], range(5))
    config = replace(trained.config, eval=replace(trained.config.eval, batch_size=1))
    some = clips.first(3)
    model = replace(trained, config=config, params=replicate(trained.params))
    taught = teacher_forced(model, config.prompt_frames, some.video, some.actions)
    assert taught is not None
    assert taught.accuracy["rgb"].shape == (5, 2)


def in_rows() -> dict[str, list[bool]]:
    """By program, whether each of its results lies in rows on the devices."""
    for module, name in ((rollout, "sample"), (autoencoder, "_apply"), (teacher, "_score_window")):
        watch(module, name)
    ivideogpt()
    teacher_forcing()
    return IN_ROWS
