"""A store exported as a LeRobotDataset, read back by our own reader of that format and by pandas."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rsjax
from rsjax.clip import GENERATED, GENERATED_MARK
from rsjax.data.merge import merge
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.tools.export import lerobot_files
from rsjax.tools.export.lerobot import LeRobotOptions, export_lerobot, openpi_advice, padding
from rsjax.tools.export.lerobot_files import OUTCOME
from rsjax.tools.ingest.formats import open_source
from rsjax.tools.ingest.formats.lerobot import PROVENANCE
from rsjax.tools.ingest.ingest import ingest
from rsjax.tools.ingest.options import IngestOptions, make_plan
from rsjax.tools.ingest.windows import WindowConfig
from tests.tools.ingest.formats.reading import read_all

TASKS = ("pick", "place the lid", "pick")
SUCCESS = np.array([False, False, True, False, True, True])
VERSIONS = ("v3.0", "v2.1")


def toy_store(path: Path, count: int = 5, frames: int = 6, size: int = 32, width: int = 3, **fields: Any) -> Store:
    """Clips whose pictures are smooth and differ in each frame, so that a codec changes them little."""
    rng = np.random.default_rng(count)

    def clips() -> Any:
        for number in range(count):
            ramp = np.linspace(0, 120, size)[:, None, None] + 10 * number + 5 * np.arange(frames)[:, None, None, None]
            rgb = np.broadcast_to(ramp + np.array([0, 20, 40]), (frames, size, size, 3)).astype(np.uint8)
            actions = rng.normal(size=(frames, width)).astype(np.float32)
            actions[0] = 0
            yield {"rgb": rgb, "actions": actions, "task": TASKS[number % 3], "fps": 5.0} | fields

    return rsjax.write_store(path, clips(), test_share=0.2)


def records(store: Store, split: str = "train") -> list[Any]:
    source = store.source(split)
    return [source[number] for number in range(len(source))]


def assert_near(one: np.ndarray, other: np.ndarray) -> None:
    """Pictures are equal but for what a codec loses."""
    assert np.abs(one.astype(int) - other).mean() < 3


@dataclass(frozen=True)
class Export:
    """An export of all clips of a store, which a model has generated and whose success is known."""

    clips: list[Any]
    folder: Path
    info: dict[str, Any]


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Export]:
    """An export in each version, with the default codec in one."""
    folder = tmp_path_factory.mktemp("exports")
    store = toy_store(folder / "store", success=SUCCESS, provenance={"source": GENERATED})
    clips = records(store) + records(store, "test")
    made: dict[str, Export] = {}
    for options in (LeRobotOptions("v3.0", "all", crf=1), LeRobotOptions("v2.1", "all", codec="h264", crf=1)):
        out = folder / options.version
        made[options.version] = Export(clips, out, export_lerobot(store, out, options))
    return made


def ingest_options(out: Path, windows: WindowConfig, **changes: Any) -> IngestOptions:
    """Options of an ingest that estimates nothing and finds no cuts."""
    off = dict.fromkeys(("shots", "motion", "depth", "tracks", "semantics"), "none")
    return IngestOptions(out=out, windows=windows, image_size=32, **{"test_share": 0.0, **off, **changes})


@settings(max_examples=5)
@given(
    st.sampled_from(VERSIONS),
    st.integers(2, 4),
    st.integers(2, 7),
    st.sampled_from([16, 18, 48]),
    st.sampled_from([1, 3]),
    st.sampled_from([2.0, 5.0, 12.5, 30.0]),
    st.sampled_from(["zeros", "command", "none"]),
)
def test_what_is_exported_is_read_back(
    tmp_path_factory: Any, version: Any, count: int, frames: int, size: int, width: int, fps: float, state: Any
) -> None:
    folder = tmp_path_factory.mktemp("lerobot")
    store = toy_store(folder / "store", count, frames, size, width, fps=fps)
    export_lerobot(store, folder / "out", LeRobotOptions(version, state=state, codec="h264", crf=1))
    clips = records(store)
    episodes = read_all("lerobot", folder / "out")
    assert len(clips) == len(episodes)
    for clip, episode in zip(clips, episodes, strict=True):
        np.testing.assert_array_equal(episode.actions, clip["actions"])
        assert_near(episode.cameras["image"].read(range(frames)), clip["rgb"])
        assert (episode.task, episode.fps) == (clip["task"], fps)
        states = {"zeros": np.zeros((frames, 2), np.float32), "command": clip["actions"], "none": None}[state]
        np.testing.assert_array_equal(episode.states, states) if state != "none" else None
        assert (episode.states is None) == (state == "none")


@pytest.mark.parametrize("version", VERSIONS)
def test_ingested_again_the_clips_are_the_same(exports: dict[str, Export], tmp_path: Path, version: Any) -> None:
    made = exports[version]
    options = ingest_options(tmp_path / "again", WindowConfig(frames=6, rate=0, hop=6))
    ingest(make_plan("lerobot", made.folder, options))
    again = rsjax.open_store(tmp_path / "again")
    for old, new in zip(made.clips, records(again), strict=True):
        np.testing.assert_array_equal(new["actions"], old["actions"])
        np.testing.assert_array_equal(new["success"], old["success"])
        assert_near(new["rgb"], old["rgb"])
        assert new["task"] == old["task"]
        assert new["provenance"]["source"] == GENERATED
        assert new["provenance"]["reward"] == SUCCESS.astype(float).tolist()
    export_lerobot(again, tmp_path / "once more", LeRobotOptions(version, codec="h264"))
    marks = [json.loads((folder / "meta" / PROVENANCE).read_text()) for folder in (made.folder, tmp_path / "once more")]
    assert marks[0] == marks[1]
    assert marks[0]["generated_episodes"] == list(range(made.info["total_episodes"]))
    assert marks[0]["note"] == GENERATED_MARK


@pytest.mark.parametrize("version", VERSIONS)
def test_rows_have_the_types_that_lerobot_casts_to_and_say_what_their_action_led_to(
    exports: dict[str, Export], version: str
) -> None:
    """Lists of the feature's length, and scalars where its shape is [1]."""
    features = exports[version].info["features"]
    table = pq.read_table(next(exports[version].folder.glob("data/*/*.parquet")))
    for name in table.schema.names:
        shape = features[name]["shape"]
        kind = table.schema.field(name).type
        assert pa.types.is_fixed_size_list(kind) == (shape != [1])
        assert shape == [1] or shape == [kind.list_size]
    assert features["action"]["shape"] == [3]
    assert features["observation.state"]["shape"] == [2]
    assert {str(table.schema.field(name).type) for name in ("frame_index", "index", "task_index")} == {"int64"}
    assert {name: features[name]["dtype"] for name in OUTCOME} == OUTCOME
    rows = {name: table[name].to_pylist()[:6] for name in OUTCOME}
    assert rows["next.success"] == [False, True, False, True, True, True]
    assert rows["next.reward"] == [0.0, 1.0, 0.0, 1.0, 1.0, 1.0]
    assert rows["next.done"] == [False] * 5 + [True]


