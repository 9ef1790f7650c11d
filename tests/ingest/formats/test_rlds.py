import contextlib
import dataclasses
import json
import pickle
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.ingest.episode import EpisodeError, SourceError
from rsjax.ingest.formats import open_source
from rsjax.ingest.formats.keymap import MAPS, KeyMap, key_map
from rsjax.ingest.formats.rlds import RldsSource
from tests.bridge import BRIDGE, needs_bridge
from tests.ingest.formats.reading import read_first
from tests.ingest.formats.toy_tfrecord import (
    bridge_episode,
    encoded,
    example,
    features,
    picture,
    step,
    write_bridge,
    write_records,
)


def test_an_action_stands_with_the_frame_that_it_led_into(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    source = open_source("rlds", tmp_path)
    (ref,) = source.episodes()
    episode = source.read(ref)
    pictures = episode.cameras["image_0"].read([0, 3, 3])
    assert pictures.dtype == np.uint8 and pictures[:, 4, 4, 1].tolist() == [step(0), step(3), step(3)]
    # Action t of the file is t + 1 and leads from frame t into frame t + 1; the last leads nowhere.
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(np.asarray(episode.states)[:, 6], [0, 10, 20, 30, 40])
    np.testing.assert_allclose(episode.timestamps, np.arange(5) / 5)
    assert (episode.task, episode.fps, episode.segments) == ("put it down", 5.0, ())
    assert episode.meta["episode"] == {"episode_id": 3}


def test_placeholder_cameras_are_left_out_and_named(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    episode = read_first("rlds", tmp_path)
    assert list(episode.cameras) == ["image_0"] and episode.meta["blank"] == ["image_1", "image_2", "image_3"]


def test_references_and_sources_travel(tmp_path: Path) -> None:
    write_bridge(tmp_path / "1.0.0", [bridge_episode(), bridge_episode(4)])
    source = pickle.loads(pickle.dumps(open_source("rlds", tmp_path)))
    refs = list(source.episodes())
    assert [json.loads(json.dumps(ref.location)) for ref in refs] == [ref.location for ref in refs]
    assert [len(source.read(ref).timestamps) for ref in refs] == [5, 4]
    assert len({ref.fingerprint for ref in refs}) == len({ref.id for ref in refs}) == 2
    (tmp_path / "1.0.0").rename(tmp_path / "moved")
    assert [ref.fingerprint for ref in open_source("rlds", tmp_path).episodes()] == [ref.fingerprint for ref in refs]


def test_text_that_changes_on_the_way_makes_segments(tmp_path: Path) -> None:
    texts = [b"reach", b"reach", b"", b"lift", b"lift"]
    write_bridge(tmp_path, [bridge_episode(5, changes={"steps/language_instruction": texts})])
    segments = read_first("rlds", tmp_path).segments
    assert [(part.start, part.end, part.text) for part in segments] == [(0, 2, "reach"), (3, 5, "lift")]


def test_text_as_numbers_is_read(tmp_path: Path) -> None:
    codes = [*b"go", 0, 0] * 5
    write_bridge(tmp_path, [bridge_episode(5, changes={"steps/language_instruction": codes})])
    assert read_first("rlds", tmp_path).task == "go"


def test_a_key_map_of_ones_own(tmp_path: Path) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    keys = {"cameras": {"front": "observation/image_0"}, "action": ["action"], "fps": 2, "after": True}
    (tmp_path / "map.json").write_text(json.dumps(keys))
    episode = read_first("rlds", tmp_path / "data", keys=str(tmp_path / "map.json"))
    assert list(episode.cameras) == ["front"] and episode.fps == 2 and episode.states is None
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 2, 3, 4, 5])  # recorded with the frame they led into


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": {"a": "observation/image_9"}}, "no steps/observation/image_9.*did you mean 'observation/image_"),
        ({"cameras": {"a": "action"}}, "steps/action is of kind tensor"),
        ({"actoin": ["action"]}, "no field 'actoin'; did you mean 'action'"),
        ({"fps": -1}, "fps is -1"),
        ({"fps": 1e5}, "fps is 100000.0, should be a number above 0 and at most 10000"),
        ({"action": "action"}, "action is 'action', should be a list"),
        ({"kind": "relative"}, "kind is 'relative'"),
    ],
)
def test_a_key_map_that_does_not_fit_is_reported(tmp_path: Path, change: dict, message: str) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    keys = {"cameras": {"a": "observation/image_0"}, "action": ["action"], "fps": 2} | change
    (tmp_path / "map.json").write_text(json.dumps(keys))
    with pytest.raises(SourceError, match=message):
        open_source("rlds", tmp_path / "data", keys=str(tmp_path / "map.json"))


