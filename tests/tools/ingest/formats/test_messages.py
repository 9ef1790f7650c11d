"""The catalogue of what the readers say about bad input: one line for each format and kind of damage."""

import json
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.data.store import write_store
from rsjax.errors import UserError
from rsjax.tools.ingest.episode import EpisodeError, SourceError
from tests.tools.ingest.formats import test_agibot as agibot
from tests.tools.ingest.formats import test_bair as bair
from tests.tools.ingest.formats import test_folder as folder
from tests.tools.ingest.formats import test_lerobot as lerobot
from tests.tools.ingest.formats import test_npz as npz
from tests.tools.ingest.formats import test_rlds_keys as kitchen
from tests.tools.ingest.formats import test_sim as sim
from tests.tools.ingest.formats.reading import read_everything
from tests.tools.ingest.formats.toy_demos import demo, write_demos
from tests.tools.ingest.formats.toy_tfrecord import bridge_episode, encoded, picture, step, write_bridge, write_records

Make = Callable[[Path], object]  # writes a data set into an empty folder
ROWS = range(folder.COUNT)
TABLE = "data/chunk-000/episode_000001.parquet"
SHARED = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def nothing(root: Path) -> None:
    pass


def refused(name: str, message: str, make: Make = nothing, count: int = 1, at: str = "", **options: Any) -> Any:
    """An episode of the data set at ``at`` is refused, or ``count`` of them; all others can be read."""
    return pytest.param(name, make, at, EpisodeError, message, count, options, id=f"{name}: {message[:40]}")


def unreadable(name: str, message: str, make: Make = nothing, at: str = "", **options: Any) -> Any:
    """The whole data set is refused."""
    return pytest.param(name, make, at, SourceError, message, 1, options, id=f"{name}: {message[:40]}")


def write(path: str, content: str | bytes, first: Make = nothing) -> Make:
    """Writes a data set, and then a file in it."""

    def make(root: Path) -> None:
        first(root)
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(content if isinstance(content, bytes) else content.encode())

    return make


def proprio(*changes: tuple[str, Any], shorter: bool = False) -> Make:
    def edit(made: dict[str, Any]) -> None:
        if shorter:
            agibot.shorter(made)
        made.update(changes)

    return lambda root: agibot.write_agibot(root, edit)


def columns(changes: dict[str, list[tuple[str, Any]]], first: Make = lerobot.write_v2) -> Make:
    def make(root: Path) -> None:
        first(root)
        for file, edits in changes.items():
            table = pq.read_table(root / file, partitioning=None)
            for column, values in edits:
                table = table.set_column(table.column_names.index(column), column, pa.array(values))
            pq.write_table(table, root / file)

    return make


def column(name: str, values: Any) -> Make:
    return columns({TABLE: [(name, values)]})


def lerobot_info(version: str = "v2.1", **more: Any) -> Make:
    def make(root: Path) -> None:
        lerobot.write_v2(root)
        lerobot.write_info(root, version, lerobot.V2_PATHS | more.pop("paths", {}), **more)

    return make


def csv(*lines: str) -> Make:
    return write("one/actions.csv", "".join(f"{line}\n" for line in lines), folder.write_episode)


def array(values: np.ndarray) -> Make:
    def make(root: Path) -> None:
        (folder.write_episode(root) / "actions.csv").unlink()
        np.save(root / "one/actions.npy", values)

    return make


def flat_pipe(root: Path) -> None:
    folder.write_csv(root / "one.csv")
    os.mkfifo(root / "one.mp4")


def enormous_picture(root: Path) -> None:
    png = bytearray(cv2.imencode(".png", picture(0))[1].tobytes())
    png[16:24] = (2**30).to_bytes(4, "big") * 2
    write("one/top/0.png", bytes(png))(root)
    np.save(root / "one/actions.npy", np.zeros((1, 3)))


