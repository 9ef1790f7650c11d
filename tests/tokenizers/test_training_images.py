"""The images that the tokenizer's loader takes from clips."""

from collections.abc import Iterator

import numpy as np
import pytest

from rsjax.data.depth_color import depth_to_color
from rsjax.data.store import Record, encode_clip
from rsjax.tokenizers.training import TokenizerImages, image_batch
from tests.tools.pipeline import toy


@pytest.fixture(scope="module")
def record() -> Record:
    return encode_clip(toy.clip(0))


def draws(
    record: Record, depth_share: float, count: int = 4, seeds: int = 50, flip: bool = False
) -> Iterator[np.ndarray]:
    transform = TokenizerImages(count, depth_share, "inverse", flip)
    for seed in range(seeds):
        yield transform(record, np.random.default_rng(seed))["images"]


def place(image: np.ndarray, images: np.ndarray) -> int | None:
    """The place of an image among others."""
    found = np.flatnonzero((images == image).all((1, 2, 3)))
    return int(found[0]) if len(found) else None


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0, 0), (0.25, 30, 70), (1.0, 200, 200)])
def test_images_are_different_frames_of_which_a_share_is_depth(
    record: Record, share: float, low: int, high: int
) -> None:
    colors = depth_to_color(record["depth"], *toy.DEPTH_RANGE, "inverse").astype(np.uint8)
    depths = 0
    for images in draws(record, share):
        assert images.dtype == np.uint8
        assert images.shape == (4, 64, 64, 3)
        as_rgb, as_depth = ([place(image, frames) for image in images] for frames in (record["rgb"], colors))
        chosen = [rgb if rgb is not None else depth for rgb, depth in zip(as_rgb, as_depth, strict=True)]
        assert None not in chosen
        assert len(set(chosen)) == 4, "a frame twice, though there are enough"
        depths += sum(number is not None for number in as_depth)
    assert low <= depths <= high


def test_a_short_clip_gives_frames_twice(record: Record) -> None:
    images = next(draws(record, 0.0, count=10))
    assert {place(image, record["rgb"]) for image in images} <= set(range(6))


def test_half_of_the_frames_are_of_the_second_view_where_the_model_reads_one(record: Record) -> None:
    seen = record | {"second": 255 - record["rgb"]}
    for second_view, low, high in ((False, 0, 0), (True, 70, 130)):
        transform = TokenizerImages(4, 0.0, "inverse", False, second_view)
        images = np.concatenate([transform(seen, np.random.default_rng(seed))["images"] for seed in range(50)])
        assert low <= sum(place(image, seen["second"]) is not None for image in images) <= high


def test_the_generator_alone_decides_and_the_record_stays_as_it_is(record: Record) -> None:
    before = {name: np.copy(record[name]) for name in ("rgb", "depth")}
    one, other = (np.stack(list(draws(record, 0.5, seeds=5))) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert not np.array_equal(one[0], one[1])
    for name, array in before.items():
        np.testing.assert_array_equal(record[name], array)


@pytest.mark.parametrize("depth_share", [0.0, 1.0])
def test_half_of_the_images_are_mirrored_and_nothing_else_changes(record: Record, depth_share: float) -> None:
    mirrored = 0
    pairs = zip(draws(record, depth_share), draws(record, depth_share, flip=True), strict=True)
    for plain, flipped in pairs:
        for one, other in zip(plain, flipped, strict=True):
            assert np.array_equal(one, other) or np.array_equal(one[:, ::-1], other)
            mirrored += not np.array_equal(one, other)
    assert 70 <= mirrored <= 130  # of 200


def test_images_of_several_clips_are_one_batch() -> None:
    images = np.arange(2 * 3 * 4 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 4, 3)
    np.testing.assert_array_equal(image_batch({"images": images}), np.concatenate([images[0], images[1]]))


def test_images_of_a_clip_without_depth_are_its_frames(record: Record) -> None:
    for images in draws(record | {"depth": None}, 0.5, seeds=5):
        assert None not in [place(image, record["rgb"]) for image in images]
