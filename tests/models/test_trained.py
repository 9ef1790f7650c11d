"""A trained model as people use it: pixels in, pixels out, and errors that name what was expected."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import NoDepth, SampleConfig
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.sample import rollout
from rsjax.models.trained import ShapeError, TrainedModel
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy

CONFIG = toy.config()
PAST, FRAMES, SIZE, WIDTH = 2, 6, CONFIG.clips.image_size, CONFIG.clips.action_dim


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("trained") / "clips")


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    return toy.trained(clips)


@pytest.fixture(scope="module", params=["depth", "no-depth-random"])
def trained(request: pytest.FixtureRequest, clips: Store, model: TrainedModel) -> TrainedModel:
    """With depth and decoded greedily; or without depth and with random draws."""
    if request.param == "depth":
        return model
    return toy.trained(clips, toy.with_model(CONFIG, depth=NoDepth(), sample=SampleConfig(temperature=1.0)))


RNG = np.random.default_rng(0)
RGB = np.stack([toy.clip(i).rgb for i in range(2)])
DEPTH = np.stack([np.asarray(toy.clip(i).depth) for i in range(2)])
ACTIONS = RNG.normal(0.1, 0.5, (2, FRAMES, WIDTH)).astype(np.float32)
PROMPT = RGB[:, :PAST], DEPTH[:, :PAST]


def assert_alike(one: Video, other: Video) -> None:
    """The same, but that images decoded in other numbers differ by float32's last bit, which moves a pixel a level."""
    assert np.abs(one.rgb.astype(int) - other.rgb).max() <= 1
    assert (one.depth is None) == (other.depth is None)
    if one.depth is not None and other.depth is not None:
        np.testing.assert_allclose(one.depth, other.depth, rtol=0.01)


def test_generated_videos_are_a_rollout_decoded(trained: TrainedModel, clips: Store) -> None:
    codec, network = toy.codec(clips), trained.model
    assert isinstance(network, RoboScape)
    sample, arch = network.config.sample, network.architecture
    rgb, depth = PROMPT
    made = trained.generate(rgb, ACTIONS, depth)
    given = {name: grid for name, grid in codec.encode(Video(rgb, depth)).items() if name in arch.branches}
    inputs = trained.assets.normalization.action_inputs(ACTIONS, integrate=False)
    tokens = rollout(arch, sample, trained.params, given, inputs, jax.random.key(sample.seed))
    assert made.rgb.shape == (2, FRAMES, SIZE, SIZE, 3) and made.rgb.dtype == np.uint8
    np.testing.assert_array_equal(made.rgb, codec.decode_rgb(np.asarray(tokens["rgb"])))
    np.testing.assert_array_equal(made.rgb[:, :PAST], codec.decode_rgb(given["rgb"]))
    if "depth" in arch.branches:
        np.testing.assert_array_equal(made.depth, codec.decode_depth(np.asarray(tokens["depth"])))
    else:
        assert made.depth is None
    without = trained.model.generate(trained.params, trained.assets, Video(rgb, depth), ACTIONS, depth=False)
    assert without.depth is None
    np.testing.assert_array_equal(without.rgb, made.rgb)
    unread = ACTIONS.copy()
    unread[:, 0] = 9.0
    np.testing.assert_array_equal(trained.generate(rgb, unread, depth).rgb, made.rgb)


def test_generated_depth_is_that_of_the_clips_that_have_it(model: TrainedModel) -> None:
    rgb, depth = PROMPT
    mixed_depth = np.where(np.array([True, False])[:, None, None, None], depth, np.nan)
    whole, mixed, none = (model.generate(rgb, ACTIONS, given) for given in (depth, mixed_depth, None))
    assert whole.depth is not None
    assert mixed.depth is not None
    assert mixed.depth.dtype == np.float32
    # As many images as are decoded at once move a colour by float32's last bit, and that a pixel by a level of the map.
    np.testing.assert_allclose(mixed.depth[0], whole.depth[0], rtol=0.01)
    assert np.isnan(mixed.depth[1]).all()
    np.testing.assert_array_equal(mixed.rgb, np.stack([whole.rgb[0], none.rgb[1]]))
    assert none.depth is None
    assert model.generate(rgb, ACTIONS, np.full_like(depth, np.nan)).depth is None


