"""Token records as batches."""

import pickle

import numpy as np
import pytest

from rsjax.data.normalization import Normalization
from rsjax.data.store import Record, encode_clip
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.objective import Batch
from rsjax.models.roboscape.records import token_arrays, token_batch
from tests.tools.pipeline import toy

NORMALIZATION = Normalization((0.1, -0.2, 0.3), (0.5, 1.0, 2.0), (0.1, 1.0))


@pytest.fixture(scope="module")
def record() -> Record:
    grid = np.arange(6 * 8 * 8, dtype=np.int32).reshape(6, 8, 8)
    actions = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    return encode_clip(toy.clip(0)) | {"rgb": grid, "depth": grid + 1, "actions": actions}


def batch_of(records: list[Record], **more: np.ndarray) -> Batch:
    rows = [token_arrays(NORMALIZATION, True, record, np.random.default_rng(0)) for record in records]
    return token_batch({name: np.stack([row[name] for row in rows]) for name in rows[0]} | more)


def test_a_batch_counts_every_clip_and_numbers_them(record: Record) -> None:
    batch = batch_of([record] * 3)
    assert batch.weight.tolist() == [1, 1, 1]
    assert batch.index.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(batch.depth, np.stack([record["depth"]] * 3))
    np.testing.assert_array_equal(batch.tracks[1], record["tracks"])
    np.testing.assert_array_equal(batch.actions[2], NORMALIZATION.action_inputs(record["actions"], True))


def test_a_batch_takes_weights_and_numbers_from_its_arrays(record: Record) -> None:
    weight, index = np.array([1.0, 0.0], np.float32), np.array([1, 3], np.int32)
    batch = batch_of([record] * 2, weight=weight, index=index, part=np.zeros(2))
    assert (batch.weight.tolist(), batch.index.tolist()) == ([1, 0], [1, 3])


def test_clips_without_depth_are_marked_and_bring_zeros(record: Record) -> None:
    batch = batch_of([record, record | {"depth": None}])
    assert np.asarray(batch.has_depth).tolist() == [1, 0]
    assert not batch.depth[1].any()
    np.testing.assert_array_equal(batch.depth[0], record["depth"])


def test_an_example_of_the_model_makes_a_batch_and_its_transform_can_be_sent_to_workers() -> None:
    model = RoboScape.create(toy.config())
    width = model.clips.action_dim
    transform = pickle.loads(pickle.dumps(model.transform(Normalization((0.0,) * width, (1.0,) * width, None))))
    arrays = transform(model.example(np.random.default_rng(0)), np.random.default_rng(0))
    batch = model.batch({name: array[None] for name, array in arrays.items()})
    assert batch.rgb.shape == batch.depth.shape == (1, 6, 8, 8)
    assert batch.actions.shape == (1, 6, model.architecture.action_inputs)


def test_a_draw_takes_the_clip_or_one_of_its_moved_copies(record: Record) -> None:
    copies = np.stack([record["rgb"] + 1000, record["rgb"] + 2000])
    moves = np.array([[0.25, 0.0], [0.0, -0.25]], np.float32)
    with_copies = record | {"shifts": moves, "rgb_shifted": copies, "depth_shifted": copies + 1}
    seen = set()
    for seed in range(20):
        arrays = token_arrays(NORMALIZATION, True, with_copies, np.random.default_rng(seed))
        number = int(arrays["rgb"].flat[0]) // 1000
        np.testing.assert_array_equal(arrays["rgb"], record["rgb"] + 1000 * number)
        np.testing.assert_array_equal(arrays["depth"], arrays["rgb"] + 1)
        if number:
            moved = record["tracks"] + moves[number - 1]
            np.testing.assert_allclose(arrays["tracks"][arrays["visible"]], moved[arrays["visible"]], atol=1e-6)
        seen.add(number)
    assert seen == {0, 1, 2}
