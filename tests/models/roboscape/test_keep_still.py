"""What stands still comes from the prompt: the equation pixel by pixel, and the same frames however they are made."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import KeepStillConfig, SampleConfig, TokenModelConfig
from rsjax.data.store import Store
from rsjax.models.base import create_model
from rsjax.models.branch_states import Decoding
from rsjax.models.trained import TrainedModel
from tests.tools.pipeline import toy

SETTINGS = KeepStillConfig(noise=25.0, blur=0.2)
FRAMES = 4


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("still") / "clips")


@pytest.fixture(scope="module")
def off(clips: Store) -> TrainedModel:
    return toy.trained(clips, toy.with_model(toy.config(), sample=SampleConfig(steps=1)))


@pytest.fixture(scope="module")
def on(off: TrainedModel) -> TrainedModel:
    model = off.config.model
    assert isinstance(model, TokenModelConfig)
    config = toy.with_model(off.config, sample=replace(model.sample, keep_still=SETTINGS))
    return TrainedModel(config, create_model(config), off.params, off.assets)


def actions(number: int) -> np.ndarray:
    return np.random.default_rng(number).uniform(-1, 1, (FRAMES, 28)).astype(np.float32)


def expected(recorded: np.ndarray, decoded: np.ndarray, side: int) -> np.ndarray:
    """The equation in loops, on a clip's decoded frames (T, H, W, 3); ``decoded[0]`` is the prompt's."""
    out = np.zeros_like(decoded)
    for time, frame in enumerate(decoded):
        change = np.abs(frame.astype(float) - decoded[0]).mean(-1)
        change = cv2.GaussianBlur(change, (0, 0), SETTINGS.blur * side)
        for row, column in np.ndindex(change.shape):
            c = change[row, column]
            w = c**2 / (c**2 + SETTINGS.noise**2)
            old = recorded[row, column].astype(float)
            out[time, row, column] = np.round(old + w * (frame[row, column] - old))
    return out


def test_frames_follow_the_equation_and_the_prompt_is_itself(off: TrainedModel, on: TrainedModel, clips: Store) -> None:
    clip = clips.source("test")[0]
    inputs = (clip["rgb"][:1], actions(0), clip["depth"][:1])
    decoded = off.generate(*inputs)
    made = on.generate(*inputs)
    np.testing.assert_array_equal(made.rgb[0], clip["rgb"][0])
    assert (decoded.rgb[0] != clip["rgb"][0]).any()
    loops = expected(clip["rgb"][0], decoded.rgb, off.config.tokenizer.downsampling)
    assert np.abs(made.rgb.astype(int) - loops).max() <= 1  # float32 rounds some halves the other way
    assert (made.rgb != loops).mean() < 1e-3
    assert made.depth is not None and decoded.depth is not None
    np.testing.assert_array_equal(made.depth, decoded.depth)


def test_generating_planning_stepping_and_playing_show_the_same_frames(on: TrainedModel, clips: Store) -> None:
    source = clips.source("test")
    rows = [actions(1), actions(2)]
    prompts = [Video(source[number]["rgb"][None, :1], source[number]["depth"][None, :1]) for number in (1, 2)]
    made = [
        on.generate(prompt.rgb[0], row, prompt.depth[0]).rgb  # type: ignore[index]
        for prompt, row in zip(prompts, rows, strict=True)
    ]
    planned = on.model.plan(on.params, on.assets, prompts[0], np.stack(rows), last=2)
    np.testing.assert_array_equal(planned.rgb[0], made[0][-2:])

    stepping = on.model.imagine(on.params, on.assets, 2)
    both = Video(*(np.concatenate([getattr(each, name) for each in prompts]) for name in ("rgb", "depth")))
    first = stepping.restart(np.ones(2, bool), both, np.zeros(2, int))
    frames = [first, *(stepping.step(np.stack([row[time] for row in rows])) for time in range(1, FRAMES))]
    stepped = np.concatenate([frame.rgb for frame in frames], axis=1).astype(int)
    assert np.abs(stepped - np.stack(made)).max() <= 1  # decoded in other numbers

    lanes = on.model.branching(on.params, on.assets, True, lanes=2)
    state = lanes.begin(prompts[0])
    np.testing.assert_array_equal(state.rgb, prompts[0].rgb[0, 0])
    for time in range(1, FRAMES):
        [state] = lanes.advance([state], rows[0][time : time + 1], [Decoding(steps=1)])
        assert np.abs(state.rgb.astype(int) - made[0][time]).max() <= 1
