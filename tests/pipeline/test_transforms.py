from collections.abc import Iterator

import numpy as np
import pytest

from rsjax.clip import Batch
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.data.store import Record, encode_clip
from rsjax.pipeline import transforms
from tests.pipeline import toy


@pytest.fixture(scope="module")
def record() -> Record:
    return encode_clip(toy.clip(0))


def draws(
    record: Record, depth_share: float, count: int = 4, seeds: int = 50, flip: bool = False
) -> Iterator[np.ndarray]:
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        arrays = transforms.tokenizer_images(
            record, rng, count=count, depth_share=depth_share, scale="inverse", flip=flip
        )
        yield arrays["images"]


def which(image: np.ndarray, images: np.ndarray) -> int | None:
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
        as_rgb, as_depth = ([which(image, frames) for image in images] for frames in (record["rgb"], colors))
        chosen = [rgb if rgb is not None else depth for rgb, depth in zip(as_rgb, as_depth, strict=True)]
        assert None not in chosen
        assert len(set(chosen)) == 4, "a frame twice, though there are enough"
        depths += sum(place is not None for place in as_depth)
    assert low <= depths <= high


def test_a_short_clip_gives_frames_twice(record: Record) -> None:
    images = next(draws(record, 0.0, count=10))
    assert {which(image, record["rgb"]) for image in images} <= set(range(6))


def test_the_generator_alone_decides_and_the_record_stays_as_it_is(record: Record) -> None:
    before = {name: np.copy(record[name]) for name in ("rgb", "depth")}
    one, other = (np.stack(list(draws(record, 0.5, seeds=5))) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert not np.array_equal(one[0], one[1])
    for name, array in before.items():
        np.testing.assert_array_equal(record[name], array)


@pytest.mark.parametrize("depth_share", [0.0, 1.0])
def test_half_of_the_images_are_mirrored_and_that_is_all(record: Record, depth_share: float) -> None:
    mirrored = 0
    pairs = zip(draws(record, depth_share), draws(record, depth_share, flip=True), strict=True)
    for plain, flipped in pairs:
        for one, other in zip(plain, flipped, strict=True):
            assert np.array_equal(one, other) or np.array_equal(one[:, ::-1], other)
            mirrored += not np.array_equal(one, other)
    assert 70 <= mirrored <= 130  # of 200


def test_images_of_several_clips_are_one_batch() -> None:
    images = np.arange(2 * 3 * 4 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 4, 3)
    batch = transforms.image_batch({"images": images})
    np.testing.assert_array_equal(batch, np.concatenate([images[0], images[1]]))


UNITS = Normalization((0.1, -0.2, 0.3), (0.5, 1.0, 2.0), (0.1, 1.0))


def token_record(record: Record) -> Record:
    grid = np.arange(6 * 8 * 8, dtype=np.int32).reshape(6, 8, 8)
    actions = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    return record | {"rgb": grid, "depth": grid + 1, "actions": actions}


def batch_of(records: list[Record], **more: np.ndarray) -> Batch:
    rows = [transforms.token_clip(UNITS, True, record, np.random.default_rng(0)) for record in records]
    return transforms.token_batch({name: np.stack([row[name] for row in rows]) for name in rows[0]} | more)


def test_a_token_batch_counts_every_clip_and_numbers_them(record: Record) -> None:
    tokens = token_record(record)
    batch = batch_of([tokens] * 3)
    assert batch.weight.tolist() == [1, 1, 1]
    assert batch.index.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(batch.depth, np.stack([tokens["depth"]] * 3))
    np.testing.assert_array_equal(batch.tracks[1], record["tracks"])
    np.testing.assert_array_equal(batch.actions[2], UNITS.action_inputs(tokens["actions"], True))


def test_a_token_batch_takes_weights_and_places_where_it_is_given_them(record: Record) -> None:
    weight, index = np.array([1.0, 0.0], np.float32), np.array([1, 3], np.int32)
    batch = batch_of([token_record(record)] * 2, weight=weight, index=index, part=np.zeros(2))
    assert (batch.weight.tolist(), batch.index.tolist()) == ([1, 0], [1, 3])


def test_clips_without_depth_say_so_and_bring_zeros(record: Record) -> None:
    tokens = token_record(record)
    batch = batch_of([tokens, tokens | {"depth": None}])
    assert np.asarray(batch.has_depth).tolist() == [1, 0]
    assert not batch.depth[1].any()
    np.testing.assert_array_equal(batch.depth[0], tokens["depth"])


def test_images_of_a_clip_without_depth_are_its_frames(record: Record) -> None:
    blind = record | {"depth": None}
    for images in draws(blind, 0.5, seeds=5):
        assert None not in [which(image, record["rgb"]) for image in images]
