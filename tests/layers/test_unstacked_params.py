"""Blocks that are taken apart for a loop give what stacked ones give."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np

from rsjax.config import SampleConfig
from rsjax.layers.unstacked_params import stack_params, unstack_params
from rsjax.models.ivideogpt.rollout import sample
from rsjax.models.roboscape.sample import encode_prompt, rollout, rollout_from
from tests.layers.kernels import lowered
from tests.models.ivideogpt import toy
from tests.models.roboscape.toy_sample import BATCH, DUAL, KEY, given, random_params


def test_stacking_what_was_taken_apart_changes_nothing() -> None:
    params = random_params(DUAL)
    parts = unstack_params(params["blocks"], DUAL.blocks, unroll=DUAL.blocks)
    assert len(parts) == DUAL.blocks
    jax.tree.map(np.testing.assert_array_equal, stack_params(parts), params["blocks"])


def test_a_scan_that_is_not_fully_unrolled_keeps_its_stacks() -> None:
    params = random_params(DUAL)
    assert unstack_params(params, DUAL.blocks, DUAL.blocks - 1) is params and stack_params(params) is params


def test_a_rollout_is_the_same() -> None:
    params, (tokens, actions) = random_params(DUAL), given(DUAL, 2)
    settings = SampleConfig(steps=2)
    stacked = rollout(DUAL, settings, params, tokens, actions, KEY)
    unrolled = replace(DUAL, unroll=DUAL.blocks)
    prompt = encode_prompt(unrolled, settings, params, tokens, actions[:, :2])
    resumed = rollout_from(unrolled, settings, params, prompt, actions[:, 2:], KEY)
    for name, grid in stacked.items():
        np.testing.assert_array_equal(resumed[name], grid)


def test_ivideogpt_draws_the_same_tokens() -> None:
    config = replace(toy.MODEL, sample=replace(toy.MODEL.sample, temperature=0.0))
    archs = [replace(toy.ARCH, config=replace(config, unroll=unroll)) for unroll in (1, toy.MODEL.blocks)]
    begin = np.random.default_rng(2).integers(0, 32, (BATCH, toy.ARCH.layout.first_slot), np.int32)
    actions = np.random.default_rng(3).normal(size=(BATCH, 3, 3)).astype(np.float32)
    keys = jax.random.split(KEY, BATCH)
    stacked, unrolled = (sample(arch, toy.llama_params(), begin, actions, keys) for arch in archs)
    assert np.ptp(np.asarray(stacked)) > 0
    np.testing.assert_array_equal(stacked, unrolled)


def test_a_rollout_on_a_gpu_has_no_loop_over_blocks() -> None:
    params, (tokens, actions) = random_params(DUAL), given(DUAL, 2)
    arch = replace(DUAL, compute_dtype="bfloat16")
    text = lowered(partial(rollout, arch, SampleConfig(steps=2)), (params, tokens, actions, KEY), "cuda")
    assert text.count("stablehlo.while") == 3  # over the prompt's blocks, over frames, and over later passes
