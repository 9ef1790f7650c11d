from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.tokenizers import codec as module
from rsjax.tokenizers.codec import Codec, in_chunks
from rsjax.tokenizers.magvit2 import Tokenizer
from tests.tools.pipeline import toy

CONFIG = toy.config().tokenizer
NEAR_FAR = (0.4, 3.0)
NORMALIZATION = Normalization((0.0,), (1.0,), NEAR_FAR)


@pytest.fixture(scope="module")
def codec() -> Codec:
    return Codec(CONFIG, toy.tokenizer_params(), NORMALIZATION)


def replace_network(run: Callable[..., np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets a function stand in for the program that encodes or decodes a pass."""
    monkeypatch.setattr(module, "_run", run)


def test_chunks_give_the_same(codec: Codec, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 3, 64, 64, 3), np.uint8)
    tokens = rng.integers(0, 256, (2, 3, 8, 8), np.int32)
    apply = jax.jit(Tokenizer(CONFIG).apply, static_argnames="method")
    whole = apply({"params": codec.params}, frames.reshape(6, 64, 64, 3), method="encode")
    monkeypatch.setattr(module, "CPU_PIXELS", 4 * 64**2)
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
    monkeypatch.setattr(module, "passes_at_once", lambda: 1)
    # With a tokenizer that keeps everything, metres are right to half of one of the map's 766 levels.
    replace_network(lambda config, method, mesh, params, x: np.resize(colors, (len(x), 64, 64, 3)), monkeypatch)
    metres = codec.decode_depth(tokens)
    assert metres.shape == depth.shape
    level = (1 / NEAR_FAR[0] - 1 / NEAR_FAR[1]) / 765
    assert np.abs(1 / metres - 1 / depth).max() <= 0.51 * level


def test_depth_has_no_tokens_where_no_clip_has_depth(codec: Codec) -> None:
    blind = replace(codec, normalization=replace(NORMALIZATION, depth_range=None))
    with pytest.raises(UserError, match="depth_range is null: no clip of .* has depth"):
        blind.encode_depth(np.ones((1, 64, 64), np.float32))
    with pytest.raises(UserError, match="depth_range is null"):
        blind.decode_depth(np.zeros((1, 8, 8), np.int32))


def test_a_videos_depth_is_that_of_the_clips_that_have_it(codec: Codec) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (2, 3, 64, 64, 3), np.uint8)
    depth = rng.uniform(*NEAR_FAR, (2, 3, 64, 64)).astype(np.float32)
    depth[1] = np.nan
    video = Video(rgb, depth)
    tokens = codec.encode(video)
    np.testing.assert_array_equal(tokens["depth"][0], codec.encode_depth(depth[0]))
    assert not tokens["depth"][1].any()
    again = codec.decode(tokens, video.has_depth)
    np.testing.assert_array_equal(again.rgb, codec.decode_rgb(tokens["rgb"]))
    assert again.depth is not None and np.isnan(again.depth[1]).all()
    np.testing.assert_array_equal(again.depth[0], codec.decode_depth(tokens["depth"][0]))
    assert codec.encode(Video(rgb)).keys() == {"rgb"} and codec.encode(video[1:]).keys() == {"rgb"}
    assert codec.decode(tokens, np.zeros(2, bool)).depth is None


def test_a_clip_has_depth_where_any_pixel_of_its_first_frame_is_known(codec: Codec) -> None:
    depth = np.ones((3, 2, 64, 64), np.float32)
    depth[0, 0, 5, 7] = np.nan
    depth[1, 0] = np.nan
    video = Video(np.zeros((*depth.shape, 3), np.uint8), depth)
    assert video.has_depth.tolist() == [True, False, True]
    zero = np.nan_to_num(depth[0], nan=0.0)
    np.testing.assert_array_equal(codec.encode(video)["depth"][0], codec.encode_depth(zero))


@pytest.mark.parametrize(("pad", "sizes"), [(True, [16, 16]), (False, [1, 16])])
def test_the_last_pass_is_padded_only_if_asked_for(pad: bool, sizes: list[int]) -> None:
    passes = []

    def negative(items: np.ndarray) -> np.ndarray:
        passes.append(len(items))
        return -items

    items = np.arange(17.0)[:, None]
    np.testing.assert_array_equal(in_chunks(negative, items, 1, 16, pad), -items)
    assert sorted(passes) == sizes


def test_a_cpu_computes_no_image_twice(codec: Codec, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []

    def apply(config: Any, method: str, mesh: Any, params: Any, x: np.ndarray, count: np.ndarray) -> np.ndarray:
        counts.append(int(count))
        return np.zeros((len(x), 8, 8), np.int32)

    replace_network(apply, monkeypatch)
    assert codec.encode_rgb(np.zeros((17, 64, 64, 3), np.uint8)).shape == (17, 8, 8)
    assert sum(counts) == 17


def test_one_program_serves_any_number_of_images(codec: Codec) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (11, 64, 64, 3), np.uint8)
    whole = codec.encode_rgb(frames)
    pictures = codec.decode_rgb(whole)
    program: Any = module._run
    programs = program._cache_size()
    for count in (1, 2, 5):
        np.testing.assert_array_equal(codec.encode_rgb(frames[:count]), whole[:count])
        np.testing.assert_array_equal(codec.decode_rgb(whole[:count]), pictures[:count])
    assert program._cache_size() == programs