def test_a_key_map_that_does_not_say_what_actions_are_leaves_them_undeclared(tmp_path: Path) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    keys: dict[str, Any] = {"cameras": {"a": "observation/image_0"}, "action": ["action"], "fps": 2}
    for more, kind in (({}, "undeclared"), ({"kind": "delta", "held": []}, "delta")):
        (tmp_path / "map.json").write_text(json.dumps(keys | more))
        episode = read_first("rlds", tmp_path / "data", keys=str(tmp_path / "map.json"))
        assert episode.meta["actions"]["kind"] == kind


def test_dimensions_that_actions_do_not_have_are_reported(tmp_path: Path) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    keys = {"cameras": {"a": "observation/image_0"}, "action": ["action"], "fps": 2, "quaternions": [99]}
    (tmp_path / "map.json").write_text(json.dumps(keys))
    with pytest.raises(EpisodeError, match="key map: quaternions names dimension 99, but actions have 7"):
        read_first("rlds", tmp_path / "data", keys=str(tmp_path / "map.json"))


def test_every_named_map_is_whole() -> None:
    names = [name for keys in MAPS.values() for name in keys.names]
    assert len(names) == len(set(names))
    assert all(keys.cameras and keys.action and keys.fps > 0 for keys in MAPS.values())


def test_an_unknown_data_set_asks_for_a_map(tmp_path: Path) -> None:
    write_records(tmp_path / "kitchen-train.tfrecord-00000-of-00001", [bridge_episode()])
    with pytest.raises(SourceError, match="no key map for the data set 'kitchen'"):
        open_source("rlds", tmp_path)
    assert len(list(open_source("rlds", tmp_path, keys="bridge").episodes())) == 1


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (bridge_episode(5, changes={"steps/action": np.zeros(34)}), "steps/action has 34 values for 5 steps"),
        (bridge_episode(5, changes={"steps/action": np.full(35, np.nan)}), "actions of frame 1 is not finite"),
        (
            bridge_episode(5, changes={"steps/observation/image_2": [encoded(picture(t)) for t in range(4)]}),
            "image_2 has 4",
        ),
        (bridge_episode(5, changes={"steps/observation/image_0": [1.0]}), "image_0 is float_list"),
        (b"\xff\xff\xff", "no tf.train.Example"),
    ],
)
def test_one_broken_episode_leaves_the_others(tmp_path: Path, broken: bytes, message: str) -> None:
    write_bridge(tmp_path, [bridge_episode(), broken, bridge_episode(3)])
    source = open_source("rlds", tmp_path)
    first, second, third = source.episodes()
    assert [len(source.read(ref).timestamps) for ref in (first, third)] == [5, 3]
    with pytest.raises(EpisodeError, match=message):
        source.read(second)


def test_a_picture_that_is_cut_off_is_reported_when_it_is_read(tmp_path: Path) -> None:
    pictures = [encoded(picture(step(t))) for t in range(5)]
    write_bridge(
        tmp_path, [bridge_episode(5, changes={"steps/observation/image_0": [*pictures[:4], pictures[4][:20]]})]
    )
    frames = read_first("rlds", tmp_path).cameras["image_0"]
    assert len(frames.read([0, 3])) == 2
    with pytest.raises(EpisodeError, match="image_0 frame 4"):
        frames.read([0, 4])


