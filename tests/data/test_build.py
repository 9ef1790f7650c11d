from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rsjax
from rsjax.config import presets
from rsjax.data.build import TRACKS, choose_test
from rsjax.data.normalization import Normalization
from rsjax.data.store import StoreError
from rsjax.tools.pipeline.run_clips import on_store
from tests.tools.pipeline import toy

FRAMES, SIZE = 4, 64


def clip(number: int = 0, **changes: Any) -> dict[str, Any]:
    actions = np.full((FRAMES, 3), number, np.float64)
    actions[0] = 0
    return {"rgb": np.full((FRAMES, SIZE, SIZE, 3), number, np.uint8), "actions": actions} | changes


def test_a_store_has_the_clips_their_statistics_and_labels(tmp_path: Path) -> None:
    depth = np.linspace(0.5, 2, FRAMES * SIZE * SIZE).reshape(FRAMES, SIZE, SIZE)
    made = [clip(i, depth=depth, task="push", scene="lab", success=i % 2 == 0, fps=5) for i in range(10)]
    store = rsjax.write_store(tmp_path / "mine", made, test_share=0.2)
    assert store.counts() == {"train": 8, "test": 2}
    records = [record for split in store.splits for record in map(store.source(split).__getitem__, range(2))]
    for record in records:
        number = int(record["provenance"]["episode"])
        assert (record["rgb"] == number).all() and (record["actions"][1:] == number).all()
        assert record["actions"].dtype == record["depth"].dtype == np.float32
        assert record["success"].tolist() == [number % 2 == 0] * FRAMES and record["task"] == "push"
        assert record["tracks"].shape == (TRACKS, FRAMES, 2) and not record["visible"].any()
        assert record["provenance"]["depth_range"] == [0.5, 2] and record["provenance"]["frames"] == [0, 1, 2, 3]
    train = [int(name) for name in store.manifest["episodes"]["train"]]
    assert Normalization.create(store).action_mean == pytest.approx((np.mean(train),) * 3)
    assert Normalization.create(store).depth_range == (0.5, 2)
    assert store.manifest["success_share"] == 0.5
    assert store.labels("train").counts()["scene"] == {"lab": 8} and store.labels("test").of(0)["skill"] == "unknown"


def test_a_store_of_pictures_and_actions_alone_can_be_trained_on(tmp_path: Path) -> None:
    store = rsjax.write_store(tmp_path / "mine", map(clip, range(20)))
    assert store.source("test")[0]["depth"] is None and Normalization.create(store).depth_range is None
    config = on_store(presets.debug(), tmp_path / "mine")
    assert (config.clips.frames, config.clips.image_size, config.clips.action_dim) == (FRAMES, SIZE, 3)
    assert store.manifest["success_share"] is None
    unknown = rsjax.write_store(tmp_path / "mine", (clip(number, success=None) for number in range(2)))
    assert unknown.manifest["success_share"] is None


def test_the_key_follows_the_content(tmp_path: Path) -> None:
    keys = [
        rsjax.write_store(tmp_path / f"{number}", map(clip, range(count)), test_share=share).manifest["key"]
        for number, (count, share) in enumerate([(4, 0.5), (4, 0.5), (5, 0.5), (4, 0.25)])
    ]
    assert keys[0] == keys[1] and len(set(keys)) == 3


def test_clips_of_the_dataclass_go_in_too(tmp_path: Path) -> None:
    store = rsjax.write_store(tmp_path / "mine", (toy.clip(number) for number in range(4)), test_share=0.5)
    record, original = store.source("train")[0], store.source("train")[0]["provenance"]["episode"]
    np.testing.assert_array_equal(record["tracks"], toy.clip(int(original)).tracks)


def test_generated_clips_are_marked_whatever_their_provenance_says(tmp_path: Path) -> None:
    clips = [clip(0), clip(1, provenance={"source": "camera", "model": "mine"})]
    for generated, sources in ((True, {"generated"}), (False, {"write_store", "camera"})):
        store = rsjax.write_store(tmp_path / f"{generated}", clips, generated=generated)
        made = [store.source(split)[0]["provenance"] for split in ("train", "test")]
        assert {each["source"] for each in made} == sources
        assert {each.get("model") for each in made} == {None, "mine"}


@pytest.mark.parametrize("task", [None, float("nan"), "", " \n"])
def test_no_task_is_unknown(tmp_path: Path, task: Any) -> None:
    store = rsjax.write_store(tmp_path / "mine", [clip(0, task=task, scene=task), clip(1, task=" push ")])
    tasks = {store.source(split)[0]["task"] for split in ("train", "test")}
    scenes = {store.source(split)[0]["provenance"]["scene"] for split in ("train", "test")}
    assert tasks == {"unknown", "push"} and scenes == {"unknown"}


@settings(max_examples=8)
@given(names=st.lists(st.sampled_from("abcdef"), min_size=1, max_size=12), share=st.floats(0.01, 0.99))
def test_all_clips_of_an_episode_are_in_one_split(
    tmp_path_factory: pytest.TempPathFactory, names: list[str], share: float
) -> None:
    path = tmp_path_factory.mktemp("store") / "mine"
    made = (clip(number, episode=name) for number, name in enumerate(names))
    store = rsjax.write_store(path, made, test_share=share)
    episodes = [
        {store.source(split)[number]["provenance"]["episode"] for number in range(count)}
        for split, count in store.counts().items()
    ]
    assert not episodes[0] & episodes[1] and episodes[1] == choose_test(set(names), share)
    assert sum(store.counts().values()) == len(names) and episodes[0]
    assert {file.name for file in path.parent.iterdir()} == {"mine", ".mine.lock"}, "the lock stays"


