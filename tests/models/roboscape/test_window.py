"""Rollouts longer than the window."""

import itertools
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

from rsjax.config import KeepStillConfig, SampleConfig
from rsjax.data.normalization import Normalization
from rsjax.models.roboscape import sample as module
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import resting_actions, rollout, sums_before, window_actions, window_start
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import BATCH, DUAL, KEY, NO_PARAMS, RGB, count_model, given, random_params

ROTARY = depart(RGB, rotary=True)
WHOLE = depart(RGB, read_previous=True, whole_frames=True)
SUMS = depart(replace(RGB, action_inputs=4), integrate_actions=True)


@drawn(window=st.integers(2, 20), by=st.integers(0, 19), frames=st.integers(2, 90))
def test_a_full_window_jumps_by_its_stride(window: int, by: int, frames: int) -> None:
    model, sample = Architecture(frames=window), SampleConfig(window_stride=by % window)
    base, by = 0, by % window or window // 2
    for t in range(frames):
        if t - base == window:
            base += by
        assert window_start(model, sample, t) == base


@pytest.mark.parametrize("integrate", [False, True])
@pytest.mark.parametrize("base", [0, 2])
def test_a_windows_actions_are_those_of_a_clip_that_begins_there(base: int, integrate: bool) -> None:
    model = SUMS if integrate else RGB
    raw = np.random.default_rng(0).normal(size=(BATCH, 7, 2)).astype(np.float32)
    units = Normalization((0.1, -0.2), (0.5, 2.0), (0.0, 1.0))
    whole = units.action_inputs(raw, integrate)
    seen = window_actions(model, whole[:, base : base + 4], whole[:, base], 0)
    expected = units.action_inputs(raw[:, base : base + 4].copy(), integrate)
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    later = window_actions(model, whole[:, base + 2 : base + 4], whole[:, base], 2)
    np.testing.assert_allclose(later, expected[:, 2:], atol=1e-5)


def test_sums_that_go_on_say_where_a_clip_that_moved_as_far_within_the_window_would_be() -> None:
    raw = np.random.default_rng(0).normal(size=(BATCH, 7, 2)).astype(np.float32)
    units = Normalization((0.1, -0.2), (0.5, 2.0), (0.0, 1.0))
    whole = units.action_inputs(raw, integrate=True)
    base = 3
    resting = resting_actions(replace(SUMS, one_start=True), units)
    assert resting_actions(SUMS, units) is None
    assert resting_actions(replace(RGB, one_start=True), units) is None
    before = sums_before(whole[:, base], base, resting)
    seen = window_actions(SUMS, whole[:, base:], before, 0)
    short = raw[:, base:].copy()
    short[:, 1] += raw[:, 1 : base + 1].sum(1)
    np.testing.assert_allclose(seen[..., 2:], units.action_inputs(short, integrate=True)[..., 2:], atol=1e-5)
    np.testing.assert_allclose(seen[:, 1:, :2], whole[:, base + 1 :, :2], atol=1e-6)


@pytest.mark.parametrize(
    ("model", "prompt", "stride"),
    [(SUMS, 3, 1), (ROTARY, 11, 0), (WHOLE, 9, 5)],
    ids=["stride-1-sums", "rotary-long-prompt", "whole-frames-long-prompt"],
)
def test_cached_is_uncached_beyond_the_window(model: Architecture, prompt: int, stride: int) -> None:
    sample = SampleConfig(steps=2, temperature=1.0, window_stride=stride)
    params, (tokens, actions) = random_params(model), given(model, prompt, 16)
    cached, plain = (rollout(model, sample, params, tokens, actions, KEY, cached=c) for c in (True, False))
    for name, grid in cached.items():
        assert grid.shape == (BATCH, 16, 3, 3)
        np.testing.assert_array_equal(grid, plain[name], err_msg=name)
        np.testing.assert_array_equal(grid[:, :prompt], tokens[name])
        assert np.ptp(np.asarray(grid)[:, prompt:]) > 0


def test_each_frame_is_that_of_a_short_rollout_from_its_window() -> None:
    sample, params = SampleConfig(steps=2, unmask="greedy", window_stride=2), random_params(SUMS)
    tokens, actions = given(SUMS, 1, 12)
    out = rollout(SUMS, sample, params, tokens, actions, KEY)["rgb"]
    for t in (6, 8, 10):  # the window has just moved
        base = int(window_start(SUMS, sample, t))
        seen = window_actions(SUMS, actions[:, base : t + 1], actions[:, base], 0)
        short = rollout(SUMS, sample, params, {"rgb": out[:, base:t]}, seen, KEY)["rgb"]
        np.testing.assert_array_equal(out[:, t], short[:, -1])


@pytest.mark.parametrize(("rotary", "beyond"), [(False, 3), (True, 2)])
def test_a_longer_rollout_is_no_larger_a_program(rotary: bool, beyond: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The model stands in it twice, for two frames and for one, and where a window jumps once more."""
    model, seen = depart(replace(DUAL, frames=16), rotary=rotary), count_model(monkeypatch)
    calls, sizes = {}, {}
    for frames in (16, 48, 96):
        seen.clear()
        tokens, actions = given(model, 1, frames)
        program = jax.make_jaxpr(lambda t, a: rollout(model, SampleConfig(), NO_PARAMS, t, a, KEY))(tokens, actions)
        calls[frames], sizes[frames] = seen["calls"], str(program).count("\n")
    assert calls == {16: 2, 48: beyond, 96: beyond}
    assert sizes[48] == sizes[96]


def test_lengths_up_to_one_multiple_of_the_window_are_one_program_and_the_next_is_another() -> None:
    """Whatever the seed, and whether pictures are mixed with the first one after decoding."""
    mixing = (None, KeepStillConfig())
    model = replace(RGB, width=20)  # a model of this test alone
    params, (tokens, actions) = random_params(model), given(model, 1, 12)
    compiled: Any = module._rollout
    before = compiled._cache_size()
    for lengths, programs in (((6, 5, 2), 1), ((12, 11, 7), 2)):
        made = [
            rollout(model, SampleConfig(seed=frames, keep_still=still), params, tokens, actions[:, :frames], KEY)["rgb"]
            for frames, still in zip(lengths, itertools.cycle(mixing), strict=False)
        ]
        for frames, short in zip(lengths, made, strict=True):
            np.testing.assert_array_equal(short, made[0][:, :frames])
        assert compiled._cache_size() == before + programs


@pytest.mark.parametrize(("rotary", "passes"), [(False, 141 + 4 * 7), (True, 141)])
def test_a_jump_costs_the_frames_that_are_encoded_anew(
    rotary: bool, passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, seen = depart(replace(RGB, frames=16, grid=1), rotary=rotary), count_model(monkeypatch)
    with jax.disable_jit():
        tokens = {"rgb": np.zeros((1, 1, 1, 1), np.int32)}
        rollout(model, SampleConfig(), NO_PARAMS, tokens, np.zeros((1, 48, 3), np.float32), KEY)
    assert seen["frames"] == passes