def test_statistics_are_those_of_all_rows(exports: dict[str, Export]) -> None:
    made = exports["v3.0"]
    actions = np.concatenate([np.concatenate([clip["actions"][1:], clip["actions"][-1:]]) for clip in made.clips])
    pixels = np.concatenate([clip["rgb"].reshape(-1, 3) for clip in made.clips]) / 255
    stats = json.loads((made.folder / "meta/stats.json").read_text())
    for rows, own in ((actions, stats["action"]), (pixels, stats["observation.images.image"])):
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(np.ravel(own[name]), getattr(rows, name)(0), rtol=1e-5, atol=1e-6)
        assert own["count"] == [len(actions)]
        rising = [np.ravel(own[name]) for name in ("min", "q01", "q10", "q50", "q90", "q99", "max")]
        assert (np.diff(rising, axis=0) >= 0).all()
    assert np.shape(stats["observation.images.image"]["mean"]) == (3, 1, 1)
    assert made.info["splits"] == {"train": "0:4", "test": "4:5"} and made.info["total_frames"] == 30
    assert set(stats) == set(made.info["features"])


def test_v21_has_a_line_for_each_episode(exports: dict[str, Export]) -> None:
    made = exports["v2.1"]
    lines = {
        name: [json.loads(line) for line in (made.folder / f"meta/{name}.jsonl").read_text().splitlines()]
        for name in ("tasks", "episodes", "episodes_stats")
    }
    assert [row["length"] for row in lines["episodes"]] == [6] * 5
    assert [row["task_index"] for row in lines["tasks"]] == list(range(made.info["total_tasks"]))
    assert all(set(row["stats"]) == set(made.info["features"]) for row in lines["episodes_stats"])
    for each in lines["episodes_stats"][0]["stats"].values():
        assert set(each) == {"min", "max", "mean", "std", "count"}
    assert (made.info["total_videos"], made.info["total_chunks"]) == (5, 1)


