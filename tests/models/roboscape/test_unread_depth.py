"""A depth head that the network does not feed on: depth can be left out, and RGB is the same to the bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import DepthHead, SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.flops import forward_flops
from rsjax.models.roboscape.sample import rollout
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import DUAL, HEAD, KEY, RGB, given, random_params
from tests.tools.pipeline import toy

UNREAD = depart(replace(HEAD, reads_depth=False), read_previous=True)
GREEDY = SampleConfig(steps=2, unmask="greedy")


def test_rgb_is_the_same_to_the_bit_without_the_head() -> None:
    sample = SampleConfig(steps=2, temperature=1.0)
    params, (tokens, actions) = random_params(UNREAD), given(UNREAD, 2)
    whole = rollout(UNREAD, sample, params, tokens, actions, KEY)
    other = tokens | {"depth": tokens["depth"] ^ 9}
    np.testing.assert_array_equal(rollout(UNREAD, sample, params, other, actions, KEY)["rgb"], whole["rgb"])
    alone = rollout(UNREAD.generating(sample, depth=False), sample, params, {"rgb": tokens["rgb"]}, actions, KEY)
    assert alone.keys() == {"rgb"}
    np.testing.assert_array_equal(alone["rgb"], whole["rgb"])
    assert np.ptp(np.asarray(whole["depth"])[:, 2:]) > 0


@pytest.mark.parametrize(
    ("model", "sample", "depth"),
    [
        (UNREAD, SampleConfig(), True),
        (UNREAD, GREEDY, False),  # whose order of cells follows the confidence in depth as well
        (HEAD, SampleConfig(), False),
        (DUAL, SampleConfig(), False),
    ],
    ids=["wanted", "greedy", "read", "branch"],
)
def test_the_head_stays_where_it_is_wanted_or_rgb_would_change(
    model: Architecture, sample: SampleConfig, depth: bool
) -> None:
    assert model.generating(sample, depth) == model


def test_without_the_head_a_pass_costs_what_rgb_alone_does() -> None:
    dropped = UNREAD.generating(SampleConfig(), depth=False)
    assert forward_flops(dropped, 6) == forward_flops(RGB, 6) < forward_flops(UNREAD, 6)


def test_generation_plans_and_environments_without_depth_leave_the_head_out(tmp_path: Path) -> None:
    clips = toy.store(tmp_path / "clips")
    config = toy.with_model(toy.config(), depth=DepthHead(feed_back=False), sample=SampleConfig(steps=2))
    trained = toy.trained(clips, config)
    clip = clips.source("test")[0]
    prompt = Video(clip["rgb"][None, :1], clip["depth"][None, :1])
    inputs = (trained.params, trained.assets, prompt, clip["actions"][None])
    both = trained.model.generate(*inputs)
    alone = trained.model.generate(*inputs, depth=False)
    assert both.depth is not None
    assert alone.depth is None
    np.testing.assert_array_equal(alone.rgb, both.rgb)
    without = {name: values for name, values in trained.params.items() if name != "depth_head"}
    shown = replace(trained, params=without).generate(clip["rgb"][:1], clip["actions"])  # of a prompt without depth
    np.testing.assert_array_equal(shown.rgb, both.rgb[0])
    planned = trained.model.plan(*inputs, depth=False)
    assert planned.depth is None
    np.testing.assert_array_equal(planned.rgb, both.rgb)
    imagination = trained.model.imagine(without, trained.assets, 1, depth=False)
    imagination.restart(np.array([True]), prompt, np.zeros(1, int))
    frame = imagination.step(clip["actions"][1:2])
    assert frame.depth is None
    assert np.abs(frame.rgb[:, 0].astype(int) - both.rgb[:, 1]).max() <= 1  # decoded in other numbers
