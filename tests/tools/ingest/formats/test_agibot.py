import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from rsjax.tools.ingest.actions import ActionLayout
from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.videos import numbers_of, write_video

COUNT = 8
TASK = "327"
EPISODE = "648642"
Edit = Callable[[dict[str, Any]], None]


def turning(count: int, start: float = 0.0) -> np.ndarray:
    """Quaternions of a hand that turns about z, for both arms, (count, 2, 4)."""
    half = start + 0.2 * np.arange(count)
    one = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], 1)
    return np.stack([one, one], 1)


def arrays() -> dict[str, Any]:
    """State t is t in every position, command t is t + 0.5; the grippers close at frame 4."""
    steps = np.arange(COUNT, dtype=np.float64)
    made: dict[str, Any] = {"timestamp": np.arange(COUNT, dtype=np.uint64) * 33_333_333 + 10**18}
    for name, shift in (("state", 0.0), ("action", 0.5)):
        made |= {
            f"{name}/end/position": np.tile((steps + shift)[:, None, None], (1, 2, 3)),
            f"{name}/end/orientation": turning(COUNT, shift * 0.2),
            f"{name}/joint/position": np.tile((steps + shift)[:, None], (1, 14)),
            f"{name}/head/position": np.zeros((COUNT, 2)),
            f"{name}/waist/position": np.zeros((COUNT, 2)),
        }
    grip = (steps >= 4).astype(float)
    made["state/effector/position"] = np.stack([80 - 80 * grip] * 2, 1)
    made["action/effector/position"] = np.stack([grip] * 2, 1)
    for name in ("end", "joint", "effector"):
        made[f"action/{name}/index"] = np.arange(COUNT)
    return made


def info(episode: str = EPISODE) -> dict[str, Any]:
    config = [
        {"start_frame": 4, "end_frame": 99, "action_text": "place the cup", "skill": "Place"},
        {"start_frame": 0, "end_frame": 4, "action_text": "pick up the cup", "skill": "Pick"},
    ]
    entry = {"episode_id": int(episode), "task_name": "Tidy up", "init_scene_text": "a table"}
    return entry | {"label_info": {"action_config": config}}


def write_agibot(root: Path, edit: Edit = lambda made: None) -> Path:
    place = root / f"observations/{TASK}/{EPISODE}"
    for camera in ("head", "hand_left", "hand_right"):
        write_video(place / f"videos/{camera}_color.mp4", range(COUNT))
    (place / "depth").mkdir()
    for number in range(COUNT):
        cv2.imwrite(str(place / f"depth/head_depth_{number:06d}.png"), np.full((4, 6), 500 + number, np.uint16))
    edit(made := arrays())
    (root / f"proprio_stats/{TASK}/{EPISODE}").mkdir(parents=True)
    with h5py.File(root / f"proprio_stats/{TASK}/{EPISODE}/proprio_stats.h5", "w") as file:
        for name, array in made.items():
            file[name] = array
    (root / "task_info").mkdir()
    (root / f"task_info/task_{TASK}.json").write_text(json.dumps([info()]))
    return root


def test_a_whole_episode(tmp_path: Path) -> None:
    episode = read_first("agibot", write_agibot(tmp_path))
    assert (episode.id, episode.task, episode.fps) == ("327-648642", "Tidy up", 30)
    assert list(episode.cameras) == ["head", "hand_left", "hand_right"]
    assert numbers_of(episode.cameras["hand_left"].read([7, 0])) == [7, 0]
    np.testing.assert_allclose(episode.depth["head"].read([6])[0], 0.506)
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 30, atol=1e-6)
    assert episode.actions.shape == (COUNT, 16)
    assert not episode.actions[0].any()
    steps = np.arange(COUNT - 1)
    np.testing.assert_allclose(episode.actions[1:, :6], np.tile(steps[:, None] + 0.5, 6))  # sent at t, led into t + 1
    np.testing.assert_allclose(episode.actions[1:, 6:14], turning(COUNT, 0.1)[:-1].reshape(-1, 8), atol=1e-6)
    np.testing.assert_array_equal(episode.actions[1:, 14:], np.tile(steps[:, None] >= 4, 2))
    assert episode.states is not None
    assert episode.states.shape == (COUNT, 34)
    np.testing.assert_array_equal(episode.states[:, 0], np.arange(COUNT))
    np.testing.assert_array_equal(episode.states[:, 14], 80.0 * (np.arange(COUNT) < 4))
    assert [(s.start, s.end, s.text, s.skill) for s in episode.segments] == [
        (0, 4, "pick up the cup", "Pick"),
        (4, 8, "place the cup", "Place"),
    ]
    assert ActionLayout.from_json(episode.meta["actions"]) == ActionLayout("absolute", (6, 10), (14, 15))
    assert episode.meta["scene"] == "a table"
    assert not episode.meta["notes"].get("scattered")
    json.dumps(episode.meta)
    one = read_first("agibot", tmp_path, cameras=["hand_left"])
    assert (list(one.cameras), one.depth) == (["hand_left"], {})


