from pathlib import Path

import numpy as np
import pytest

from rsjax.data.store import Record, write_store
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


def write(path: Path, *clips: Record, **more: object) -> Path:
    """Args: more: fields of the manifest."""
    meta = {"key": "k", "config": {"control_steps": 2}, "success_share": 1.0} | more
    write_store(path, "clips", {"train": clips[:1], "test": clips[1:]}, meta)
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


def test_the_store_says_what_actions_are_and_whether_success_is_known(tmp_path: Path) -> None:
    lines = ["x (absolute)", "yaw (absolute, an angle)", *["grip (held)"] * 12]
    path = write(tmp_path / "store", clip(provenance={}, depth=None), action_dimensions=lines, success_share=None)
    episode = read_first("sim", path)
    meta = episode.meta
    layout = {"kind": "absolute", "held": list(range(2, 14)), "quaternions": [], "angles": [1]}
    assert meta["actions"] == layout and "success" not in meta and episode.depth == {}
    declared = read_first("sim", path, held=[]).meta["actions"]
    assert declared == {"kind": "undeclared", "held": [], "quaternions": []}


def test_clips_of_one_episode_are_of_one_recording(tmp_path: Path) -> None:
    clips = [clip(number, provenance={"episode": name}) for number, name in enumerate(["a", "a", "b", "b"])]
    source = open_source("sim", write(tmp_path / "store", *clips, clip(provenance={})))
    recordings = [ref.location.get("recording") for ref in source.episodes()]
    assert recordings == ["train-a", "test-a", "test-b", "test-b", None]
