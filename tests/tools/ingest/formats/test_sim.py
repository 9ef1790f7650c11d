from pathlib import Path

import numpy as np
import pytest

from rsjax.data.store import Record, write_store
from rsjax.tools.ingest.episode import EpisodeError, SourceError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_first

FRAMES = 4


def clip(number: int = 0, **changes: object) -> Record:
    """Frame t is ``number + t``; action t, of two control steps of 7 dimensions, is t."""
    steps = np.arange(FRAMES, dtype=np.float32)
    return {
        "rgb": np.broadcast_to((number + steps).astype(np.uint8)[:, None, None, None], (FRAMES, 5, 5, 3)).copy(),
        "depth": np.broadcast_to(1 + steps[:, None, None], (FRAMES, 5, 5)).copy(),
        "actions": np.repeat(steps, 14).reshape(FRAMES, 14),
        "success": steps > 2,
        "task": "lift the cube",
        "provenance": {"camera": "agentview", "control_hz": 20},
    } | changes


def write(path: Path, *clips: Record) -> Path:
    write_store(path, "clips", {"train": clips[:1], "test": clips[1:]}, {"key": "k", "config": {"control_steps": 2}})
    return path


def test_a_clip_is_an_episode_as_it_is(tmp_path: Path) -> None:
    source = open_source("sim", write(tmp_path / "store", clip(), clip(100), clip(50)))
    refs = list(source.episodes())
    assert [ref.id for ref in refs] == ["train-000000", "test-000000", "test-000001"]
    assert len({ref.fingerprint for ref in refs}) == 3
    episode = source.read(refs[2])
    assert episode.cameras["agentview"].read([3, 0])[:, 1, 1, 2].tolist() == [53, 50]
    assert episode.depth["agentview"].read([2])[0, 0, 0] == 3.0
    np.testing.assert_array_equal(episode.actions[:, 13], [0, 1, 2, 3])
    assert (episode.fps, episode.task, episode.meta["success"]) == (10.0, "lift the cube", [False, False, False, True])
    assert episode.meta["clip"]["record"] == 1 and episode.meta["actions"]["held"] == [6, 13]


def test_a_clip_cut_from_a_recording_keeps_its_times(tmp_path: Path) -> None:
    cut = {"camera": "front", "fps": 30.0, "frames": [30, 45, 60, 75], "depth_unit": "relative"}
    episode = read_first("sim", write(tmp_path / "store", clip(provenance=cut)))
    assert episode.fps == pytest.approx(2.0) and episode.depth == {}
    np.testing.assert_allclose(episode.timestamps, [0, 0.5, 1, 1.5])
    assert episode.meta["actions"]["kind"] == "undeclared"  # only a simulator's own are known
    declared = read_first("sim", tmp_path / "store", kind="delta", held=[6]).meta["actions"]
    assert (declared["kind"], declared["held"]) == ("delta", [6])
    uneven = cut | {"frames": [30, 45, 60, 65], "times": [1.0, 1.5, 2.0, 2.5]}
    episode = read_first("sim", write(tmp_path / "uneven", clip(provenance=uneven)))
    np.testing.assert_allclose(episode.timestamps, [0, 0.5, 1, 1.5])


def test_a_clip_without_depth_has_none(tmp_path: Path) -> None:
    assert read_first("sim", write(tmp_path / "store", clip(depth=None))).depth == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": np.zeros((4, 5, 5, 3), np.float32)}, "rgb is float32"),
        ({"actions": np.zeros((3, 14), np.float32)}, "camera agentview|actions has 3 rows, timestamps 4"),
        ({"actions": np.full((4, 14), np.nan, np.float32)}, "actions of frame 0 is not finite"),
        ({"depth": np.zeros((4, 5), np.float32)}, "depth is float32"),
        ({"tracks": np.full((3, 4, 2), np.nan, np.float32)}, "tracks are not all finite"),
        ({"rgb": np.zeros((4, 5, 5, 1), np.uint8)}, "rgb has the shape"),
        ({"provenance": {"control_hz": "often"}}, "provenance or settings are wrong"),
        ({"provenance": [1]}, "provenance or settings are wrong"),
    ],
)
def test_a_clip_with_other_arrays_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(EpisodeError, match=f"train-00000.array_record: train record 0.*({message})"):
        read_first("sim", write(tmp_path / "store", clip(**change)))


def test_what_is_no_store_of_clips_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no store"):
        open_source("sim", tmp_path)
    write_store(tmp_path / "tokens", "tokens", {"train": [{"x": 1}]}, {})
    with pytest.raises(SourceError, match="a store of tokens"):
        open_source("sim", tmp_path / "tokens")
    with pytest.raises(SourceError, match="no split 'tset'; did you mean 'test'"):
        open_source("sim", write(tmp_path / "store", clip(), clip()), split="tset")