def test_commands_that_copy_the_state_tell_how_the_arm_came_there(tmp_path: Path) -> None:
    def copy(made: dict[str, Any]) -> None:
        for name in ("end/position", "end/orientation"):
            made[f"action/{name}"] = made[f"state/{name}"]

    episode = read_first("agibot", write_agibot(tmp_path, copy))
    np.testing.assert_array_equal(episode.actions[1:, 0], np.arange(1, COUNT))
    np.testing.assert_array_equal(episode.actions[:, 14], np.arange(COUNT) > 4)  # grippers' are commands all the same
    assert not episode.actions[0].any()  # the grippers' first commands are unknown


def shorter(made: dict[str, Any]) -> None:
    """Commands at frames 1, 2 and 5 alone."""
    sent = np.array([1, 2, 5])
    for name in ("end/position", "end/orientation", "effector/position"):
        made[f"action/{name}"] = made[f"action/{name}"][sent]
        made[f"action/{name.partition('/')[0]}/index"] = sent


@pytest.mark.parametrize("index", ["own", "of the joints"])
def test_fewer_commands_than_frames_are_put_where_they_were_sent(tmp_path: Path, index: str) -> None:
    def edit(made: dict[str, Any]) -> None:
        shorter(made)
        if index == "of the joints":
            made["action/joint/index"] = made["action/end/index"]
            made["action/end/index"] = np.zeros(0)
            del made["action/effector/index"]

    episode = read_first("agibot", write_agibot(tmp_path, edit))
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 0, 1.5, 2.5, 3, 4, 5.5, 6])
    # a gripper keeps its last command, open at first; frame 5's command leads into frame 6
    np.testing.assert_array_equal(episode.actions[:, 14], [0, 0, 0, 0, 0, 0, 1, 1])
    assert episode.meta["notes"]["scattered"] == {"end/position": 3, "end/orientation": 3, "effector/position": 3}


def test_what_is_mended_is_noted(tmp_path: Path) -> None:
    def edit(made: dict[str, Any]) -> None:
        made["action/end/orientation"][3:5, 0] *= -1
        made["state/end/orientation"][2, 1] *= -1
        made["action/effector/position"] = np.zeros((0, 2))
        made["state/waist/position"] = np.zeros(0)
        del made["state/head/position"]

    root = write_agibot(tmp_path, edit)
    (root / "task_info/task_327.json").write_text("[]")
    (root / f"observations/{TASK}/{EPISODE}/depth/head_depth_000003.png").unlink()
    episode = read_first("agibot", root)
    np.testing.assert_allclose(episode.actions[1:, 6:14], turning(COUNT, 0.1)[:-1].reshape(-1, 8), atol=1e-6)
    np.testing.assert_allclose(np.asarray(episode.states)[:, 6:14], turning(COUNT).reshape(-1, 8), atol=1e-6)
    assert not episode.actions[:, 14:].any() and not np.asarray(episode.states)[:, 30:].any()
    assert (episode.task, episode.segments, episode.depth) == ("", (), {})
    notes = episode.meta["notes"]
    assert notes["flipped"] == {"action/end/orientation": 2, "state/end/orientation": 1}
    assert {*notes["empty"]} == {"state/head/position", "state/waist/position", "action/effector/position"}
    assert notes["task_info"] == "names no such episode, so it has no task"
    assert notes["depth_left_out"] == "7 depth maps for 8 frames"


def test_depth_that_is_unpacked_later_makes_another_episode(tmp_path: Path) -> None:
    root = write_agibot(tmp_path)

    def mark() -> str:
        return next(iter(open_source("agibot", root).episodes())).fingerprint

    whole = mark()
    shutil.move(root / f"observations/{TASK}/{EPISODE}/depth", tmp_path / "packed")
    without = mark()
    shutil.move(tmp_path / "packed", root / f"observations/{TASK}/{EPISODE}/depth")
    assert whole == mark() != without


def test_every_episode_is_listed_whether_or_not_it_is_whole(tmp_path: Path) -> None:
    root = write_agibot(tmp_path)
    (root / "observations/327/11").mkdir()
    entries = [info(), info("99"), info(), {"task_name": "nameless"}]
    entries[0]["label_info"] = {"action_config": [{"start_frame": 9, "end_frame": 9, "action_text": "none"}, 5]}
    (root / "task_info/task_327.json").write_text(json.dumps(entries))
    (root / "task_info/task_400.json").write_text("[{")
    source = open_source("agibot", root)
    refs = list(source.episodes())
    assert [ref.id for ref in refs] == [
        "task_327-entry_2",
        "task_327-entry_3",
        "327-11",
        "327-99",
        "327-648642",
        "task_400",
    ]
    assert source.read(refs[4]).meta["notes"]["bad_segments"] == entries[0]["label_info"]["action_config"]
    for ref in refs[:4] + refs[5:]:
        with pytest.raises(EpisodeError):
            source.read(ref)
    assert [ref.id for ref in open_source("agibot", root, tasks=[400]).episodes()] == ["task_400"]