@pytest.mark.parametrize("cut", [5, 40])
def test_a_truncated_shard_is_one_more_entry_that_is_refused(tmp_path: Path, cut: int) -> None:
    shard = write_bridge(tmp_path, [bridge_episode(), bridge_episode()])
    shard.write_bytes(shard.read_bytes()[:-cut])
    source = open_source("rlds", tmp_path)
    good, bad = source.episodes()
    assert len(source.read(good).timestamps) == 5
    with pytest.raises(EpisodeError, match="truncated"):
        source.read(bad)


def test_a_shard_that_lacks_records_is_reported(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()], promised=3)
    source = open_source("rlds", tmp_path)
    _, bad = source.episodes()
    with pytest.raises(EpisodeError, match="has 1 of the 3 records"):
        source.read(bad)


def test_shards_that_are_missing_are_one_entry_that_is_refused(tmp_path: Path) -> None:
    for number in (0, 2):
        shard = write_records(tmp_path / f"kitchen-train.tfrecord-{number:05d}-of-00004", [bridge_episode()])
    source = open_source("rlds", tmp_path, keys="bridge")
    *good, bad = source.episodes()
    assert [len(source.read(ref).timestamps) for ref in good] == [5, 5]
    with pytest.raises(EpisodeError, match="2 of the 4 shards of train are missing, the first is 00001"):
        source.read(bad)
    assert len(list(open_source("rlds", shard, keys="bridge").episodes())) == 1


