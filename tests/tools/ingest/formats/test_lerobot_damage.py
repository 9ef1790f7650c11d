"""Damaged LeRobotDatasets: what is wrong is named, and the other episodes are read."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.tools.ingest.episode import EpisodeError, SourceError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import error_of, read_first
from tests.tools.ingest.formats.test_lerobot import FPS, KEY, V2_PATHS, rows, write_info, write_v2, write_v3


def rewrite(path: Path, column: str, values: Any) -> None:
    table = pq.read_table(path, partitioning=None)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("frame_index", [0, 1, 2, 4, 3, 5, 6, 7, 8], "frame_index of row 3 is 4, should be 3"),
        ("episode_index", [0] * 9, "episode_index of row 0 is 0, should be 1"),
        ("frame_index", [0.0] * 9, "has no column 'frame_index' of whole numbers"),
        ("task_index", [5] * 9, "task_index 5 is not among the data set's tasks"),
        ("timestamp", [0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.7, 0.8, 0.9], "timestamp of row 5 comes 0.2000 s after"),
        ("timestamp", [0.8 - 0.1 * row for row in range(9)], "timestamp of row 1 comes -0.1000 s after"),
        ("timestamp", [0.1 * row + 0.05 for row in range(9)], "no frame at 0.0500 s, row 0 of the table"),
        ("action", [[1.0, 2.0]] * 8 + [[1.0]], r"column 'action' \(list<.*>\) is not rows of as many numbers"),
        ("action", ["left"] * 9, "is not rows of as many numbers"),
        ("action", [[1.0, float("nan")]] * 9, "actions of frame 1 is not finite"),
    ],
)
def test_a_wrong_column_is_named(tmp_path: Path, column: str, values: Any, message: str) -> None:
    root = write_v2(tmp_path)
    rewrite(root / "data/chunk-000/episode_000001.parquet", column, values)
    error = error_of("lerobot", root, 1)
    assert error.startswith(str(root))
    assert re.search(message, error), error


def test_shared_files_are_checked_against_the_ranges(tmp_path: Path) -> None:
    root = write_v3(tmp_path)
    meta = root / "meta/episodes/chunk-000/file-000.parquet"
    rewrite(root / "data/chunk-000/file-000.parquet", "index", [*range(12), *range(13, 16)])
    assert "index of row 6 is 13, should be 12" in error_of("lerobot", root, 1)
    rewrite(root / "data/chunk-000/file-000.parquet", "index", list(range(15)))
    rewrite(meta, "length", [6, 8, 5])
    assert "9 rows of episode 1, metadata say 8" in error_of("lerobot", root, 1)
    rewrite(meta, "length", [6, 9, 5])
    rewrite(meta, f"videos/{KEY}/from_timestamp", [0.0, 0.6002, 0.0])
    assert "no frame at 0.6002 s, row 0 of the table: the nearest is 0.0002 s away, 0.0001 s" in error_of(
        "lerobot", root, 1
    )


@pytest.mark.parametrize(
    "name", ["data/chunk-000/episode_000001.parquet", f"videos/chunk-000/{KEY}/episode_000001.mp4"]
)
def test_missing_and_truncated_files_are_named(tmp_path: Path, name: str) -> None:
    root = write_v2(tmp_path)
    payload = (root / name).read_bytes()
    (root / name).write_bytes(payload[: len(payload) // 2])
    assert error_of("lerobot", root, 1).startswith(f"{root / name}: ")
    (root / name).unlink()
    assert error_of("lerobot", root, 1).startswith(f"{root / name}: missing")


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


def test_episodes_that_the_metadata_lack_are_reported(tmp_path: Path) -> None:
    root = write_v2(tmp_path)
    lines = (root / "meta/episodes.jsonl").read_text().splitlines(keepends=True)
    (root / "meta/episodes.jsonl").write_text("".join(lines[:2]))
    source = open_source("lerobot", root)
    *good, bad = source.episodes()
    assert len(good) == 2
    with pytest.raises(EpisodeError, match=r"info.json: total_episodes is 3, meta lists only 2"):
        source.read(bad)


def test_a_damaged_file_of_metadata_leaves_the_others(tmp_path: Path) -> None:
    root = write_v3(tmp_path)
    (root / "meta/episodes/chunk-000/file-001.parquet").write_bytes(b"PAR1 and no more")
    source = open_source("lerobot", root)
    *good, bad = source.episodes()
    assert [source.read(ref).id for ref in good] == [f"episode_{number:06d}" for number in range(3)]
    with pytest.raises(EpisodeError, match=r"file-001.parquet: cannot be read"):
        source.read(bad)


def test_late_times_are_as_exact_as_float32_is(tmp_path: Path) -> None:
    root = write_v2(tmp_path)
    late = pa.array(np.float32(5000) + np.arange(9, dtype=np.float32) / FPS, pa.float32())
    rewrite(root / "data/chunk-000/episode_000001.parquet", "timestamp", late)
    assert "no frame at 5000.0000 s, row 0" in error_of("lerobot", root, 1)  # not: unevenly spaced


def test_a_table_without_encoded_pictures_is_reported(tmp_path: Path) -> None:
    root = write_v2(tmp_path)
    write_info(root, "v2.0", V2_PATHS, features={"action": {"dtype": "float32"}, "picture": {"dtype": "image"}})
    path = root / "data/chunk-000/episode_000001.parquet"
    for cells in (["top.png"] * 9, [{"bytes": None, "path": "top.png"}] * 9):
        pq.write_table(pa.table(rows(1, 6) | {"picture": cells}), path)
        source = open_source("lerobot", root)
        frames = source.read(list(source.episodes())[1]).cameras["picture"]
        with pytest.raises(EpisodeError, match=r"000001.parquet: picture of row 2: has no encoded picture"):
            frames.read([2])


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ("../../{episode_index}.parquet", "is not inside"),
        ("/etc/passwd", "is not inside"),
        ("{episode_index:099999999d}", "field 'episode_index' with '099999999d'"),
        ("{password}", "field 'password'"),
        ("{episode_index", "path template"),
    ],
)
def test_paths_lead_nowhere_else(tmp_path: Path, template: str, message: str) -> None:
    write_info(write_v2(tmp_path), "v2.1", V2_PATHS | {"data_path": template})
    source = open_source("lerobot", tmp_path)
    for ref in source.episodes():
        with pytest.raises(EpisodeError, match=message):
            source.read(ref)


def test_an_unreadable_data_set_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"meta/info.json: missing; .*or give the folder that has meta/"):
        open_source("lerobot", tmp_path)
    write_info(write_v2(tmp_path), "v1.6", V2_PATHS)
    with pytest.raises(SourceError, match=r"info.json: codebase_version v1.6; v2.0, v2.1 and v3.0 can be read"):
        open_source("lerobot", tmp_path)
    write_info(tmp_path, "v2.1", V2_PATHS, fps=0)
    with pytest.raises(SourceError, match="fps 0"):
        open_source("lerobot", tmp_path)
    write_info(tmp_path, "v2.1", V2_PATHS, fps=1e5)
    with pytest.raises(SourceError, match="fps 100000"):
        open_source("lerobot", tmp_path)
    write_info(tmp_path, "v2.1", V2_PATHS)
    with pytest.raises(SourceError, match="no column 'actions'; choose among action, observation.state"):
        open_source("lerobot", tmp_path, action="actions")
    with pytest.raises(SourceError, match="no option 'acton'; did you mean 'action'"):
        open_source("lerobot", tmp_path, acton="action")
    (tmp_path / "meta/tasks.jsonl").write_text("[]\n")
    with pytest.raises(SourceError, match="table of tasks is damaged"):
        open_source("lerobot", tmp_path)


def test_dimensions_that_actions_do_not_have_are_reported(tmp_path: Path) -> None:
    write_v2(tmp_path)
    with pytest.raises(EpisodeError, match="parquet: held names dimension 99, but actions have"):
        read_first("lerobot", tmp_path, held=[99])


def test_a_pipe_in_place_of_a_video_is_reported_and_not_waited_for(tmp_path: Path) -> None:
    write_v2(tmp_path)
    video = next(tmp_path.rglob("episode_000001.mp4"))
    video.unlink()
    os.mkfifo(video)
    assert "a pipe or device, not a file" in error_of("lerobot", tmp_path, 1)