def without_videos(root: Path) -> None:
    for path in folder.write_episode(root).glob("*.mp4"):
        path.unlink()


def two_bair(**changes: Any) -> Make:
    return lambda root: bair.write(root, bair.episode_bytes(**changes), bair.episode_bytes())


def fewer_bair(kept: int) -> Make:
    return lambda root: write_records(bair.write(root, *[b""] * 2), [bair.episode_bytes()] * kept)


def two_demos(settings: dict[str, Any] | None = None, **changes: Any) -> Make:
    first = demo() | {name.replace("__", "/"): values for name, values in changes.items()}
    return lambda root: write_demos(root / "a.hdf5", {"demo_0": first, "demo_1": demo()}, **settings or {})


def demos(edit: Callable[[h5py.File], object], **arrays: Any) -> Make:
    def make(root: Path) -> None:
        with h5py.File(write_demos(root / "a.hdf5", arrays or {"demo_0": demo()}), "a") as file:
            edit(file)

    return make


BLIND = {key: values for key, values in demo().items() if not key.endswith("_image")}


def masked(root: Path) -> None:
    write_demos(root / "a.hdf5", {"demo_0": demo(2)}, {"train": ["demo_0"], "valid": ["demo_7"]})


def arrays(**changes: Any) -> Make:
    return lambda root: npz.write(root / "a.npz", **changes)