def test_tasks_reach_the_model(model: TrainedModel) -> None:
    class Told:
        def generate(self, params: Any, assets: Any, prompt: Video, actions: Any) -> Video:
            return prompt

        plan = generate

    told, rgb = replace(model, model=Told()), PROMPT[0]  # type: ignore[arg-type]
    assert told.plan(rgb[0], ACTIONS[:1], task="lift").tasks.tolist() == ["lift"]  # type: ignore[union-attr]
    with pytest.raises(ShapeError, match="task has 2 texts; expected one, or 1, one for each clip"):
        told.plan(rgb[0], ACTIONS, task=["lift", "press"])  # type: ignore[arg-type]
    assert told.generate(rgb, ACTIONS, task=["lift", "press"]).tasks.tolist() == ["lift", "press"]  # type: ignore[union-attr]


def test_rollouts_refuse_depth_without_its_tokens(model: TrainedModel, clips: Store) -> None:
    assert isinstance(model.model, RoboScape)
    arch, sample = model.model.architecture, model.model.config.sample
    tokens = {"rgb": toy.codec(clips).encode_rgb(PROMPT[0])}
    with pytest.raises(ValueError, match='no tokens "depth"'):
        rollout(arch, sample, model.params, tokens, ACTIONS, jax.random.key(0), no_depth=np.array([False, True]))


def test_one_clip_is_generated_as_among_many(trained: TrainedModel) -> None:
    rgb, depth = PROMPT
    many, one = trained.generate(rgb, ACTIONS, depth), trained.generate(rgb[0], ACTIONS[0], depth[0])
    assert one.rgb.shape == (FRAMES, SIZE, SIZE, 3)
    assert_alike(Video(one.rgb[None], None if one.depth is None else one.depth[None]), many[:1])
    assert not np.array_equal(many.rgb[0], many.rgb[1])


def test_actions_may_be_of_any_numbers(model: TrainedModel) -> None:
    rgb, depth = PROMPT
    whole = np.round(ACTIONS * 3).astype(int)
    expected = model.generate(rgb, whole.astype(np.float64), depth)
    np.testing.assert_array_equal(model.generate(rgb, whole.tolist(), depth).rgb, expected.rgb)


def test_actions_may_be_longer_than_the_trained_clips(model: TrainedModel) -> None:
    longer = np.concatenate([ACTIONS[0], ACTIONS[1, 1:]])
    assert model.generate(RGB[0, :1], longer).rgb.shape == (2 * FRAMES - 1, SIZE, SIZE, 3)


def test_a_plan_is_what_generate_makes_of_each_candidate_with_the_same_draws(trained: TrainedModel) -> None:
    rgb, depth = PROMPT[0][0], PROMPT[1][0]
    candidates = np.stack([ACTIONS[0], ACTIONS[1]])
    candidates[1, 1:PAST] = candidates[0, 1:PAST]  # row 0 is not used
    planned = trained.plan(rgb, candidates, depth)
    repeated = Video(rgb[None].repeat(2, 0), depth[None].repeat(2, 0))
    made = trained.model.generate(trained.params, trained.assets, repeated, candidates, index=np.zeros(2, int))
    jax.tree.map(np.testing.assert_array_equal, vars(planned), vars(made))
    assert not np.array_equal(planned.rgb[0], planned.rgb[1])
    inputs = (trained.params, trained.assets, repeated[:1], candidates)
    assert_alike(trained.model.plan(*inputs, last=2), planned.frames(-2))
    alike = trained.plan(rgb, candidates[[0, 0]], depth)
    np.testing.assert_array_equal(alike.rgb[0], alike.rgb[1])


