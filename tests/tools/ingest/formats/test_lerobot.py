import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_all, read_first
from tests.tools.ingest.formats.videos import numbers_of, picture, write_video

LENGTHS = (6, 9, 5)
FPS = 10
KEY = "observation.images.top"
TASKS = ("pick", "place")
V2_PATHS = {
    "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
}
V3_PATHS = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}


def write_info(root: Path, version: str, paths: dict[str, str], **more: Any) -> None:
    features = {
        "action": {"dtype": "float32", "shape": [2], "names": ["x", "grip"]},
        "observation.state": {"dtype": "float32", "shape": [3], "names": None},
        KEY: {"dtype": "video", "shape": [32, 32, 3], "names": ["height", "width", "channels"]},
        "observation.images.top_depth": {"dtype": "video", "info": {"video.is_depth_map": True}},
    }
    info = {"codebase_version": version, "fps": FPS, "chunks_size": 2, "features": features}
    info |= {"total_episodes": len(LENGTHS)} | paths | more
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/info.json").write_text(json.dumps(info))


def rows(episode: int, first: int) -> dict[str, Any]:
    """Row t of an episode: action (t, episode), state t + 0.5, picture first + t. The last episode changes its task."""
    count = LENGTHS[episode]
    steps = np.arange(count, dtype=np.float32)
    return {
        "action": np.stack([steps, np.full(count, episode, np.float32)], 1).tolist(),
        "observation.state": np.repeat(steps[:, None] + 0.5, 3, 1).tolist(),
        "timestamp": pa.array(steps / FPS, pa.float32()),
        "frame_index": list(range(count)),
        "episode_index": [episode] * count,
        "index": list(range(first, first + count)),
        "task_index": [0] * count if episode < 2 else [0, 0, 1, 1, 1],
    }


