"""What stands still comes from the prompt: the equation pixel by pixel."""

from pathlib import Path

import cv2
import numpy as np

from rsjax.config import KeepStillConfig, SampleConfig
from tests.tools.pipeline import toy

SETTINGS = KeepStillConfig(noise=25.0, blur=0.2)


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


def test_frames_follow_the_equation_and_the_prompt_is_itself(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    off = toy.trained(clips, toy.with_model(toy.config(), sample=SampleConfig(steps=1)))
    on = toy.trained(clips, toy.with_model(toy.config(), sample=SampleConfig(steps=1, keep_still=SETTINGS)))
    clip = clips.source("test")[0]
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 28)).astype(np.float32)
    inputs = (clip["rgb"][:1], actions, clip["depth"][:1])
    decoded = off.generate(*inputs)
    made = on.generate(*inputs)
    np.testing.assert_array_equal(made.rgb[0], clip["rgb"][0])
    assert (decoded.rgb[0] != clip["rgb"][0]).any()
    loops = expected(clip["rgb"][0], decoded.rgb, off.config.tokenizer.downsampling)
    assert np.abs(made.rgb.astype(int) - loops).max() <= 1  # float32 rounds some halves the other way
    assert (made.rgb != loops).mean() < 1e-3
    assert made.depth is not None and decoded.depth is not None
    np.testing.assert_array_equal(made.depth, decoded.depth)