def test_tokens_come_back_from_the_video_that_they_decode_to(model: TrainedModel, clips: Store) -> None:
    codec, (rgb, depth) = toy.codec(clips), PROMPT
    tokens = model.encode(rgb, depth)
    assert {name: grid.shape for name, grid in tokens.items()} == dict.fromkeys(("rgb", "depth"), (2, PAST, 8, 8))
    video = model.decode(tokens)
    np.testing.assert_array_equal(video.rgb, codec.decode_rgb(codec.encode_rgb(rgb)))
    np.testing.assert_array_equal(video.depth, codec.decode_depth(codec.encode_depth(depth)))
    reconstruction = model.model.reconstruct(model.assets, Video(rgb, depth))
    assert reconstruction is not None
    jax.tree.map(np.testing.assert_array_equal, vars(video), vars(reconstruction))
    one = model.encode(rgb[0], depth[0])
    jax.tree.map(np.testing.assert_array_equal, one, {name: grid[0] for name, grid in tokens.items()})
    single = model.decode(one)
    assert single.rgb.shape == (PAST, SIZE, SIZE, 3)
    assert single.depth is not None and video.depth is not None
    assert_alike(Video(single.rgb[None], single.depth[None]), video[:1])
    assert model.encode(rgb).keys() == {"rgb"}
    assert model.decode({"rgb": tokens["rgb"]}).depth is None