def test_pandas_finds_the_tasks_by_their_text(exports: dict[str, Export]) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is in requirements-extras.txt (make extras)")
    frame = pandas.read_parquet(exports["v3.0"].folder / "meta/tasks.parquet")
    for number, task in enumerate(frame.index):
        assert frame.loc[task].task_index == number and task in TASKS


def test_a_damaged_list_of_generated_episodes_is_named(exports: dict[str, Export], tmp_path: Path) -> None:
    shutil.copytree(exports["v2.1"].folder, tmp_path / "out")
    path = tmp_path / "out" / "meta" / PROVENANCE
    for text in ("", "[]", "{}", '{"generated_episodes": ["x"]}', '{"generated_episodes": 3}'):
        path.write_text(text)
        with pytest.raises(UserError) as caught:
            open_source("lerobot", tmp_path / "out")
        assert str(path) in str(caught.value)


def test_what_actions_are_and_which_clips_are_of_one_recording_is_kept(tmp_path: Path) -> None:
    windows = WindowConfig(frames=3, rate=0, hop=1)
    first = ingest_options(tmp_path / "clips", windows)
    export_lerobot(toy_store(tmp_path / "store", 8), tmp_path / "recorded", LeRobotOptions(codec="h264", crf=1))
    (tmp_path / "recorded" / "meta" / "rsjax.json").unlink()  # somebody else's recordings, of deltas
    declared = replace(first, option=("kind=delta", "held=[2]"))
    ingest(make_plan("lerobot", tmp_path / "recorded", declared))
    store = rsjax.open_store(tmp_path / "clips")
    assert store.manifest["action_dimensions"] == ["action_0 (delta)", "action_1 (delta)", "action_2 (held)"]

    export_lerobot(store, tmp_path / "out", LeRobotOptions(codec="h264"))
    options = replace(first, out=tmp_path / "again", windows=replace(windows, hop=3), test_share=0.3)
    ingest(make_plan("lerobot", tmp_path / "out", options))
    again = rsjax.open_store(tmp_path / "again")
    assert again.manifest["action_dimensions"] == store.manifest["action_dimensions"]
    owner = [clip["provenance"]["episode"] for clip in records(store)]  # the export's episodes are these clips
    split_of: dict[str, str] = {}
    for split in ("train", "test"):
        for clip in records(again, split):
            recording = owner[int(clip["provenance"]["episode"].removeprefix("episode_"))]
            assert split_of.setdefault(recording, split) == split
    assert set(split_of.values()) == {"train", "test"}


def test_a_clip_of_an_export_is_one_shot_however_it_changes(tmp_path: Path) -> None:
    def clips() -> Any:
        for number in range(3):
            rgb = np.full((20, 32, 32, 3), 20, np.uint8)
            rgb[10:] = (230, 40, 40)  # as a cut would look
            actions = np.full((20, 2), number, np.float32)
            actions[0] = 0
            yield {"rgb": rgb, "actions": actions, "task": "pick", "fps": 5.0}

    store = rsjax.write_store(tmp_path / "store", clips(), test_share=0.0)
    export_lerobot(store, tmp_path / "out", LeRobotOptions(codec="h264", crf=1))
    windows = WindowConfig(frames=20, rate=0, hop=20)
    own = ingest_options(tmp_path / "own", windows, shots=IngestOptions.shots)
    ingest(make_plan("lerobot", tmp_path / "out", replace(own, camera="observation.images.image")))
    assert sum(rsjax.open_store(tmp_path / "own").counts().values()) == 3
    (tmp_path / "out" / "meta" / "rsjax.json").unlink()  # another program's: the cut counts
    with pytest.raises(UserError):
        ingest(make_plan("lerobot", tmp_path / "out", replace(own, out=tmp_path / "cut")))


