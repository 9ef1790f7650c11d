"""Key maps of RLDS: named ones, one's own, and proposed ones."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rsjax.tools.ingest.formats import open_source
from rsjax.tools.ingest.formats.keymap import MAPS, KeyMap, key_map
from rsjax.tools.ingest.formats.rlds import RldsSource
from tests.bridge import BRIDGE, needs_bridge
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.toy_tfrecord import (
    bridge_episode,
    encoded,
    example,
    features,
    picture,
    step,
    write_bridge,
    write_records,
)


def test_a_key_map_of_ones_own_says_what_actions_are_or_leaves_them_undeclared(tmp_path: Path) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    keys: dict[str, Any] = {"cameras": {"front": "observation/image_0"}, "action": ["action"], "fps": 2}
    # Action t of the file is t + 1 and leads into the next frame; with "after", it led into its own.
    for more, kind, first in (({}, "undeclared", 0), ({"kind": "delta", "held": [], "after": True}, "delta", 1)):
        (tmp_path / "map.json").write_text(json.dumps(keys | more))
        episode = read_first("rlds", tmp_path / "data", keys=str(tmp_path / "map.json"))
        assert list(episode.cameras) == ["front"] and episode.fps == 2 and episode.states is None
        np.testing.assert_array_equal(episode.actions[:, 0], first + np.arange(5))
        assert episode.meta["actions"]["kind"] == kind


def test_the_poses_that_the_hand_reached_are_actions_by_name(tmp_path: Path) -> None:
    write_bridge(tmp_path / "data", [bridge_episode()])
    episode = read_first("rlds", tmp_path / "data", keys="bridge_poses")
    assert episode.states is not None
    np.testing.assert_array_equal(episode.actions, episode.states)
    assert (episode.meta["actions"]["kind"], episode.meta["actions"]["angles"]) == ("absolute", [3, 4, 5])


def test_every_named_map_is_whole() -> None:
    names = [name for keys in MAPS.values() for name in keys.names]
    assert len(names) == len(set(names))
    assert all(keys.cameras and keys.action and keys.fps > 0 for keys in MAPS.values())


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


def test_the_example_of_the_page_is_a_key_map(tmp_path: Path) -> None:
    text = (Path(__file__).parents[4] / "docs/formats.md").read_text().split("## RLDS")[1]
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