def write_v2(root: Path) -> Path:
    write_info(root, "v2.1", V2_PATHS)
    (root / "meta/tasks.jsonl").write_text(
        "".join(json.dumps({"task_index": i, "task": task}) + "\n" for i, task in enumerate(TASKS))
    )
    lines = []
    for episode, first in enumerate((0, 6, 15)):
        folder = f"chunk-{episode // 2:03d}"
        table = root / "data" / folder / f"episode_{episode:06d}.parquet"
        table.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(rows(episode, first)), table)
        numbers = range(first, first + LENGTHS[episode])
        write_video(root / "videos" / folder / KEY / f"episode_{episode:06d}.mp4", numbers, FPS)
        tasks = list(TASKS[: 1 if episode < 2 else 2])
        lines.append(json.dumps({"episode_index": episode, "tasks": tasks, "length": LENGTHS[episode]}))
    (root / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
    return root


def write_v3(root: Path) -> Path:
    """Episodes 0 and 1 share a table and a video, episode 2 has its own."""
    write_info(root, "v3.0", V3_PATHS)
    tables = [pa.table(rows(episode, first)) for episode, first in enumerate((0, 6, 15))]
    (root / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.concat_tables(tables[:2]), root / "data/chunk-000/file-000.parquet")
    pq.write_table(tables[2], root / "data/chunk-000/file-001.parquet")
    for file, numbers in enumerate((range(15), range(15, 20))):
        write_video(root / f"videos/{KEY}/chunk-000/file-{file:03d}.mp4", numbers, FPS)
    meta = {
        "episode_index": [0, 1, 2],
        "tasks": [["pick"], ["pick"], ["pick", "place"]],
        "length": list(LENGTHS),
        "dataset_from_index": [0, 6, 15],
        "dataset_to_index": [6, 15, 20],
        "data/chunk_index": [0, 0, 0],
        "data/file_index": [0, 0, 1],
        f"videos/{KEY}/chunk_index": [0, 0, 0],
        f"videos/{KEY}/file_index": [0, 0, 1],
        f"videos/{KEY}/from_timestamp": [0.0, 0.6, 0.0],
        f"videos/{KEY}/to_timestamp": [0.6, 1.5, 0.5],
        "stats/action/mean": [[0.0]] * 3,
    }
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(meta), root / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": list(TASKS)})
    pq.write_table(tasks, root / "meta/tasks.parquet")
    return root


def test_every_picture_action_and_state_is_where_it_belongs_in_both_versions(tmp_path: Path) -> None:
    versions = [read_all("lerobot", write(tmp_path / write.__name__)) for write in (write_v2, write_v3)]
    for number, pair in enumerate(zip(*versions, strict=True)):
        first = (0, 6, 15)[number]
        count = LENGTHS[number]
        for episode in pair:
            assert episode.id == f"episode_{number:06d}"
            assert list(episode.cameras) == ["top"]
            assert numbers_of(episode.cameras["top"].read(range(count))) == list(range(first, first + count))
            np.testing.assert_allclose(episode.timestamps, np.arange(count) / FPS, atol=1e-6)
            # the action of row t - 1 led into frame t
            np.testing.assert_array_equal(episode.actions[1:, 0], np.arange(count - 1))
            np.testing.assert_array_equal(episode.actions[1:, 1], number)
            assert not episode.actions[0].any()
            np.testing.assert_array_equal(np.asarray(episode.states)[:, 0], np.arange(count) + 0.5)
            assert (episode.fps, episode.task) == (FPS, "pick" if number < 2 else "pick; place")
            segments = [(s.start, s.end, s.text) for s in episode.segments]
            assert segments == ([] if number < 2 else [(0, 2, "pick"), (2, 5, "place")])
            assert json.loads(json.dumps(episode.meta)) == pair[0].meta


def test_rows_are_searched_where_the_metadata_are_wrong(tmp_path: Path) -> None:
    """LeRobot's converter to v3 names the first table for the first episode of the second."""
    root = write_v3(tmp_path)
    expected = read_all("lerobot", root)
    meta = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(meta)
    for column, values in (("data/file_index", [0, 0, 0]), ("dataset_from_index", [0, 5, 15])):
        table = table.set_column(table.column_names.index(column), column, pa.array(values))
    pq.write_table(table, meta)
    found = read_all("lerobot", root)
    notes = [episode.meta.get("notes") for episode in found]
    assert notes == [None, {"range": "rows 6 … 15, where the metadata say 5 … 15"}, None]
    for episode, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(episode.actions, other.actions)
        numbers = [numbers_of(each.cameras["top"].read(range(len(each.actions)))) for each in (episode, other)]
        assert numbers[0] == numbers[1]
    named = root / "data/chunk-000/file-000.parquet"
    other_name = named.rename(named.with_name("file-002.parquet"))
    assert [len(episode.actions) for episode in read_all("lerobot", root)] == list(LENGTHS)
    other_name.rename(named)
    (root / "data/chunk-000/file-001.parquet").write_bytes(b"damaged")
    source = open_source("lerobot", root)
    *_, last = source.episodes()
    with pytest.raises(EpisodeError, match="file-000.parquet: has no row of episode 2, nor has any other"):
        source.read(last)


def test_fingerprints_follow_the_content_not_the_place(tmp_path: Path) -> None:
    def prints(root: Path) -> list[str]:
        return [ref.fingerprint for ref in open_source("lerobot", root).episodes()]

    before = prints(write_v2(tmp_path / "a"))
    assert len(set(before)) == 3
    (tmp_path / "a").rename(tmp_path / "b")
    assert prints(tmp_path / "b") == before
    write_video(tmp_path / "b/videos/chunk-000" / KEY / "episode_000001.mp4", range(9), FPS)
    assert [old == new for old, new in zip(before, prints(tmp_path / "b"), strict=True)] == [True, False, True]


def test_pictures_in_the_table(tmp_path: Path) -> None:
    root = write_v2(tmp_path)
    features = {"action": {"dtype": "float32"}, "observation.image": {"dtype": "image"}}
    write_info(root, "v2.0", V2_PATHS, features=features)
    for episode, first in enumerate((0, 6, 15)):
        encoded = [
            {"bytes": cv2.imencode(".png", picture(first + row))[1].tobytes(), "path": None}
            for row in range(LENGTHS[episode])
        ]
        path = root / f"data/chunk-{episode // 2:03d}/episode_{episode:06d}.parquet"
        pq.write_table(pa.table(rows(episode, first) | {"observation.image": encoded}), path)
    assert numbers_of(read_all("lerobot", root)[1].cameras["image"].read([8, 1])) == [14, 7]
    for cells in (["top.png"] * 5, [{"bytes": None, "path": "top.png"}] * 5):
        pq.write_table(pa.table(rows(2, 15) | {"observation.image": cells}), path)
        frames = read_all("lerobot", root)[2].cameras["image"]
        with pytest.raises(EpisodeError, match=r"000002.parquet: observation.image of row 2: has no encoded picture"):
            frames.read([2])


def test_bad_entries_are_counted_not_dropped(tmp_path: Path) -> None:
    root = write_v2(tmp_path)
    with (root / "meta/episodes.jsonl").open("a") as file:
        file.write('{"episode_index": 1, "tasks": [], "length": 9}\n{"episode_index": 7}\n{"episode_ind\n')
    source = open_source("lerobot", root)
    refs = list(source.episodes())
    assert len({ref.id for ref in refs}) == len(refs) == 6
    for ref, message in zip(refs[3:], ("line 4: .*second time", "line 5: .*'length'", "line 6: .*JSON"), strict=True):
        with pytest.raises(EpisodeError, match=message):
            source.read(ref)


def test_what_actions_are_is_declared_and_not_guessed(tmp_path: Path) -> None:
    write_v2(tmp_path)
    episode = read_first("lerobot", tmp_path)
    assert episode.meta["actions"]["kind"] == "undeclared" and episode.meta["action_names"] == ["x", "grip"]
    turns = read_first("lerobot", tmp_path, kind="absolute", angles=[0]).meta["actions"]
    assert turns == {"kind": "absolute", "held": [], "quaternions": [], "angles": [0]}
    declared = read_all("lerobot", tmp_path, kind="delta")[1].meta["actions"]
    assert declared["unclear"] == ["dimension 1 (grip) is never anything but 1"]
    believed = read_first("lerobot", tmp_path, kind="delta", held=[1]).meta["actions"]
    assert believed == {"kind": "delta", "held": [1], "quaternions": []}


def test_success_reward_and_the_end_are_those_of_the_frame_that_an_action_led_to(tmp_path: Path) -> None:
    def written(name: str, **columns: list[Any]) -> Any:
        root = write_v2(tmp_path / name)
        (table,) = (root / "data").glob("*/episode_000000.parquet")
        pq.write_table(pa.table(rows(0, 0) | {f"next.{column}": pa.array(x) for column, x in columns.items()}), table)
        return read_first("lerobot", root).meta

    plain = written("plain")
    assert "success" not in plain and "reward" not in plain
    said = written("all", success=[False, False, True, False, False, True], reward=[0.5, 1, 2, 3, 4, 5])
    assert said["success"] == [False, False, False, True, False, True]
    assert said["reward"] == [0, 0.5, 1, 2, 3, 4]
    assert written("sparse", reward=[0.0, 0, 0, 0, 0, 1])["success"] == [False] * 5 + [True]
    assert "success" not in written("dense", reward=[0.1, 0.2, 0.3, 0.4, 0.5, 1])
    ended = written("done", done=[False, False, False, True, False, False])
    assert ended["notes"]["done"] == "next.done at row 3, after which 2 rows follow"
    with pytest.raises(EpisodeError) as raised:
        written("nan", reward=[0.1, float("nan"), 0.3, 0.4, 0.5, 1])
    assert "next.reward" in str(raised.value)
