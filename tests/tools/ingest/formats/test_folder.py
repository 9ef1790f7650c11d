import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.tools.ingest.actions import ActionConfig, ActionLayout, sampled_actions
from rsjax.tools.ingest.episode import Episode, EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_all, read_everything, read_first
from tests.tools.ingest.formats.videos import numbers_of, picture, write_video

COUNT = 8
ACTIONS = np.stack([np.arange(COUNT), np.full(COUNT, 5.0)], 1).astype(np.float32)


def write_csv(path: Path, rows: int = COUNT) -> None:
    lines = [f"{row / 10},{row},5,{row}.5" for row in range(rows)]
    path.write_text("\n".join(["timestamp,action_x,action_grip,state_x", *lines]) + "\n")


def write_episode(root: Path, name: str = "one") -> Path:
    """Two cameras at 10 fps, pictures 0 … 7 and 20 … 27, action (t, 5) given at frame t."""
    write_video(root / name / "front.mp4", range(COUNT), 10)
    write_video(root / name / "wrist.mp4", range(20, 20 + COUNT), 10)
    write_csv(root / name / "actions.csv")
    return root / name


def test_an_episode_in_a_folder(tmp_path: Path) -> None:
    write_episode(tmp_path)
    segments = [{"start": 3, "end": 8, "text": "put"}, {"start": 0, "end": 3, "text": "take", "skill": "pick"}]
    (tmp_path / "one/episode.json").write_text(json.dumps({"task": "tidy up", "segments": segments}))
    (episode,) = read_all("folder", tmp_path, kind="absolute", held=[1], angles=[0])
    assert (episode.id, episode.task, list(episode.cameras)) == ("one", "tidy up", ["front", "wrist"])
    assert episode.fps == pytest.approx(10)
    assert numbers_of(episode.cameras["front"].read(range(COUNT))) == list(range(COUNT))
    assert numbers_of(episode.cameras["wrist"].read([7, 0])) == [27, 20]
    np.testing.assert_array_equal(episode.actions[1:], ACTIONS[:-1])  # given at t, led into t + 1
    assert not episode.actions[0].any()
    assert episode.states is not None
    np.testing.assert_array_equal(episode.states[:, 0], np.arange(COUNT) + 0.5)
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 10)
    assert [(s.start, s.end, s.text, s.skill) for s in episode.segments] == [(0, 3, "take", "pick"), (3, 8, "put", "")]
    assert episode.meta["action_names"] == ["action_x", "action_grip"]
    assert ActionLayout.from_json(episode.meta["actions"]) == ActionLayout("absolute", held=(1,), angles=(0,))


@pytest.mark.parametrize("kind", ["csv", "parquet", "npy", "one row less"])
def test_flat_episodes_with_any_table(tmp_path: Path, kind: str) -> None:
    write_video(tmp_path / "a b.mp4", range(COUNT), 10)
    columns = {"x": ACTIONS[:, 0], "grip": ACTIONS[:, 1]}
    if kind == "csv":
        lines = ["x,grip", *(f"{x},{grip}" for x, grip in ACTIONS)]
        (tmp_path / "a b.csv").write_text("\n".join(lines))
    elif kind == "parquet":
        pq.write_table(pa.table(columns), tmp_path / "a b.parquet")
    else:
        np.save(tmp_path / "a b.npy", ACTIONS[: -1 if kind == "one row less" else None])
    (tmp_path / "a b.json").write_text('{"task": "go"}')
    (episode,) = read_all("folder", tmp_path)
    np.testing.assert_array_equal(episode.actions[1:], ACTIONS[:-1])
    assert (episode.task, list(episode.cameras), episode.states) == ("go", ["main"], None)
    assert episode.id.startswith("a-b-")
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 10)


def test_rows_that_led_into_their_frame(tmp_path: Path) -> None:
    write_episode(tmp_path)
    (tmp_path / "dataset.json").write_text('{"after": true, "task": "go"}')
    (episode,) = read_all("folder", tmp_path)
    np.testing.assert_array_equal(episode.actions, ACTIONS)
    assert episode.task == "go"