WRONG = [
    ({"rgb": None}, r"has no rgb; give uint8 \(T, S, S, 3\)"),
    ({"rgb": np.zeros((FRAMES, SIZE, SIZE, 3))}, r"rgb is float64 \(4, 64, 64, 3\), should be uint8 \(T, S, S, 3\)"),
    ({"rgb": np.zeros((FRAMES, 32, SIZE, 3), np.uint8)}, "rgb has 4 frames of 64 × 32 pixels; .*a square"),
    ({"actions": np.zeros((FRAMES - 1, 3))}, r"actions is float64 \(3, 3\), should be numbers \(4, A\)"),
    ({"actions": np.ones((FRAMES, 3))}, "row 0 of actions is not zeros; row t is what led from frame t-1"),
    ({"actions": np.array([[0.0], [1], [np.nan], [2]])}, "actions has values that are not finite"),
    ({"actions": np.full((FRAMES, 3), "a")}, "actions is <U1"),
    ({"depth": np.zeros((FRAMES, SIZE, SIZE))}, "depth is 0 somewhere; it is in metres, above 0"),
    ({"depth": np.ones((FRAMES, 8, 8))}, r"depth is float64 \(4, 8, 8\), should be metres \(4, 64, 64\)"),
    ({"tracks": np.zeros((5, FRAMES, 2))}, r"has no visible; give bool \(5, 4\)"),
    ({"success": [True, False]}, r"success has the shape \(2,\)"),
    ({"success": "no"}, "success is 'no', should be True or False"),
    ({"success": [0, 1, 2, 1]}, r"success is \[0, 1, 2, 1\], should be True or False"),
    ({"fps": "5Hz"}, "fps is '5Hz'; it is frames per second, above 0"),
    ({"fps": float("nan")}, "fps is nan; it is"),
    ({"fps": 10**400}, "fps is 1000.*; it is frames per second, above 0 and at most 10000"),
    ({"rgb": [[1], [1, 2]]}, "rgb cannot be made an array"),
    ({"task": 3}, "task is 3; it is text"),
    ({"skill": np.zeros(2)}, "skill is array.*; it is text"),
    ({"episode": [1]}, r"episode is \[1\]; it is a name, or a number"),
    ({"provenance": {"seed": np.int64(3)}}, "provenance is not a dict of JSON-ready values .*int64"),
    ({"provenance": "x"}, r"provenance is not a dict of JSON-ready values \(it is a str\)"),
    (
        {"tracks": np.zeros((5, FRAMES, 2)), "visible": np.ones((5, FRAMES), bool)},
        r"tracks has the shape \(5, 4, 2\), .* \(256, 4, 2\); without tracks a clip gets 256 that are never visible",
    ),
    ({"success": True}, "success is given for some clips and not for others; give it for all, or for none"),
    (
        {"depth": np.ones((FRAMES, SIZE, SIZE)), "provenance": {"depth_unit": "relative"}},
        "its provenance says that depth is relative, not in metres; leave depth out",
    ),
    ({"tsak": "push"}, "no field 'tsak'; did you mean 'task'"),
    ({"actions": np.zeros((FRAMES, 4))}, r"actions has the shape \(4, 4\), that of the first clip \(4, 3\)"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_a_wrong_clip_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(StoreError, match=f"clip 2: {message}"):
        rsjax.write_store(tmp_path / "mine", [clip(), clip(), clip(**changes)])
    assert not list(tmp_path.iterdir())


def test_depth_without_a_range_is_refused_by_who_needs_one(tmp_path: Path) -> None:
    flat = np.ones((FRAMES, SIZE, SIZE))
    store = rsjax.write_store(tmp_path / "mine", [clip(0, depth=flat), clip(1, depth=flat)])
    with pytest.raises(StoreError, match="mine: depth is 1.0 everywhere in the train clips; make the store again"):
        Normalization.create(store)


def test_what_is_no_store_is_not_replaced_and_the_callers_errors_stay_its_own(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    wrong: Any = [clip(), [clip()]]
    for name, clips, share, message in (
        ("mine", [clip()], 0.1, "mine: exists and is not a store"),
        ("none", [], 0.1, "there are no clips to write"),
        ("none", [clip()], 1, "test_share is 1"),
        ("none", np.array(3.0), 0.1, "clips are array.*; give an iterable of clips"),
        ("none", wrong, 0.1, "^clip 1: is a list, should be a dict with rgb and actions$"),
    ):
        with pytest.raises(StoreError, match=message):
            rsjax.write_store(tmp_path / name, clips, test_share=share)

    def broken() -> Iterator[dict[str, Any]]:
        yield clip()
        raise FileNotFoundError("my own file")

    with pytest.raises(FileNotFoundError, match="my own file"):
        rsjax.write_store(tmp_path / "none", broken())
