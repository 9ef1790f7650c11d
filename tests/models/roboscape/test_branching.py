"""Frames that go on from any frame: the same bits alone, in company, again and from a lightened memory."""

from dataclasses import replace

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import DepthBranch, SampleConfig, SmallDepthBranch
from rsjax.data.store import Store
from rsjax.models.branch_states import Branching, BranchState, Decoding
from rsjax.models.trained import TrainedModel
from tests.tools.pipeline import toy

FRAMES = 10  # the window is 6
DRAWN = Decoding(steps=2, temperature=1.0, draw=3)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("branching") / "clips")


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    sample = SampleConfig(steps=2, temperature=1.0, unmask="greedy")
    return toy.trained(clips, toy.with_model(toy.config(), sample=sample))


@pytest.fixture(scope="module")
def lanes(model: TrainedModel) -> Branching:
    return model.model.branching(model.params, model.assets, True, lanes=2)


def first(clips: Store, number: int) -> Video:
    clip = clips.source("test")[number]
    return Video(clip["rgb"][None, :1], clip["depth"][None, :1])


def rows(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (FRAMES, 28)).astype(np.float32)


def alone(branching: Branching, state: BranchState, actions: np.ndarray, decoding: Decoding) -> list[BranchState]:
    made = []
    for row in actions:
        [state] = branching.advance([state], row[None], [decoding])
        made.append(state)
    return made


def assert_same(one: BranchState, other: BranchState) -> None:
    np.testing.assert_array_equal(one.rgb, other.rgb)
    assert one.entropy is not None and other.entropy is not None
    np.testing.assert_array_equal(one.entropy, other.entropy)
    for name, cells in one.tokens.items():
        np.testing.assert_array_equal(cells, other.tokens[name])


@pytest.mark.parametrize("depth", [DepthBranch(), SmallDepthBranch(width=16, blocks=1, cells=2)])
def test_frames_are_those_of_generate(depth: object, model: TrainedModel, clips: Store) -> None:
    model = toy.trained(clips, toy.with_model(model.config, depth=depth))
    lanes = model.model.branching(model.params, model.assets, True, lanes=2)
    actions, clip = rows(1), clips.source("test")[1]
    made = alone(lanes, lanes.begin(first(clips, 1)), actions[1:], replace(DRAWN, draw=0))
    video = model.generate(clip["rgb"][:1], actions, clip["depth"][:1])
    rgb = np.stack([state.rgb for state in made])
    assert np.abs(rgb.astype(int) - video.rgb[1:]).max() <= 1  # pictures decoded in other numbers differ by a level
    last = lanes.depth(made[-1])
    assert video.depth is not None and last is not None
    np.testing.assert_allclose(last, video.depth[-1], rtol=0.01)


def test_frames_of_mean_codes_are_those_of_generate_and_drawn_ones_may_come_between(
    model: TrainedModel, clips: Store
) -> None:
    means = SampleConfig(steps=2, mean_codes=True, read_means=True)
    shown = toy.trained(clips, toy.with_model(model.config, sample=means))
    lanes = shown.model.branching(shown.params, shown.assets, True, lanes=2)
    actions, clip, sure = rows(1), clips.source("test")[1], Decoding(steps=2)
    made = alone(lanes, lanes.begin(first(clips, 1)), actions[1:], sure)
    video = shown.generate(clip["rgb"][:1], actions, clip["depth"][:1])
    # Of the first frames: what is read of mean codes that differ in rounding drifts apart.
    rgb = np.stack([state.rgb for state in made[:3]]).astype(int)
    assert np.abs(rgb - video.rgb[1:4]).max() <= 1
    decoded = toy.codec(clips).decode_rgb(np.stack([state.tokens["rgb"].reshape(8, 8) for state in made[:3]]))
    assert np.abs(rgb - decoded).max() > 10
    depth = lanes.depth(made[2])
    assert video.depth is not None and depth is not None
    np.testing.assert_allclose(depth, video.depth[3], rtol=0.01)

    start = lanes.begin(first(clips, 1))
    assert not start.means
    for how, has_means in ((DRAWN, False), (sure, True), (DRAWN, False)):
        [start] = lanes.advance([start], actions[1:2], [how])
        assert bool(start.means) == has_means


