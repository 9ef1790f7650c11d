import contextlib
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.bridge import BRIDGE, needs_bridge
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.toy_tfrecord import bridge_episode, step, write_bridge, write_records


def test_an_action_stands_with_the_frame_that_it_led_into(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    source = open_source("rlds", tmp_path)
    (ref,) = source.episodes()
    episode = source.read(ref)
    pictures = episode.cameras["image_0"].read([0, 3, 3])
    assert pictures.dtype == np.uint8 and pictures[:, 4, 4, 1].tolist() == [step(0), step(3), step(3)]
    # Action t of the file is t + 1 and leads from frame t into frame t + 1; the last leads nowhere.
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(np.asarray(episode.states)[:, 6], [0, 10, 20, 30, 40])
    np.testing.assert_allclose(episode.timestamps, np.arange(5) / 5)
    assert (episode.task, episode.fps, episode.segments) == ("put it down", 5.0, ())
    assert episode.meta["episode"] == {"episode_id": 3}
    # the other cameras are placeholders
    assert list(episode.cameras) == ["image_0"] and episode.meta["blank"] == ["image_1", "image_2", "image_3"]


def test_references_and_sources_travel(tmp_path: Path) -> None:
    write_bridge(tmp_path / "1.0.0", [bridge_episode(), bridge_episode(4)])
    source = pickle.loads(pickle.dumps(open_source("rlds", tmp_path)))
    refs = list(source.episodes())
    assert [json.loads(json.dumps(ref.location)) for ref in refs] == [ref.location for ref in refs]
    assert [len(source.read(ref).timestamps) for ref in refs] == [5, 4]
    assert len({ref.fingerprint for ref in refs}) == len({ref.id for ref in refs}) == 2
    (tmp_path / "1.0.0").rename(tmp_path / "moved")
    assert [ref.fingerprint for ref in open_source("rlds", tmp_path).episodes()] == [ref.fingerprint for ref in refs]


def test_text_that_changes_on_the_way_makes_segments(tmp_path: Path) -> None:
    texts = [b"reach", b"reach", b"", b"lift", b"lift"]
    write_bridge(tmp_path, [bridge_episode(5, changes={"steps/language_instruction": texts})])
    segments = read_first("rlds", tmp_path).segments
    assert [(part.start, part.end, part.text) for part in segments] == [(0, 2, "reach"), (3, 5, "lift")]


def test_text_as_numbers_is_read(tmp_path: Path) -> None:
    codes = [*b"go", 0, 0] * 5
    write_bridge(tmp_path, [bridge_episode(5, changes={"steps/language_instruction": codes})])
    assert read_first("rlds", tmp_path).task == "go"


def test_one_shard_of_several_is_read_alone(tmp_path: Path) -> None:
    shard = write_records(tmp_path / "kitchen-train.tfrecord-00002-of-00004", [bridge_episode()])
    assert len(list(open_source("rlds", shard, keys="bridge").episodes())) == 1


def test_a_shard_that_cannot_be_opened_leaves_the_others(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    gone = write_records(tmp_path / "bridge_dataset-test.tfrecord-00000-of-00001", [bridge_episode()])
    source = open_source("rlds", tmp_path)
    gone.unlink()
    bad, good = source.episodes()
    assert len(source.read(good).timestamps) == 5
    with pytest.raises(EpisodeError, match="bridge_dataset-test.*missing"):
        source.read(bad)


@settings(max_examples=40)
@given(st.data())
def test_damage_that_no_checksum_shows_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    payload = bytearray(bridge_episode(3))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    write_bridge(folder, [bytes(payload)])
    source = open_source("rlds", folder)
    with contextlib.suppress(EpisodeError):
        episode = source.read(next(source.episodes()))
        for frames in episode.cameras.values():
            frames.read(range(len(frames)))


def test_a_path_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    source = open_source("rlds", tmp_path)
    ref = next(source.episodes())
    ref.location["file"] = "../../etc/passwd"
    with pytest.raises(EpisodeError, match="which is not inside"):
        source.read(ref)


@needs_bridge
def test_the_bundled_bridge_episodes() -> None:
    source = open_source("rlds", BRIDGE)
    episodes = [source.read(ref) for ref in source.episodes()]
    assert len(episodes) == 25 and {len(episode.timestamps) for episode in episodes} == {10}
    assert all(episode.task for episode in episodes) and len({episode.task for episode in episodes}) == 4
    missed = []
    for episode in episodes:
        # Three of the four cameras hold pictures, the fourth a black placeholder.
        assert list(episode.cameras) == ["image_0", "image_1", "image_2"] and episode.meta["blank"] == ["image_3"]
        assert all(frames.read(range(10)).shape == (10, 64, 64, 3) for frames in episode.cameras.values())
        assert episode.actions.shape == (10, 7) and episode.actions[:, :6].any()
        moved = np.diff(np.asarray(episode.states)[:, :3], axis=0)[1:-1]
        rows = episode.actions[:, :3]
        missed.append([np.abs(moved - others).mean() for others in (rows[1:-2], rows[2:-1], rows[3:])])
    before, own, after = np.mean(missed, axis=0)
    assert own < 0.6 * after and own < before  # row t is what moved the arm into frame t; the arm lags a little