def packed_bomb(root: Path) -> None:
    with zipfile.ZipFile(npz.write(root / "a.npz"), "a") as archive, archive.open("state.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"shape": (2**40, 1), "fortran_order": False, "descr": "<f8"})


def bridge(**changes: Any) -> Make:
    broken = bridge_episode(5, changes={f"steps/{name.replace('__', '/')}": values for name, values in changes.items()})
    return lambda root: write_bridge(root, [bridge_episode(), broken, bridge_episode(3)])


def cut_shard(root: Path) -> None:
    shard = write_bridge(root, [bridge_episode(), bridge_episode()])
    shard.write_bytes(shard.read_bytes()[:-40])


def missing_shards(root: Path) -> None:
    for number in (0, 2):
        write_records(root / f"kitchen-train.tfrecord-{number:05d}-of-00004", [bridge_episode()])


def with_map(**change: Any) -> Make:
    keys = {"cameras": {"a": "observation/image_0"}, "action": ["action"], "fps": 2} | change

    def make(root: Path) -> None:
        write_bridge(root / "data", [bridge_episode()])
        (root / "map.json").write_text(json.dumps(keys))

    return make


def proposal(steps: dict[str, Any], described: bool = True) -> Make:
    def make(root: Path) -> None:
        kitchen.write_kitchen(root, kitchen.OBSERVED, steps, kitchen.VALUES)
        if not described:
            (root / "features.json").unlink()

    return make


def one_clip(**changes: Any) -> Make:
    return lambda root: sim.write(root / "store", sim.clip(**changes))


def tokens(root: Path) -> None:
    write_store(root / "store", "tokens", {"train": [{"x": 1}]}, {})


NAN = float("nan")
PICTURES = [encoded(picture(step(t))) for t in range(5)]
CASES = [
    refused("agibot", "end/position has 9 rows, more than 8", proprio(("action/end/position", np.zeros((9, 6))))),
    refused("agibot", "end/position has 7 rows, timestamp 8", proprio(("state/end/position", np.zeros((7, 2, 3))))),
    refused("agibot", r"position has shape \(8, 3\), not 6", proprio(("state/end/position", np.zeros((8, 3))))),
    refused("agibot", "states of frame 0 is not finite", proprio(("state/end/position", np.full((8, 6), NAN)))),
    refused("agibot", r"\|S4 \(8, 6\), no table", proprio(("state/end/position", np.full((8, 6), b"left")))),
    refused("agibot", "a dexterous hand", proprio(("action/effector/position", np.zeros((8, 12))))),
    refused("agibot", "timestamp is missing or empty", proprio(("timestamp", np.zeros(0)))),
    refused("agibot", "not increase at frame 1", proprio(("timestamp", np.array([5, 4, 3, 2, 1, 6, 7, 8], np.uint64)))),
    refused("agibot", "3 rows, action/end/index 2", proprio(("action/end/index", np.array([1, 2])), shorter=True)),
    refused("agibot", "within 0 … 7", proprio(("action/end/index", np.array([1, 2, 8])), shorter=True)),
    refused("agibot", "index is not increasing", proprio(("action/end/index", np.array([2, 1, 5])), shorter=True)),
    unreadable("agibot", "has no task 5; it has 327", agibot.write_agibot, tasks=[5]),
    unreadable("agibot", "neither task_info nor observations"),
    refused("lerobot", "frame_index of row 3 is 4, should be 3", column("frame_index", [0, 1, 2, 4, 3, 5, 6, 7, 8])),
    refused("lerobot", "episode_index of row 0 is 0, should be 1", column("episode_index", [0] * 9)),
    refused("lerobot", "has no column 'frame_index' of whole numbers", column("frame_index", [0.0] * 9)),
    refused("lerobot", "task_index 5 is not among the data set's tasks", column("task_index", [5] * 9)),
    refused("lerobot", "row 5 comes 0.2000 s after", column("timestamp", [0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.7, 0.8, 0.9])),
    refused("lerobot", "row 1 comes -0.1000 s after", column("timestamp", [0.8 - 0.1 * row for row in range(9)])),
    refused(  # times are as exact as float32 is, so these are not unevenly spaced
        "lerobot",
        "no frame at 5000.0000 s, row 0",
        column("timestamp", pa.array(np.float32(5000) + np.arange(9, dtype=np.float32) / lerobot.FPS, pa.float32())),
    ),
    refused("lerobot", r"'action' \(list<.*>\) is not rows of as many", column("action", [[1.0, 2.0]] * 8 + [[1.0]])),
    refused("lerobot", "actions of frame 1 is not finite", column("action", [[1.0, NAN]] * 9)),
    refused(
        "lerobot",
        "index of row 6 is 13, should be 12",
        columns({SHARED: [("index", [*range(12), *range(13, 16)])]}, lerobot.write_v3),
    ),
    refused(
        "lerobot",
        "9 rows of episode 1, metadata say 8",
        columns({EPISODES: [("length", [6, 8, 5])]}, lerobot.write_v3),
    ),
    refused(
        "lerobot",
        "no frame at 0.6002 s, row 0 of the table: the nearest is 0.0002 s away, 0.0001 s",
        columns({EPISODES: [(f"videos/{lerobot.KEY}/from_timestamp", [0.0, 0.6002, 0.0])]}, lerobot.write_v3),
    ),
    refused("lerobot", "total_episodes is 4, meta lists only 3", lerobot_info(total_episodes=4)),
    refused(
        "lerobot",
        "file-001.parquet: cannot be read",
        write("meta/episodes/chunk-000/file-001.parquet", "PAR1 and no more", lerobot.write_v3),
    ),
    *(
        refused("lerobot", message, lerobot_info(paths={"data_path": template}), count=3)
        for template, message in (
            ("../../{episode_index}.parquet", "is not inside"),
            ("{password}", "field 'password'"),
        )
    ),
    refused("lerobot", "held names dimension 99, but actions have", lerobot.write_v2, count=3, held=[99]),
    unreadable("lerobot", "meta/info.json: missing; .*or give the folder that has meta/"),
    unreadable("lerobot", "v1.6; v2.0, v2.1 and v3.0 can be read", lerobot_info("v1.6")),
    unreadable("lerobot", "fps 0", lerobot_info(fps=0)),
    unreadable("lerobot", "fps 100000", lerobot_info(fps=1e5)),
    unreadable("lerobot", "no column 'actions'; choose among action", lerobot.write_v2, action="actions"),
    unreadable("lerobot", "table of tasks is damaged", write("meta/tasks.jsonl", "[]\n", lerobot.write_v2)),
    refused("folder", "actions.csv: cannot be read", csv()),
    refused("folder", "its first line must name the columns", csv("0,1", "1,2")),
    refused("folder", "each once", csv("x,x", "1,2")),
    refused("folder", "has no column of actions", csv("timestamp,state_x", "1,2")),
    refused("folder", "3 timestamps for 8 pictures", csv("timestamp,x", "0,0", ".1,1", ".2,2")),
    refused("folder", "3 rows of actions for 8 pictures", csv("x", *"111")),
    refused("folder", "timestamps do not increase at frame 1", csv("timestamp,x", *["5,1"] * 8)),
    refused("folder", "actions.npy: cannot be read", array(np.array([{}]))),
    refused("folder", "no table of numbers", array(np.array(["left"]))),
    refused("folder", r"shape \(3,\), should be", array(np.zeros(3))),
    refused("folder", "needs one table .*, there is actions.csv, b.npy", write("one/b.npy", "", folder.write_episode)),
    *(
        refused("folder", f"episode.json: {message}", write("one/episode.json", text, folder.write_episode))
        for text, message in (
            ('{"segments": [{"start": 0, "end": 99, "text": "far"}]}', "segment 0 is 0 … 99, there are 8 frames"),
            ('{"fps": "fast"}', "task, fps or segments are wrong"),
            ("{", "cannot be read"),
        )
    ),
    refused("folder", "has no video", without_videos),
    refused(
        "folder",
        "has no column 'tme'; did you mean 'time",
        csv("time,x", *(f"{row},1" for row in ROWS)),
        action=["tme"],
    ),
    refused("folder", r"one.mp4: cannot be read \(a pipe or device, not a file\)", flat_pipe),
    refused("folder", "0.png: its header says 1073741824 × 1073741824 pixels", enormous_picture, fps=5),
    refused("folder", "actions.csv: held names dimension 2, but actions have 2", folder.write_episode, held=[2]),
    unreadable("folder", "has no episode", write("notes.txt", "")),
    *(
        unreadable("folder", ": fps is .*, should be a number from 0 to 10000; mend it", fps=fps)
        for fps in (-1, 10**400)
    ),
    *(
        unreadable("folder", message, write("dataset.json", text))
        for text, message in (
            ('{"afer": true}', "no field 'afer'; did you mean 'after'"),
            ('{"after": null}', "after is None, should be true or false"),
            ('{"fps": true}', "fps is True, should be a number"),
            ("[]", "should be an object"),
            ("{", "dataset.json: cannot be read"),
        )
    ),
    unreadable("folder", "not a folder", write("file", ""), at="file"),
    refused("bair", "2/image_main/encoded has 100 bytes, should", two_bair(**{"2/image_main/encoded": [bytes(100)]})),
    refused("bair", "has no 1/action", two_bair(**{"1/action": None})),
    refused("bair", "1/action has 3 values, that of step 0 4", two_bair(**{"1/action": np.zeros(3)})),
    refused("bair", "has no step 4", two_bair(**{"9/action": np.zeros(4)})),
    refused("bair", "states of frame 1 is not finite", two_bair(**{"1/endeffector_pos": np.full(3, np.inf)})),
    refused("bair", "has 1 of the 2 records that its name promises", fewer_bair(1)),
    refused("bair", "has 0 of the 2 records that its name promises", fewer_bair(0)),
    unreadable("bair", "no .*tfrecords"),
    *(unreadable("bair", "fps is .*; it must be above 0 and at", two_bair(), fps=fps) for fps in (0, NAN, 10**400)),
    refused("robomimic", "actions is .*should be numbers", two_demos(actions=np.array([["a"]] * 4, dtype="S1"))),
    refused("robomimic", "actions of frame 1 is not finite", two_demos(actions=np.full((4, 7), NAN))),
    refused("robomimic", "has no frames", two_demos(actions=np.zeros((0, 7)))),
    refused("robomimic", "should be uint8", two_demos(obs__agentview_image=np.zeros((4, 3, 6, 6), np.uint8))),
    refused("robomimic", "is float32", two_demos(obs__agentview_image=np.zeros((4, 6, 6, 3), np.float32))),
    refused(
        "robomimic",
        "a_image is uint8 .*1000000",
        demos(
            lambda file: file.create_dataset(
                "data/demo_0/obs/a_image", (4, 10**6, 10**6, 3), "u1", chunks=(1, 9, 9, 3)
            ),
            demo_0=BLIND,
        ),
    ),
    refused(
        "robomimic",
        "actions has 4 rows, num_samples says 9",
        demos(lambda file: file["data/demo_0"].attrs.create("num_samples", 9)),
    ),
    *(
        refused("robomimic", "control_freq in data.env_args is", two_demos({"env_args": settings}), count=2)
        for settings in ({"env_kwargs": {"control_freq": fps}} for fps in ("20", -5, [20]))
    ),
    unreadable("robomimic", "no mask/trian; did you mean 'train'", masked, filter="trian"),
    refused("robomimic", "has no group data/demo_7", masked, filter="valid"),
    unreadable(
        "robomimic",
        "a.hdf5: data/demo_0: has neither pictures in obs nor .* dataset_states_to_obs",
        demos(lambda file: None, demo_0=BLIND),
    ),
    unreadable("robomimic", "no .*hdf5 files"),
    unreadable("robomimic", "option size is 4; choose one from 8 to 1024", two_demos(), size=4),
    refused("robomimic", "has no group data", demos(lambda file: file.pop("data"))),
    refused("robomimic", "its group data has no demos", demos(lambda file: file["data"].pop("demo_0"))),
    unreadable("libero", r"has no \*_rgb", two_demos()),
    refused("npz", r"frames is none \(\), should be uint8", arrays(frames=None)),
    refused("npz", r"frames is uint8 \(5, 3, 6, 8\), should be", arrays(frames=np.zeros((5, 3, 6, 8), np.uint8))),
    refused("npz", "frames is float64", arrays(frames=np.zeros((5, 6, 8, 3)))),
    refused("npz", "actions is missing, should be numbers", arrays(actions=None)),
    refused("npz", "actions of frame 1 is not finite", arrays(actions=np.full((5, 1), NAN))),
    refused("npz", r"depth is int64 \(5, 6, 8\), should be floats", arrays(depth=np.zeros((5, 6, 8), np.int64))),
    refused("npz", "task is of Python objects, which are not read", arrays(task=np.array([None]))),
    refused("npz", "task is int64", arrays(task=3)),
    refused("npz", "fps is array", arrays(fps=0)),
    refused("npz", "how fast its pictures are; add fps to it, or say --option fps", arrays(fps=None)),
    refused("npz", "kind is 'relative'", arrays(kind="relative")),
    refused("npz", r"success is bool \(1,\)", arrays(success=[True])),
    refused("npz", "state has 8796093022208 bytes unpacked", packed_bomb),
    unreadable("npz", r"no \*.npz files"),
    refused("rlds", "steps/action has 34 values for 5 steps", bridge(action=np.zeros(34))),
    refused("rlds", "actions of frame 1 is not finite", bridge(action=np.full(35, NAN))),
    refused("rlds", "image_2 has 4", bridge(observation__image_2=PICTURES[:4])),
    refused("rlds", "image_0 is float_list", bridge(observation__image_0=[1.0])),
    refused("rlds", "image_0 frame 4", bridge(observation__image_0=[*PICTURES[:4], PICTURES[4][:20]])),
    refused(
        "rlds",
        "image_0, image_1, image_2, image_3 hold placeholders",
        bridge(observation__image_0=[encoded(np.full((8, 8, 3), 255, np.uint8))] * 5),
    ),
    refused("rlds", "no tf.train.Example", lambda root: write_bridge(root, [bridge_episode(), b"\xff\xff\xff"])),
    refused("rlds", "truncated", cut_shard),
    refused("rlds", "has 1 of the 3 records", lambda root: write_bridge(root, [bridge_episode()], promised=3)),
    refused("rlds", "2 of the 4 shards of train are missing, the first is 00001", missing_shards, keys="bridge"),
    *(
        unreadable("rlds", "features.json: ", write("features.json", text, bridge()))
        for text in ('{"featuresDict": 3}', '{"featuresDict": {"features": {"steps": []}}}', "[]", "{")
    ),
    unreadable("rlds", "no .*tfrecord"),
    unreadable("rlds", "no split 'trian'; did you mean 'train'", bridge(), split="trian"),
    *(
        unreadable("rlds", message, with_map(**change), at="data", keys="map.json")
        for change, message in (
            (
                {"cameras": {"a": "observation/image_9"}},
                "no steps/observation/image_9.*did you mean 'observation/",
            ),
            ({"cameras": {"a": "action"}}, "steps/action is of kind tensor"),
            ({"actoin": ["action"]}, "no field 'actoin'; did you mean 'action'"),
            ({"fps": -1}, "fps is -1, should be a number above 0 and at most 10000"),
            ({"fps": 1e5}, "fps is 100000.0, should be"),
        )
    ),
    refused(
        "rlds", "quaternions names dimension 99, but actions", with_map(quaternions=[99]), at="data", keys="map.json"
    ),
    unreadable("rlds", "no key map for the data set 'kitchen'; choose one with keys: .*auto", missing_shards),
    unreadable("rlds", "how fast its pictures are; add --option fps=", proposal(kitchen.STEPS), keys="auto"),
    refused("rlds", "has no steps/observation/front_depth", proposal(kitchen.STEPS), keys="auto", fps=5),
    unreadable("rlds", "no actions among observation/front_rgb", proposal({}), keys="auto", fps=5),
    unreadable("rlds", "no pictures among no features; write a key", proposal({}, described=False), keys="auto", fps=5),
    *(
        refused("sim", f"train-00000.array_record: train record 0.*({message})", one_clip(**change), at="store")
        for change, message in (
            ({"rgb": np.zeros((4, 5, 5, 3), np.float32)}, "rgb is float32"),
            ({"actions": np.full((4, 14), NAN, np.float32)}, "actions of frame 0 is not finite"),
            ({"depth": np.zeros((4, 5), np.float32)}, "depth is float32"),
            ({"tracks": np.full((3, 4, 2), NAN, np.float32)}, "tracks are not all finite"),
            ({"rgb": np.zeros((4, 5, 5, 1), np.uint8)}, "rgb has the shape"),
            ({"provenance": {"control_hz": "often"}}, "provenance or settings are wrong"),
            ({"provenance": [1]}, "provenance or settings are wrong"),
        )
    ),
    unreadable("sim", "no store"),
    unreadable("sim", "a store of tokens", tokens, at="store"),
    unreadable("sim", "no split 'tset'; did you mean", one_clip(), at="store", split="tset"),
]


@pytest.mark.parametrize(("name", "make", "at", "error", "message", "count", "options"), CASES)
def test_bad_input_is_named_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    make: Make,
    at: str,
    error: type[UserError],
    message: str,
    count: int,
    options: dict[str, Any],
) -> None:
    monkeypatch.chdir(tmp_path)
    make(tmp_path)
    _, errors = read_everything(name, tmp_path / at, **options)
    assert [type(one) for one in errors] == [error] * count, errors
    for one in errors:
        assert re.search(message, str(one)), one
