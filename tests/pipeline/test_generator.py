import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.config import presets, to_dict
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.models.roboscape.rollout import rollout
from rsjax.models.roboscape.world_model import WorldModel
from rsjax.pipeline import generator as module
from rsjax.pipeline.generator import Codec, Generator, load_config
from rsjax.tokenizers.magvit2 import Tokenizer

CONFIG = presets.debug()
WIDTH = CONFIG.sim.action_dim
NEAR_FAR = (0.4, 3.0)
UNITS = Normalization(tuple(np.linspace(-1, 1, WIDTH)), (0.0, *np.linspace(0.1, 2, WIDTH - 1)), NEAR_FAR)


@pytest.fixture(scope="module")
def codec() -> Codec:
    return Codec(CONFIG, jax.jit(Tokenizer(CONFIG.tokenizer).init_params)(jax.random.key(0)), UNITS)


@given(seed=st.integers(0, 99), frames=st.integers(2, 6), clips=st.integers(1, 3))
def test_action_inputs_are_undone_by_mean_and_deviation_and_begin_with_zeros(
    seed: int, frames: int, clips: int
) -> None:
    actions = np.random.default_rng(seed).normal(size=(clips, frames, WIDTH)).astype(np.float32)
    before = actions.copy()
    inputs = UNITS.action_inputs(actions, integrate=False)
    assert inputs.dtype == np.float32
    assert not inputs[:, 0].any()
    # The first dimension has no deviation: it is divided by 0.001, not by 0.
    back = inputs[:, 1:] * np.array([1e-3, *UNITS.action_std[1:]]) + UNITS.action_mean
    np.testing.assert_allclose(back, actions[:, 1:], atol=1e-5)
    np.testing.assert_array_equal(actions, before)
    assert UNITS.action_inputs(actions[0], integrate=False).tolist() == inputs[0].tolist()


def test_integrated_actions_follow_the_plain_ones_and_their_differences_are_these() -> None:
    actions = np.random.default_rng(0).normal(size=(2, 5, WIDTH)).astype(np.float32)
    plain, both = (UNITS.action_inputs(actions, integrate=value) for value in (False, True))
    np.testing.assert_array_equal(both[..., :WIDTH], plain)
    np.testing.assert_allclose(np.diff(both[..., WIDTH:], axis=-2) * 4, plain[:, 1:], rtol=1e-3, atol=1e-3)
    assert not both[:, 0].any()


@pytest.mark.parametrize("chunk", [1, 4, 7])
def test_chunks_of_any_size_give_the_same(codec: Codec, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 3, 64, 64, 3), np.uint8)
    tokens = rng.integers(0, 256, (2, 3, 8, 8), np.int32)
    apply = jax.jit(Tokenizer(CONFIG.tokenizer).apply, static_argnames="method")
    whole = apply({"params": codec.params}, frames.reshape(6, 64, 64, 3), method="encode")
    monkeypatch.setattr(module, "CHUNK", chunk)
    np.testing.assert_array_equal(codec.encode_rgb(frames), np.reshape(whole, (2, 3, 8, 8)))
    decoded = apply({"params": codec.params}, tokens.reshape(6, 8, 8), method="decode")
    plain = np.round(np.reshape(decoded, frames.shape)).astype(np.uint8)
    got = codec.decode_rgb(tokens)
    assert got.dtype == np.uint8
    assert np.abs(got.astype(int) - plain).max() <= 1  # at a half, rounding follows float32's last bit