FRAMES_EXPECTED = rf"frames have shape .* expected \(P, {SIZE}, {SIZE}, 3\) for one clip or \(B, P, {SIZE}, {SIZE}, 3\)"
NAN = np.where(np.arange(FRAMES)[:, None] == 3, np.nan, ACTIONS[0])
TOKENS = np.zeros((2, 3, 8, 8), np.int32)
WRONG: dict[str, tuple[Callable[[Any], Any], str]] = {
    "frames-one-image": (lambda m: m.generate(RGB[0, 0], ACTIONS[0]), FRAMES_EXPECTED),
    "frames-size": (lambda m: m.generate(RGB[:, :1, :32], ACTIONS), FRAMES_EXPECTED),
    "frames-floats": (lambda m: m.generate(RGB[:, :1] / 255, ACTIONS), f"type float64; {'.*'}uint8"),
    "actions-width": (
        lambda m: m.generate(RGB[:, :1], ACTIONS[..., :3]),
        rf"actions have shape \(2, 6, 3\); expected \(2, T, {WIDTH}\) with T above 1",
    ),
    "actions-of-one-clip": (lambda m: m.generate(RGB[:, :1], ACTIONS[0]), rf"expected \(2, T, {WIDTH}\)"),
    "actions-of-many": (lambda m: m.generate(RGB[0, :1], ACTIONS), rf"expected \(T, {WIDTH}\) with T above 1"),
    "actions-short": (lambda m: m.generate(RGB[0], ACTIONS[0]), f"with T above {FRAMES}"),
    "actions-nan": (lambda m: m.generate(RGB[0, :1], NAN), "actions are float.*not finite.*; expected floats"),
    "actions-words": (lambda m: m.generate(RGB[0, :1], ACTIONS[0].astype(str)), "actions are <U.*; expected floats"),
    "actions-huge": (lambda m: m.generate(RGB[0, :1], ACTIONS[0] * 0 + 1e300), "not finite"),
    "actions-masked": (lambda m: m.generate(RGB[0, :1], np.ma.masked_all(ACTIONS[0].shape)), "actions are masked"),
    "depth-negative": (
        lambda m: m.generate(RGB[:, :1], ACTIONS, -1 - DEPTH[:, :1]),
        "depth is from .*; expected metres",
    ),
    "depth-huge": (lambda m: m.generate(RGB[:, :1], ACTIONS, DEPTH[:, :1] * 0 + 1e300), "expected metres, 0 or more"),
    "depth-of-one-clip": (
        lambda m: m.generate(RGB[:, :1], ACTIONS, DEPTH[0, :1]),
        rf"depth has shape \(1, {SIZE}, {SIZE}\).*; expected \(2, 1, {SIZE}, {SIZE}\), that of the frames",
    ),
    "depth-words": (lambda m: m.generate(RGB[0, :1], ACTIONS[0], DEPTH[0, :1].astype(str)), "depth has .*floats"),
    "plan-many-clips": (lambda m: m.plan(RGB[:, :1], ACTIONS), r"a plan starts from one clip, \(P, H, W, 3\)"),
    "plan-one-sequence": (
        lambda m: m.plan(RGB[0, :1], ACTIONS[0]),
        rf"actions have shape \(6, {WIDTH}\); expected \(N, T, {WIDTH}\)",
    ),
    "plan-none": (lambda m: m.plan(RGB[0, :1], ACTIONS[:0]), rf"expected \(N, T, {WIDTH}\)"),
    "plan-past": (
        lambda m: m.plan(RGB[0, :3], ACTIONS),
        "actions differ in rows before 3, which led into the 3 frames; expected the same rows 1 to 2",
    ),
    "encode-frames": (lambda m: m.encode(RGB[..., 0]), FRAMES_EXPECTED),
    "decode-grid": (
        lambda m: m.decode({"rgb": TOKENS[..., :4]}),
        r"tokens 'rgb' have shape \(2, 3, 8, 4\) .*; expected \(T, 8, 8\) for one clip or \(B, T, 8, 8\)",
    ),
    "decode-floats": (lambda m: m.decode({"rgb": TOKENS / 2}), "type float64; .*integers"),
    "decode-lengths": (lambda m: m.decode({"rgb": TOKENS, "depth": TOKENS[0]}), "'depth' have shape .*'rgb'"),
    "decode-no-rgb": (lambda m: m.decode({"depth": TOKENS}), "tokens are of depth; expected rgb"),
    "frames-none": (lambda m: m.generate(None, ACTIONS), FRAMES_EXPECTED),
    "frames-no-clip": (lambda m: m.generate(RGB[:0, :1], ACTIONS[:0]), FRAMES_EXPECTED),
    "frames-ragged": (lambda m: m.generate([[1], [1, 2]], ACTIONS), "frames cannot be made an array"),
    "task-number": (lambda m: m.generate(RGB[0, :1], ACTIONS[0], task=7), "task is 7; expected one text"),
    "task-numbers": (lambda m: m.generate(RGB[:, :1], ACTIONS, task=[1, 2]), "task is .1, 2.; expected one text"),
    "decode-none": (lambda m: m.decode(None), "tokens are NoneType"),
    "decode-nothing": (lambda m: m.decode({"rgb": TOKENS[:, :0]}), "tokens 'rgb' are empty"),
    "decode-codes": (lambda m: m.decode({"rgb": TOKENS + 2**30}), "tokens 'rgb' are from 1073741824 to 1073741824"),
    "decode-below": (lambda m: m.decode({"rgb": TOKENS - 1}), "tokens 'rgb' are from -1 to -1"),
    "decode-names": (lambda m: m.decode({"rgb": TOKENS, "deep": TOKENS}), "tokens are of rgb, deep; expected rgb"),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_a_wrong_argument_is_named_with_what_was_expected(case: str, model: TrainedModel) -> None:
    use, words = WRONG[case]
    with pytest.raises(ShapeError, match=words):
        use(model)


def test_a_wrong_argument_of_save_is_named(model: TrainedModel, tmp_path: Path) -> None:
    place = tmp_path / "saved"
    file = tmp_path / "file"
    file.touch()
    wrong: dict[str, dict[str, Any]] = {
        "directory is None": {"directory": None},
        "file: no directory; choose another path": {"directory": file},
        "dtype is None; choose float32 or float16": {"directory": place, "dtype": None},
        "dtype is 'int32'": {"directory": place, "dtype": "int32"},
        "card is bytes": {"directory": place, "card": b"x"},
    }
    for message, arguments in wrong.items():
        with pytest.raises(UserError) as raised:
            model.save(**arguments)
        assert message in str(raised.value)
    assert not place.exists()


def test_a_family_without_tokens_encodes_nothing(model: TrainedModel) -> None:
    config = replace(CONFIG, model=ToyConfig())
    plain = replace(model, config=config, assets=replace(model.assets, tokenizer=None))
    for use in (lambda: plain.encode(RGB), lambda: plain.decode({"rgb": TOKENS})):
        with pytest.raises(
            UserError, match="a model of family 'toy' has no tokens that encode and decode take; use generate"
        ):
            use()