def test_a_shard_that_cannot_be_opened_leaves_the_others(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    gone = write_records(tmp_path / "bridge_dataset-test.tfrecord-00000-of-00001", [bridge_episode()])
    source = open_source("rlds", tmp_path)
    gone.unlink()
    bad, good = source.episodes()
    assert len(source.read(good).timestamps) == 5
    with pytest.raises(EpisodeError, match="bridge_dataset-test.*missing"):
        source.read(bad)


@settings(max_examples=60)
@given(st.data())
def test_damage_that_no_checksum_shows_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    payload = bytearray(bridge_episode(3))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    write_bridge(folder, [bytes(payload)])
    source = open_source("rlds", folder)
    with contextlib.suppress(EpisodeError):
        episode = source.read(next(source.episodes()))
        for frames in episode.cameras.values():
            frames.read(range(len(frames)))


@pytest.mark.parametrize("content", ['{"featuresDict": 3}', '{"featuresDict": {"features": {"steps": []}}}', "[]"])
def test_another_features_file_is_reported(tmp_path: Path, content: str) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    (tmp_path / "features.json").write_text(content)
    with pytest.raises(SourceError, match="features.json: "):
        open_source("rlds", tmp_path)


def test_an_episode_of_placeholders_is_refused(tmp_path: Path) -> None:
    white = [encoded(np.full((8, 8, 3), 255, np.uint8))] * 5
    write_bridge(tmp_path, [bridge_episode(changes={"steps/observation/image_0": white})])
    with pytest.raises(EpisodeError, match="image_0, image_1, image_2, image_3 hold placeholders"):
        read_first("rlds", tmp_path)


def test_a_path_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    write_bridge(tmp_path, [bridge_episode()])
    source = open_source("rlds", tmp_path)
    ref = next(source.episodes())
    ref.location["file"] = "../../etc/passwd"
    with pytest.raises(EpisodeError, match="which is not inside"):
        source.read(ref)


def test_nothing_to_read_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no .*tfrecord"):
        open_source("rlds", tmp_path)
    write_bridge(tmp_path, [bridge_episode()])
    with pytest.raises(SourceError, match="no split 'trian'; did you mean 'train'"):
        open_source("rlds", tmp_path, split="trian")
    (tmp_path / "features.json").write_text("{")
    with pytest.raises(SourceError, match="features.json: cannot be read"):
        open_source("rlds", tmp_path)


def image(*shape: int, dtype: str = "uint8") -> dict[str, Any]:
    return {"image": {"shape": {"dimensions": [str(side) for side in shape]}, "dtype": dtype}}


def tensor(*shape: int, dtype: str = "float32") -> dict[str, Any]:
    return {"tensor": {"shape": {"dimensions": [str(side) for side in shape]} if shape else {}, "dtype": dtype}}


def write_kitchen(folder: Path, observed: dict[str, Any], steps: dict[str, Any], values: dict[str, Any]) -> Path:
    """A data set that no named key map is for, of one episode with the frames of ``bridge_episode``."""
    folder.mkdir(parents=True, exist_ok=True)
    feature = features({"observation": features(observed)} | steps)
    (folder / "features.json").write_text(json.dumps(features({"steps": {"sequence": {"feature": feature}}})))
    return write_records(folder / "kitchen-train.tfrecord-00000-of-00001", [example(values)])


OBSERVED = {
    "front_rgb": image(8, 8, 3),
    "front_depth": image(8, 8, 1, dtype="uint16"),
    "wrist_rgb": image(8, 8, 3),
    "eef_pose": tensor(6),
    "clip_embedding": tensor(512),
}
STEPS = {"action": tensor(7), "language_instruction": {"text": {}}, "reward": tensor()}
PICTURES = [encoded(picture(step(t))) for t in range(3)]
VALUES = {
    "steps/observation/front_rgb": PICTURES,
    "steps/observation/wrist_rgb": PICTURES[::-1],
    "steps/observation/eef_pose": np.arange(18.0),
    "steps/action": np.repeat(np.arange(3) + 1.0, 7),
    "steps/language_instruction": [b"fold"] * 3,
}


def depth_picture(metres: np.ndarray, floats: bool) -> bytes:
    """As TFDS writes it: 16 bits, or four channels that are the bytes of a float32."""
    if not floats:
        return bytes(cv2.imencode(".png", np.round(metres * 1000).astype(np.uint16))[1])
    pixels = metres.astype("<f4").view(np.uint8).reshape(*metres.shape, 4)
    return bytes(cv2.imencode(".png", pixels[..., [2, 1, 0, 3]])[1])


@pytest.mark.parametrize("kind", ["uint16", "float32", "tensor"])
def test_a_proposed_key_map_reads_pictures_depth_and_texts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    metres = [np.full((8, 8), 1 + t / 4) for t in range(3)]
    maps: Any = np.stack(metres).astype(np.float32)
    if kind != "tensor":
        maps = [depth_picture(each, kind == "float32") for each in metres]
    described = tensor(8, 8, 1) if kind == "tensor" else image(8, 8, 1, dtype=kind)
    values = VALUES | {"steps/observation/front_depth": maps}
    write_kitchen(tmp_path / "set", OBSERVED | {"front_depth": described}, STEPS, values)
    episode = read_first("rlds", tmp_path / "set", keys="auto", fps=4, kind="delta", held=[6])
    assert list(episode.cameras) == ["front_rgb", "wrist_rgb"] and list(episode.depth) == ["front_rgb"]
    np.testing.assert_allclose(episode.depth["front_rgb"].read([2, 0])[:, 3, 3], [1.5, 1])
    assert episode.depth["front_rgb"].read([0]).dtype == np.float32
    assert (episode.fps, episode.task, episode.actions.shape) == (4, "fold", (3, 7))
    assert episode.states is not None and episode.states.shape == (3, 6)
    printed = capsys.readouterr().out
    assert "--option keys=FILE.json" in printed
    proposed = json.loads(printed[printed.index("{") : printed.rindex("}") + 1])
    assert (proposed["kind"], proposed["held"], proposed["fps"]) == ("delta", [6], 4)
    (tmp_path / "map.json").write_text(json.dumps(proposed))
    again = read_first("rlds", tmp_path / "set", keys=str(tmp_path / "map.json"))
    assert list(again.depth) == ["front_rgb"] and again.meta["actions"] == episode.meta["actions"]


def test_parts_of_an_action_are_joined_in_the_proposal(tmp_path: Path) -> None:
    parts = {"world_vector": tensor(3), "gripper": tensor(1), "terminate_episode": tensor(3, dtype="int32")}
    values = {name: value for name, value in VALUES.items() if name != "steps/action"}
    values |= {"steps/action/world_vector": np.ones(9), "steps/action/gripper": np.zeros(3)}
    write_kitchen(tmp_path, {"front_rgb": image(8, 8, 3)}, {"action": features(parts)}, values)
    episode = read_first("rlds", tmp_path, keys="auto", fps=3, kind="delta")
    assert episode.actions.shape == (3, 4)
    vector = [f"action/world_vector[{place}]" for place in range(3)]
    assert episode.meta["action_names"] == [*vector, "action/gripper"]


def test_what_cannot_be_proposed_is_refused(tmp_path: Path) -> None:
    write_kitchen(tmp_path / "a", OBSERVED, STEPS, VALUES)
    with pytest.raises(SourceError, match="how fast its pictures are; add --option fps="):
        open_source("rlds", tmp_path / "a", keys="auto")
    with pytest.raises(SourceError, match="choose one with keys: .*a .json file, or auto"):
        open_source("rlds", tmp_path / "a")
    with pytest.raises(EpisodeError, match="has no steps/observation/front_depth"):
        read_first("rlds", tmp_path / "a", keys="auto", fps=5)
    write_kitchen(tmp_path / "b", OBSERVED, {"reward": tensor()}, VALUES)
    with pytest.raises(SourceError, match="no actions among observation/front_rgb"):
        open_source("rlds", tmp_path / "b", keys="auto", fps=5)
    (tmp_path / "b/features.json").unlink()
    with pytest.raises(SourceError, match="no pictures among no features; write a key map as JSON"):
        open_source("rlds", tmp_path / "b", keys="auto", fps=5)


def test_the_example_of_the_page_is_a_key_map(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs/formats.md").read_text().split("## RLDS")[1]
    (block,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    (tmp_path / "kitchen.json").write_text(block)
    keys = key_map(str(tmp_path / "kitchen.json"), "", tmp_path)
    assert keys.depth_scale == 0.001 and set(keys.depth) <= set(keys.cameras)
    documented = set(re.findall(r"^\| `(\w+)`", text.split("\n## ")[0], re.MULTILINE))
    assert documented == {field.name for field in dataclasses.fields(KeyMap)} - {"names"}


@needs_bridge
def test_the_proposal_for_bridge_is_its_named_map(tmp_path: Path) -> None:
    proposed, named = (open_source("rlds", BRIDGE, keys=keys, fps=5) for keys in ("auto", "bridge"))
    assert isinstance(proposed, RldsSource) and isinstance(named, RldsSource)
    assert proposed.keys == dataclasses.replace(named.keys, kind=None, held=None)
    first, second = (source.read(next(source.episodes())) for source in (proposed, named))
    assert first.meta["actions"]["kind"] == "undeclared" and second.meta["actions"]["held"] == [6]


@needs_bridge
def test_the_bundled_bridge_episodes() -> None:
    source = open_source("rlds", BRIDGE)
    episodes = [source.read(ref) for ref in source.episodes()]
    assert len(episodes) == 25 and {len(episode.timestamps) for episode in episodes} == {10}
    assert all(episode.task for episode in episodes) and len({episode.task for episode in episodes}) == 4
    missed = []
    for episode in episodes:
        # Three of the four cameras hold pictures, the fourth a black placeholder.
        assert list(episode.cameras) == ["image_0", "image_1", "image_2"] and episode.meta["blank"] == ["image_3"]
        assert all(frames.read(range(10)).shape == (10, 64, 64, 3) for frames in episode.cameras.values())
        assert episode.actions.shape == (10, 7) and episode.actions[:, :6].any()
        moved, rows = np.diff(np.asarray(episode.states)[:, :3], axis=0)[1:-1], episode.actions[:, :3]
        missed.append([np.abs(moved - others).mean() for others in (rows[1:-2], rows[2:-1], rows[3:])])
    before, own, after = np.mean(missed, axis=0)
    assert own < 0.6 * after and own < before  # row t is what moved the arm into frame t; the arm lags a little