def test_depth_goes_through_its_colours_and_comes_back_in_metres(codec: Codec, monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.random.default_rng(0).uniform(*NEAR_FAR, (2, 3, 64, 64)).astype(np.float32)
    colors = depth_to_color(depth, *NEAR_FAR, "inverse").astype(np.uint8)
    tokens = codec.encode_depth(depth)
    np.testing.assert_array_equal(tokens, codec.encode_rgb(colors))
    # With a tokenizer that keeps everything, metres are right to half of one of the map's 766 levels.
    monkeypatch.setattr(module, "_decode", lambda config, params, tokens: np.resize(colors, (len(tokens), 64, 64, 3)))
    metres = codec.decode_depth(tokens)
    assert metres.shape == depth.shape
    level = (1 / NEAR_FAR[0] - 1 / NEAR_FAR[1]) / 765
    assert np.abs(1 / metres - 1 / depth).max() <= 0.51 * level


def test_where_no_clip_has_depth_its_maps_have_no_tokens(codec: Codec) -> None:
    blind = replace(codec, units=replace(UNITS, depth_range=None))
    for make in (
        lambda: blind.encode_depth(np.ones((1, 64, 64), np.float32)),
        lambda: blind.decode_depth(np.zeros((1, 8, 8), np.int32)),
    ):
        with pytest.raises(UserError, match="depth_range is null: none of the clips .* has depth"):
            make()


@pytest.mark.parametrize("depth_branch", [True, False])
def test_generate_is_a_rollout_decoded(codec: Codec, depth_branch: bool) -> None:
    model = replace(CONFIG.model, depth=depth_branch)
    params = jax.jit(WorldModel(model).init_params)(jax.random.key(1))
    generator = Generator(replace(CONFIG, model=model), codec, params)
    rng = np.random.default_rng(0)
    prompt = {name: rng.integers(0, 256, (2, 1, 8, 8), np.int32) for name in ("rgb", "depth")}
    actions = rng.normal(size=(2, 4, WIDTH)).astype(np.float32)
    made = generator.generate(prompt, actions, CONFIG.sample)
    given = {name: grid for name, grid in prompt.items() if name == "rgb" or depth_branch}
    inputs = UNITS.action_inputs(actions, integrate=False)
    tokens = rollout(model, CONFIG.sample, params, given, inputs, jax.random.key(CONFIG.sample.seed))
    assert made.tokens.keys() == given.keys()
    np.testing.assert_array_equal(made.tokens["rgb"], tokens["rgb"])
    np.testing.assert_array_equal(made.rgb, codec.decode_rgb(np.asarray(tokens["rgb"])))
    if depth_branch:
        np.testing.assert_array_equal(made.depth, codec.decode_depth(np.asarray(tokens["depth"])))
        assert generator.generate(prompt, actions, CONFIG.sample, depth=False).depth is None
    else:
        assert made.depth is None
    unread = actions.copy()
    unread[:, 0] = 9.0
    np.testing.assert_array_equal(generator.generate(prompt, unread, CONFIG.sample).rgb, made.rgb)


def random_generator(codec: Codec) -> Generator:
    rng, shapes = np.random.default_rng(0), jax.eval_shape(WorldModel(CONFIG.model).init_params, jax.random.key(1))
    params = jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)
    return Generator(CONFIG, codec, params)


def test_generated_depth_is_that_of_the_clips_that_have_it(codec: Codec) -> None:
    generator, rng, has = random_generator(codec), np.random.default_rng(0), np.array([True, False])
    prompt = {name: rng.integers(0, 256, (2, 1, 8, 8), np.int32) for name in ("rgb", "depth")}
    actions = rng.normal(size=(2, 4, WIDTH)).astype(np.float32)
    make = lambda prompt, has: generator.generate(prompt, actions, CONFIG.sample, has_depth=has)  # noqa: E731
    whole, mixed, none = make(prompt, None), make(prompt, has), make({"rgb": prompt["rgb"]}, None)
    assert whole.depth is not None
    assert mixed.depth is not None
    assert mixed.depth.dtype == np.float32
    # As many images as are decoded at once move a colour by float32's last bit, and that a pixel by a level of the map.
    np.testing.assert_allclose(mixed.depth[0], whole.depth[0], rtol=0.01)
    assert np.isnan(mixed.depth[1]).all()
    np.testing.assert_array_equal(mixed.rgb, np.stack([whole.rgb[0], none.rgb[1]]))
    assert none.depth is None
    assert make(prompt, np.zeros(2, bool)).depth is None
    np.testing.assert_array_equal(make(prompt, np.ones(2, bool)).depth, whole.depth)
    with pytest.raises(ValueError, match='no tokens "depth"'):
        make({"rgb": prompt["rgb"]}, has)
    with pytest.raises(ValueError, match="the prompt has 2 clips"):
        make(prompt, np.ones(3, bool))


@pytest.mark.parametrize("names", [("rgb", "depth"), ("rgb",)], ids=["depth", "no-depth"])
def test_a_plan_is_what_generate_makes_of_each_candidate(codec: Codec, names: tuple[str, ...]) -> None:
    generator, rng = random_generator(codec), np.random.default_rng(0)
    prompt = {name: rng.integers(0, 256, (1, 3, 8, 8), np.int32) for name in names}
    actions = rng.normal(size=(2, 7, WIDTH)).astype(np.float32)
    with pytest.raises(ValueError, match="differ in rows before 3"):
        generator.plan(prompt, actions, CONFIG.sample)
    actions[1, 1:3] = actions[0, 1:3]  # row 0 is not used
    repeated = {name: grid.repeat(2, 0) for name, grid in prompt.items()}
    made = generator.generate(repeated, actions, CONFIG.sample, depth=False, index=np.zeros(2, int))
    jax.tree.map(np.testing.assert_array_equal, generator.plan(prompt, actions, CONFIG.sample), made.tokens)
    assert not np.array_equal(made.tokens["rgb"][0], made.tokens["rgb"][1])


def test_a_runs_configuration_comes_back_or_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a run directory"):
        load_config(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(json.dumps(to_dict(CONFIG)))
    assert load_config(tmp_path) == CONFIG
    for text, words in (
        (path.read_text()[:-5], "config.json: not a configuration"),
        (json.dumps(to_dict(CONFIG) | {"colour": 1}), "Config has no field colour"),
        ("{}", "config.json: not a configuration"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=words):
            load_config(tmp_path)
