"""Frame by frame with actions that come in one at a time: the frames of a rollout."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import CLIPS, State, rollout, start, step, where
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import BATCH, DUAL, KEY, RGB, SMALL, given, random_params

SMALL_SUMS = depart(replace(SMALL, action_inputs=4), integrate_actions=True, read_previous=True)
ONE_START = depart(
    replace(DUAL, action_inputs=4, one_start=True), integrate_actions=True, read_previous=True, whole_frames=True
)
GUIDED = depart(RGB, action_dropout=0.1, rotary=True, read_previous=True, whole_frames=True)
FRAMES = 15


@pytest.mark.parametrize(
    ("model", "sample"),
    [
        (SMALL_SUMS, SampleConfig(steps=2, mean_codes=True, read_means=True, window_stride=2)),
        (ONE_START, SampleConfig(steps=1, temperature=1.0, window_stride=5)),
        (GUIDED, SampleConfig(steps=2, unmask="greedy", guidance=2.0)),
    ],
    ids=["small-branch-means-sums", "whole-frames-one-kept-sums-of-the-clip", "whole-frames-rotary-guided"],
)
def test_stepping_recomputes_a_rollout_though_clips_begin_at_different_times(
    model: Architecture, sample: SampleConfig
) -> None:
    params, (tokens, actions) = random_params(model), given(model, 1, FRAMES)
    resting = None
    if model.one_start:
        resting = jnp.linspace(-0.5, 0.5, model.action_inputs)
    expected = rollout(model, sample, params, tokens, actions, KEY, cached=False, resting=resting)
    late = 4
    cells = {name: jnp.asarray(grid.reshape(BATCH, 1, 1, -1)) for name, grid in tokens.items()}
    keys = jax.vmap(partial(jax.random.fold_in, KEY))(jnp.arange(BATCH))[:, None]
    no_actions = jnp.zeros((1, 1, model.action_inputs))

    def begin(cells: dict[str, jax.Array], key: jax.Array) -> State:
        return start(model, sample, params, cells, no_actions, key, None, resting)

    begin_each = jax.jit(jax.vmap(begin, out_axes=CLIPS))
    next_frame = jax.jit(partial(step, model, sample))
    state = begin_each(cells, keys)
    made: dict[str, list[list[np.ndarray]]] = {name: [[], []] for name in tokens}
    for number in range(1, FRAMES):
        if number == late:  # the second clip starts over, in the middle of its window
            restarted = jax.vmap(where, (0, CLIPS, CLIPS), CLIPS)
            state = restarted(jnp.array([False, True]), begin_each(cells, keys), state)
        rows = np.stack([actions[0, number], actions[1, number if number < late else number - late + 1]])
        state, frame = next_frame(params, state, rows[:, None])
        for name, grid in frame.items():
            for clip in range(BATCH):
                made[name][clip].append(np.asarray(grid[clip, 0]).reshape(expected[name].shape[2:]))
    same = partial(np.testing.assert_allclose, rtol=0, atol=1e-4)  # tokens are whole numbers, mean codes are not
    for name, grid in expected.items():
        truth = np.asarray(grid)
        same(made[name][0], truth[0, 1:], err_msg=name)
        same(made[name][1][: late - 1], truth[1, 1:late], err_msg=name)
        same(made[name][1][late - 1 :], truth[1, 1 : FRAMES - late + 1], err_msg=name)
        assert np.ptp(truth[:, 1:]) > 0