def test_a_frame_has_the_same_bits_whoever_shares_its_pass(lanes: Branching, clips: Store) -> None:
    """The other clip is at another frame, with other actions, draws and temperature, in either lane."""
    actions, others = rows(2), rows(3)
    expected = alone(lanes, lanes.begin(first(clips, 0)), actions, DRAWN)
    mine, other = lanes.begin(first(clips, 0)), lanes.begin(first(clips, 4))
    [other] = lanes.advance([other], others[:1], [DRAWN])
    for number in range(FRAMES):
        hot = replace(DRAWN, temperature=0.5 + number, draw=7)
        pair, pair_rows, how = [mine, other], np.stack([actions[number], others[number]]), [DRAWN, hot]
        if number % 2:
            other, mine = lanes.advance(pair[::-1], pair_rows[::-1], how[::-1])
        else:
            mine, other = lanes.advance(pair, pair_rows, how)
        assert_same(mine, expected[number])


def test_clips_that_one_program_generates_together_are_the_same_but_for_rounding(
    lanes: Branching, model: TrainedModel, clips: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on accelerators: two clips at different frames in one run of the program, and one with a repeated clip."""
    actions, others = rows(2), rows(3)
    expected = alone(lanes, lanes.begin(first(clips, 0)), actions[:3], DRAWN)
    monkeypatch.setattr("rsjax.models.roboscape.branching.program_clips", lambda lanes: lanes)
    together = model.model.branching(model.params, model.assets, True, lanes=2)
    mine, other = together.begin(first(clips, 0)), together.begin(first(clips, 4))
    [other] = together.advance([other], others[:1], [DRAWN])
    for number, action in enumerate(actions[:3]):
        if number == 2:
            [mine] = together.advance([mine], action[None], [DRAWN])
        else:
            other, mine = together.advance([other, mine], np.stack([others[number], action]), [DRAWN, DRAWN])
        assert np.abs(mine.rgb.astype(int) - expected[number].rgb).max() <= 1
        np.testing.assert_array_equal(mine.tokens["rgb"], expected[number].tokens["rgb"])
        entropy, its = mine.entropy, expected[number].entropy
        assert entropy is not None and its is not None
        np.testing.assert_allclose(entropy, its, rtol=3e-3, atol=1e-5)


def test_going_on_from_a_lightened_memory_gives_the_same_bits(lanes: Branching, clips: Store) -> None:
    actions, state = rows(4), lanes.begin(first(clips, 2))
    states, light = [], {0: lanes.lightened(state)}
    for number, row in enumerate(actions, 1):
        [state] = lanes.advance([state], row[None], [DRAWN])
        states.append(state)
        light[number] = lanes.lightened(state)
    stops = [number for number, each in light.items() if each.memory is not None]
    assert stops == [0, 5, 8]  # the first frame, and those that fill the window of 6, which then moves by 3
    for stop in stops:
        for _ in range(2):  # a small memory is not used up
            again = alone(lanes, light[stop], actions[stop:], DRAWN)
            assert_same(again[-1], states[-1])


def test_draws_follow_from_seed_and_draw_and_temperature_counts(lanes: Branching, clips: Store) -> None:
    actions, start = rows(5)[:3], lanes.begin(first(clips, 3))
    base = alone(lanes, start, actions, DRAWN)[-1].rgb
    for changed in (replace(DRAWN, draw=4), replace(DRAWN, seed=1), replace(DRAWN, temperature=0.3)):
        assert (alone(lanes, start, actions, changed)[-1].rgb != base).any()


def test_entropy_is_that_of_tokens(lanes: Branching, model: TrainedModel, clips: Store) -> None:
    state, *_ = lanes.advance([lanes.begin(first(clips, 0))], rows(6)[:1], [DRAWN])
    bits = model.config.tokenizer.code_bits
    assert state.entropy is not None
    assert state.entropy.min() > 0 and state.entropy.max() <= bits * np.log(2) * (1 + 1e-5)
