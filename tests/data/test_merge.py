import json
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.data.merge import by_label, into_parts, merge, split
from rsjax.data.normalization import Statistics
from rsjax.data.store import Store, StoreError, open_store
from tests.data.clips import clip_store, numbers, words


def assert_labels_are_those_of_the_records(store: Store) -> None:
    for name in store.splits:
        source = store.source(name)
        labels = store.labels(name) if len(source) else None
        for i in range(len(source)):
            assert labels is not None
            assert {k: labels.words[k][labels.codes[k][i]] for k in labels.words} == words(source[i])


@pytest.mark.parametrize("counted", [True, False])
def test_merged_stores_have_all_records_and_the_units_of_all(tmp_path: Path, counted: bool) -> None:
    clip_store(tmp_path / "a", 0, 4, [1.0, 2.0], counted)
    clip_store(tmp_path / "b", 10, 3, [0.5, 1.5])
    store = merge([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    assert numbers(store) == [0, 1, 2, 3, 10, 11, 12] and numbers(store, "test") == [90, 91, 90, 91]
    assert store.manifest["depth_range"] == [0.5, 2.0]
    assert store.manifest["success_share"] == pytest.approx(5 / 11)  # of numbers 0, 3, 90, 12 and 90
    source = store.source("train")
    records = [source[i] for i in range(len(source))]
    assert all(record["provenance"]["depth_range"] == [0.5, 2.0] for record in records)
    exact = Statistics.of(np.concatenate([record["actions"][1:] for record in records])).to_json()
    np.testing.assert_allclose(store.manifest["action_mean"], exact["action_mean"], rtol=1e-6)
    np.testing.assert_allclose(store.manifest["action_std"], exact["action_std"], rtol=1e-6)
    assert_labels_are_those_of_the_records(store)


def test_a_split_by_label_holds_each_record_once_and_merges_back(tmp_path: Path) -> None:
    whole = clip_store(tmp_path / "a", 0, 7, [1.0, 2.0])
    parts = split(whole.path, by_label(whole.path, "difficulty", tmp_path / "parts"))
    assert {path.name: numbers(store) for path, store in parts.items()} == {
        "simple": [0, 2, 4, 6],
        "difficult": [1, 3, 5],
    }
    assert [store.manifest["success_share"] for store in parts.values()] == [3 / 5, 1 / 4]  # 0, 6 and 90; 3
    for store in parts.values():
        assert store.manifest["action_mean"] == whole.manifest["action_mean"]
        assert_labels_are_those_of_the_records(store)
    back = merge(list(parts), tmp_path / "b")
    assert sorted(numbers(back)) == list(range(7))
    assert {n: back.manifest[n] for n in ("action_mean", "action_std", "depth_range")} == {
        n: whole.manifest[n] for n in ("action_mean", "action_std", "depth_range")
    }


@settings(max_examples=5)
@given(st.integers(1, 6), st.integers(6, 9))
def test_parts_are_of_one_size_and_together_the_whole(
    tmp_path_factory: pytest.TempPathFactory, count: int, clips: int
) -> None:
    folder = tmp_path_factory.mktemp("parts")
    clip_store(folder / "a", 0, clips)
    parts = [
        numbers(store) for store in split(folder / "a", into_parts(folder / "a", count, folder / "parts")).values()
    ]
    assert sorted(chain(*parts)) == list(range(clips))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_what_does_not_go_together_is_refused(tmp_path: Path) -> None:
    clip_store(tmp_path / "a")
    clip_store(tmp_path / "large", size=16)
    clip_store(tmp_path / "tokens", kind="tokens")
    clip_store(tmp_path / "deep", depth_range=[1.0, 2.0])
    clip_store(tmp_path / "a-tokens", 0, depth_range=[1.0, 2.0], kind="tokens")
    clip_store(tmp_path / "b-tokens", 10, depth_range=[1.0, 3.0], kind="tokens")
    a, large, out, new = tmp_path / "a", tmp_path / "large", tmp_path / "out", tmp_path / "new"
    before = numbers(open_store(a))
    refused: dict[str, Callable[[], object]] = {
        "two stores or more": lambda: merge([a], out),
        "cannot be merged with itself": lambda: merge([a, a], out),
        r"large: rgb is uint8 \(4, 16, 16, 3\), in .*a uint8 \(4, 8, 8, 3\)": lambda: merge([a, large], out),
        "its kind is tokens, that of .*a is clips": lambda: merge([a, tmp_path / "tokens"], out),
        "its depth_range is .*mixed in training": lambda: merge([tmp_path / "a-tokens", tmp_path / "b-tokens"], out),
        "a: is there already; choose another place": lambda: merge([a, tmp_path / "deep"], a),
        "inside: lies in .*a, which is read": lambda: merge([a, tmp_path / "deep"], a / "inside"),
        "a: is there already": lambda: split(a, {new: {"train": [0]}, a: {"train": [0]}}),
        "no label 'colour'; it has task, difficulty": lambda: by_label(a, "colour", tmp_path),
        "no record of .* is chosen": lambda: split(a, {new: {"train": []}}),
    }
    for message, make in refused.items():
        with pytest.raises(StoreError, match=message):
            make()
        assert not out.exists() and not new.exists() and numbers(open_store(a)) == before


def test_clips_with_and_without_depth_go_together_but_not_metres_and_relative_depth(tmp_path: Path) -> None:
    blind, deep = clip_store(tmp_path / "blind", 0, 2), clip_store(tmp_path / "deep", 10, 2, [1.0, 2.0])
    merged = merge([blind.path, deep.path], tmp_path / "merged")
    source = merged.source("train")
    assert [source[i]["depth"] is None for i in range(4)] == [True, True, False, False]
    assert merged.manifest["depth_range"] == [1.0, 2.0]
    units = dict(zip(("blind", "deep", "far"), (None, "metres", "relative"), strict=True))
    clip_store(tmp_path / "far", 20, 2, [1.0, 9.0])
    for name, unit in units.items():
        place = tmp_path / name / "manifest.json"
        place.write_text(json.dumps(json.loads(place.read_text()) | {"depth_unit": unit}))
    assert merge([blind.path, deep.path], tmp_path / "both").manifest["depth_unit"] == "metres"
    with pytest.raises(StoreError, match=r"depth_unit: metres in .*deep; relative in .*far"):
        merge([deep.path, tmp_path / "far"], tmp_path / "out")


def test_what_was_left_out_of_each_is_listed_in_the_merged_store(tmp_path: Path) -> None:
    for number, name in enumerate("ab"):
        place = clip_store(tmp_path / name, 10 * number).path / "manifest.json"
        more = {"quarantine": {"episode": f"bad in {name}"}, "filtered": {f"still {name}": "still"}}
        place.write_text(json.dumps(json.loads(place.read_text()) | more))
    manifest = merge([tmp_path / "a", tmp_path / "b"], tmp_path / "c").manifest
    assert manifest["quarantine"] == {"episode": "bad in a", f"episode ({tmp_path / 'b'})": "bad in b"}
    assert manifest["filtered"] == {"still a": "still", "still b": "still"}
