import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.data.store import StoreError, open_store, write_store
from rsjax.errors import UserError
from rsjax.tools.studies.report.rerun_view import TIMELINE, rerun_view
from tests.data.clips import clip, clip_store


def test_without_the_viewer_its_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"pip install 'rsjax\[rerun\]'"):
        rerun_view(clip_store(tmp_path / "a"))


def logged(file: Path) -> dict[str, list[dict[str, Any]]]:
    """What a file for the viewer holds: the rows of each entity, in order of frames."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(file)
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader.stream():
        rows.setdefault(str(chunk.entity_path), []).extend(chunk.to_record_batch().to_pylist())
    return {entity: sorted(found, key=lambda row: row.get(TIMELINE, 0)) for entity, found in rows.items()}


@pytest.mark.parametrize("unit", ["metres", "relative", None])
def test_what_a_file_holds_are_the_clips_arrays(tmp_path: Path, unit: str | None) -> None:
    pytest.importorskip("rerun")
    record = clip(3, None if unit is None else [1.5, 2.0], frames=3, size=16)
    record["provenance"]["depth_unit"] = unit or ""
    record["visible"][1, 2] = False
    write_store(tmp_path / "a", "clips", {"train": iter([record])}, {"key": "a"})
    assert rerun_view(open_store(tmp_path / "a"), 4, tmp_path / "a.rrd") == []
    rows = logged(tmp_path / "a.rrd")
    names = {"task", "camera", "camera/tracks", "actions"} | ({"depth"} if unit else set())
    assert {entity for entity in rows if not entity.startswith("/__")} == {f"/clip_000/{name}" for name in names}
    for frame, (picture, tracks, actions) in enumerate(
        zip(rows["/clip_000/camera"], rows["/clip_000/camera/tracks"], rows["/clip_000/actions"], strict=True)
    ):
        assert picture[TIMELINE] == tracks[TIMELINE] == actions[TIMELINE] == frame
        assert bytes(picture["Image:buffer"][0]) == record["rgb"][frame].tobytes()
        seen = np.flatnonzero(record["visible"][:, frame])
        assert tracks["Points2D:keypoint_ids"] == seen.tolist()
        np.testing.assert_allclose(tracks["Points2D:positions"], 16 * record["tracks"][seen, frame], rtol=1e-5)
        np.testing.assert_allclose(actions["Scalars:scalars"], record["actions"][frame], rtol=1e-6)
        if unit:
            depth = rows["/clip_000/depth"][frame]
            assert bytes(depth["DepthImage:buffer"][0]) == record["depth"][frame].tobytes()
            assert (depth.get("DepthImage:meter") == [1.0]) == (unit == "metres")
    assert rows["/clip_000/task"][0]["TextDocument:text"] == ["task 0"]


def test_clips_are_spread_over_the_store_and_damaged_ones_reported(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    store = clip_store(tmp_path / "a", size=32)
    shard = tmp_path / "a" / "test-00000.array_record"
    payload = bytearray(shard.read_bytes())
    payload[len(payload) // 2 :] = bytes(len(payload) - len(payload) // 2)
    shard.write_bytes(payload)
    (message,) = rerun_view(store, 2, tmp_path / "a.rrd")
    assert "test-00000" in message
    assert {entity.split("/")[1] for entity in logged(tmp_path / "a.rrd") if "clip_" in entity} == {"clip_000"}


def test_a_store_without_pictures_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with pytest.raises(StoreError, match="no clip can be read"):
        rerun_view(clip_store(tmp_path / "a"), 0, tmp_path / "a.rrd")
    record = clip(0, None)
    record["rgb"] = record["rgb"][..., 0]
    write_store(tmp_path / "b", "tokens", {"train": iter([record])}, {"key": "b"})
    with pytest.raises(StoreError, match="holds tokens"):
        rerun_view(open_store(tmp_path / "b"), 1, tmp_path / "b.rrd")


def test_a_place_that_cannot_be_written_and_a_viewer_that_is_not_there_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rerun = pytest.importorskip("rerun")
    store = clip_store(tmp_path / "a")
    with pytest.raises(UserError, match=r"none/a.rrd: cannot be written"):
        rerun_view(store, 1, tmp_path / "none" / "a.rrd")

    def fails(self: Any) -> None:
        assert str(Path(sys.executable).parent) in os.environ["PATH"].split(os.pathsep)
        raise RuntimeError("Failed to find Rerun Viewer executable in PATH.")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", fails)
    monkeypatch.setenv("PATH", "/bin")
    with pytest.raises(UserError, match="does not answer .*--rerun-file"):
        rerun_view(store, 1)
    assert os.environ["PATH"] == "/bin"
