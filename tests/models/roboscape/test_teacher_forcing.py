"""Teacher forcing with the cache against full passes of the network over each frame's window."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.base import TeacherForced
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import window_actions, window_start
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.models.roboscape.transformer import Transformer
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import BATCH, RGB, SMALL, given, random_params

SAMPLE = SampleConfig(steps=1, window_stride=2)
SUMS = depart(replace(RGB, action_inputs=4), integrate_actions=True, read_previous=True)
WHOLE = depart(SUMS, whole_frames=True)
ROTARY = depart(RGB, rotary=True, read_previous=True)
NONE, FIRST = np.zeros(BATCH, bool), np.arange(BATCH) == 0


def by_definition(model: Architecture, past: int, frames: int, no_depth: np.ndarray) -> TeacherForced:
    """Frame by frame: the network sees the true frames of the window, of which the last is masked."""
    params, (tokens, actions) = random_params(model), given(model, frames, frames)
    apply = jax.jit(Transformer(model).apply)
    length = frames if model.departures.rotary else model.frames
    nats, right = ({name: np.full((BATCH, frames), np.nan) for name in tokens} for _ in range(2))
    for t in range(past, frames):
        base = int(window_start(model, SAMPLE, t))
        room = [(0, 0), (0, length), (0, 0)]
        rows = np.pad(actions, room)[:, base : base + length]
        rows = window_actions(model, rows, rows[:, 0], 0)
        seen = {name: np.pad(grid, [*room, (0, 0)])[:, base : base + length] for name, grid in tokens.items()}
        mask = np.zeros((BATCH, length, 3, 3), bool)
        mask[:, t - base :] = True
        logits, _ = apply({"params": params}, seen, mask, rows, no_depth=no_depth)
        for name, grid in tokens.items():
            log_p = np.asarray(jax.nn.log_softmax(logits[name][:, t - base]))  # B S n V
            cells = grid[:, t].reshape(BATCH, 9)
            codes = np.stack([cells % 8, cells // 8], axis=-1)[..., None]
            nats[name][:, t] = -np.take_along_axis(log_p, codes, -1).sum((2, 3)).mean(1)
            best = log_p.argmax(-1)
            right[name][:, t] = (best[..., 0] + 8 * best[..., 1] == cells).mean(1)
    for scores in (nats, right):
        if "depth" in scores:
            scores["depth"][no_depth] = np.nan
    cut = lambda scores: {name: values[:, past:] for name, values in scores.items()}  # noqa: E731
    return TeacherForced(cut(nats), cut(right))


@pytest.mark.parametrize(
    ("model", "past", "frames", "no_depth"),
    [
        (SUMS, 3, 11, NONE),
        (ROTARY, 1, 11, NONE),
        (WHOLE, 2, 9, NONE),
        (SMALL, 2, 5, FIRST),
    ],
    ids=["windows-sums", "rotary-long", "whole-frames", "small-branch-some-without-depth-short"],
)
def test_one_pass_with_the_cache_is_one_full_pass_for_each_frame(
    model: Architecture, past: int, frames: int, no_depth: np.ndarray
) -> None:
    tokens, actions = given(model, frames, frames)
    got = score_tokens(model, SAMPLE, random_params(model), tokens, actions, no_depth, past)
    expected = by_definition(model, past, frames, no_depth)
    for name in tokens:
        assert got.cross_entropy[name].shape == (BATCH, frames - past)
        np.testing.assert_allclose(got.cross_entropy[name], expected.cross_entropy[name], rtol=1e-4)
        np.testing.assert_allclose(got.accuracy[name], expected.accuracy[name], atol=1e-6)