def test_pictures_and_depth_maps(tmp_path: Path) -> None:
    for name in ("top", "top.depth"):
        (tmp_path / "one" / name).mkdir(parents=True)
    for number in range(12):  # 10 comes after 9 though it is written without zeros before it
        cv2.imwrite(str(tmp_path / f"one/top/{number}.png"), picture(number)[..., ::-1])
        cv2.imwrite(str(tmp_path / f"one/top.depth/{number}.png"), np.full((4, 6), 1000 + number, np.uint16))
    np.save(tmp_path / "one/actions.npy", np.zeros((12, 3)))
    (error,) = read_everything("folder", tmp_path)[1]
    assert "how fast are its pictures" in str(error)
    (episode,) = read_all("folder", tmp_path, fps=5)
    assert numbers_of(episode.cameras["top"].read([11, 2])) == [11, 2]
    depth = episode.depth["top"].read([10, 0])
    assert (depth.dtype, depth.shape) == (np.float32, (2, 4, 6))
    np.testing.assert_allclose(depth[:, 0, 0], [1.01, 1.0])


def test_links_that_lead_to_themselves(tmp_path: Path) -> None:
    write_episode(tmp_path)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    source = open_source("folder", tmp_path)
    one, loop = source.episodes()
    assert (loop.id, one.id) == ("loop", "one")
    with pytest.raises(EpisodeError, match=r"loop: cannot be listed \(Too many levels of symbolic links\)"):
        source.read(loop)


def sampled(episode: Episode, step: int) -> np.ndarray:
    layout = ActionLayout.from_json(json.loads(json.dumps(episode.meta["actions"])))
    return sampled_actions(episode.actions, np.arange(0, COUNT, step), ActionConfig(), layout)


def test_rows_of_actions_are_not_combined_before_somebody_says_what_they_are(tmp_path: Path) -> None:
    place = write_episode(tmp_path)
    lines = [f"{row / 10},{0.1 * (-1) ** row},{int(row > 1)}" for row in range(COUNT)]
    (place / "actions.csv").write_text("\n".join(["timestamp,action_x,action_switch", *lines]))
    switch = r"dimension 1 \(action_switch\) is never anything but 0 or 1"
    undeclared = read_first("folder", tmp_path)
    np.testing.assert_array_equal(sampled(undeclared, 1), undeclared.actions)  # as recorded
    with pytest.raises(EpisodeError, match=f"2 recorded rows become one.* --option kind=delta .*: {switch}") as raised:
        sampled(undeclared, 2)
    assert raised.value.option == "--option kind"
    with pytest.raises(EpisodeError, match=rf"but {switch}; .*--option 'held=\[…\]'") as raised:
        sampled(read_first("folder", tmp_path, kind="delta"), 2)
    assert raised.value.option == "--option held"
    # What is declared is believed.
    assert sampled(read_first("folder", tmp_path, kind="delta", held=[1]), 2)[:, 1].max() == 1
    assert sampled(read_first("folder", tmp_path, kind="delta", held=[]), 2)[:, 1].max() == 2
    assert sampled(read_first("folder", tmp_path, kind="absolute"), 2)[:, 1].max() == 1


def test_columns_that_count_rows_or_time_are_no_actions_unless_asked_for(tmp_path: Path) -> None:
    place = write_episode(tmp_path)
    names = ["", "Unnamed: 0", "time", "Frame", "index", "frame_index", "episode_id", "t", "x", "frameless"]
    lines = [",".join(str(row) for _ in names) for row in range(COUNT)]
    (place / "actions.csv").write_text("\n".join([",".join(names), *lines]))
    episode = read_first("folder", tmp_path, fps=10)
    assert episode.meta["action_names"] == ["x", "frameless"]
    assert episode.meta["notes"] == {"not_taken_for_actions": names[:-2]}
    assert read_first("folder", tmp_path, fps=10, action=["x", "time"]).meta["action_names"] == ["x", "time"]


def test_cameras_that_drift_apart_are_reported(tmp_path: Path) -> None:
    for name, fps in (("front", 10), ("wrist", 5)):
        write_video(tmp_path / f"one/{name}.mp4", range(COUNT), fps)
    np.save(tmp_path / "one/actions.npy", ACTIONS)
    (error,) = read_everything("folder", tmp_path)[1]
    assert "wrist: its frame 7 is shown 0.7 s away from that of front; give" in str(error)
    (episode,) = read_all("folder", tmp_path, fps=10)
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 10)


def test_times_that_count_from_1970(tmp_path: Path) -> None:
    place = write_episode(tmp_path)
    lines = ["timestamp,x", *(f"{1.7e9 + row / 10:.3f},{row}" for row in range(COUNT))]
    (place / "actions.csv").write_text("\n".join(lines))
    (episode,) = read_all("folder", tmp_path)
    assert episode.fps == pytest.approx(10, rel=1e-3)
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 10, atol=1e-4)
