"""Generates and scores clips on several devices; :mod:`tests.models.test_divided` runs this.

Prints, by program, whether each of its results lies in rows on the devices.
"""

import json
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
    params, actions = replicate(llama_params(model.architecture)), np.zeros((2, 3, 3), np.float32)
    model.generate(params, assets, Video(frames(2, 1)), actions)


def teacher_forcing() -> None:
    """Scores three clips, in batches of one that are rounded up to two."""
    with tempfile.TemporaryDirectory() as folder:
        store = toy.store(Path(folder) / "clips")
        trained, source = toy.trained(store), store.source("test")
        clips = Clips.stacked([source[i] for i in range(3)], range(3))
    config = replace(trained.config, eval=replace(trained.config.eval, batch_size=1))
    some = clips.first(3)
    model = replace(trained, config=config, params=replicate(trained.params))
    taught = teacher_forced(model, config.prompt_frames, some.video, some.actions)
    assert taught is not None
    assert taught.accuracy["rgb"].shape == (3, 2)


if __name__ == "__main__":
    for module, name in ((rollout, "sample"), (autoencoder, "_apply"), (teacher, "_score_window")):
        watch(module, name)
    ivideogpt()
    teacher_forcing()
    print(json.dumps(IN_ROWS))
