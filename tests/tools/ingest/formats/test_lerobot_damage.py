"""Damaged LeRobotDatasets: what is wrong is named, and the other episodes are read."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.test_lerobot import V2_PATHS, rows, write_info, write_v2


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