def test_openpis_horizon_is_measured_by_the_actions_that_there_are() -> None:
    for frames, horizon in ((16, 50), (16, 8), (5, 7), (60, 50)):
        targets = [start + step < frames for start in range(frames) for step in range(horizon)]
        assert padding(frames, horizon) == pytest.approx(1 - np.mean(targets))
    advice = openpi_advice(16)
    assert "83%" in advice and "action_horizon=9 (25%)" in advice
    assert openpi_advice(200) == ""
    assert "action_horizon=1 (0%)" in openpi_advice(1)


def test_large_data_sets_fill_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = toy_store(tmp_path / "store", 5, width=1)
    for name in ("DATA_MEGABYTES", "VIDEO_MEGABYTES"):
        monkeypatch.setattr(lerobot_files, name, 0)
    for name, value in (("CHUNK", 2), ("BUFFERED", 2)):
        monkeypatch.setattr(lerobot_files, name, value)
    export_lerobot(store, tmp_path / "out", LeRobotOptions(codec="h264"))
    assert len(list((tmp_path / "out").glob("data/chunk-*/*"))) == 4
    schema = pq.read_schema(tmp_path / "out/data/chunk-001/file-001.parquet")
    assert not pa.types.is_fixed_size_list(schema.field("action").type), "a single number is a scalar"
    for clip, episode in zip(records(store), read_all("lerobot", tmp_path / "out"), strict=True):
        np.testing.assert_array_equal(episode.actions, clip["actions"])
        assert_near(episode.cameras["image"].read(range(6)), clip["rgb"])


@pytest.mark.parametrize("fps", [24000 / 1001, 29.9712 * 15 / 113])
def test_a_videos_frames_are_where_the_timestamps_are_however_long_it_is(tmp_path: Path, fps: float) -> None:
    info = export_lerobot(toy_store(tmp_path / "store", fps=fps), tmp_path / "out", LeRobotOptions(codec="h264"))
    with av.open(next((tmp_path / "out").glob("videos/*/*/*.mp4"))) as video:
        assert float(video.streams.video[0].average_rate) == info["fps"]  # type: ignore[arg-type]
    assert info["fps"] == pytest.approx(fps, rel=1e-6) and (info["fps"] == fps or fps < 20)


def test_clips_of_several_cameras_are_named_after_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stores = [toy_store(tmp_path / name, 2, provenance={"camera": name}) for name in ("front", "wrist")]
    merge([store.path for store in stores], tmp_path / "both")
    info = export_lerobot(rsjax.open_store(tmp_path / "both"), tmp_path / "out", LeRobotOptions(codec="h264"))
    assert "observation.images.front" in info["features"]
    assert not (tmp_path / "out" / "meta" / PROVENANCE).exists()
    assert not info["features"].keys() & OUTCOME.keys()
    said = " ".join("".join(capsys.readouterr()).split())
    assert "clips of the cameras front, wrist; all are in observation.images.front" in said


def test_an_export_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = toy_store(tmp_path / "store")

    def fail(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_lerobot(store, tmp_path / "out", LeRobotOptions(codec="h264"), fail)
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith("out")]
    export_lerobot(store, tmp_path / "out", LeRobotOptions(codec="h264"))
    with pytest.raises(UserError, match=r"out: exists; choose another"):
        export_lerobot(store, tmp_path / "out")


def test_what_cannot_be_exported_is_named(tmp_path: Path) -> None:
    for fields in ({"crf": 64}, {"crf": 52, "codec": "h264"}, {"crf": -3}):
        with pytest.raises(UserError, match=r"export.crf is .*; it must be 0 … "):
            LeRobotOptions(**fields)  # type: ignore[arg-type]
    fast, slow = toy_store(tmp_path / "fast"), toy_store(tmp_path / "slow", fps=2.0)
    both = merge([fast.path, slow.path], tmp_path / "both")
    at = r"32 × 32 pixels at .* Hz; videos need even sides and 0.001 to 1000 Hz"
    for store, options, message in (
        (toy_store(tmp_path / "still", fps=None), {}, "do not say how many frames a second have; give --fps"),
        (toy_store(tmp_path / "odd", size=33), {}, "33 × 33 pixels"),
        *((fast, {"fps": fps}, at) for fps in (float("inf"), -1.0, 1e-9)),
        (both, {}, "has clips of 5 and 2 frames a second .* or give --fps"),
        (fast, {"split": "val"}, "no split 'val'"),
    ):
        with pytest.raises(UserError, match=message):
            export_lerobot(store, tmp_path / "out", LeRobotOptions(**options))  # type: ignore[arg-type]
