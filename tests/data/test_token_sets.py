from collections.abc import Iterator
from pathlib import Path

import pytest

from rsjax.data.codec import Record
from rsjax.data.merge import by_label, merge, split
from rsjax.data.store import Store, open_store, write_store
from rsjax.data.token_sets import FOLDER, token_sets, tokens_key
from tests.data.clips import clip_store, numbers, words


def add_tokens(clips: Store, tokenizer: str, leave_out: int = 0) -> Store:
    """Tokens that say which clip they are of."""

    def made(name: str) -> Iterator[Record]:
        source = clips.source(name)
        for number in range(len(source) - leave_out):
            clip = source[number]
            yield clip | {"rgb": clip["rgb"][:, :2, :2, 0].astype("int32"), "depth": None}

    meta = {name: clips.manifest[name] for name in ("action_mean", "action_std", "depth_range")}
    meta |= {"key": tokens_key(clips.manifest["key"], tokenizer), "tokenizer": f"weights of {tokenizer}"}
    write_store(clips.path / FOLDER / tokenizer, "tokens", {name: made(name) for name in clips.splits}, meta, words)
    return open_store(clips.path / FOLDER / tokenizer)


def assert_tokens_are_of_their_clips(clips: Store, tokenizer: str) -> None:
    tokens = token_sets(clips)[tokenizer]
    for name in clips.splits:
        assert numbers(tokens, name) == numbers(clips, name)
        source = tokens.source(name)
        assert [int(source[i]["rgb"].max()) for i in range(len(source))] == numbers(clips, name)


def test_a_set_counts_where_it_is_whole_and_of_these_clips(tmp_path: Path) -> None:
    clips = clip_store(tmp_path / "a", 0, 4)
    assert token_sets(clips) == {}
    add_tokens(clips, "one")
    add_tokens(clips, "short", leave_out=1)
    other = clip_store(tmp_path / "b", 10, 4)
    add_tokens(other, "one").path.rename(clips.path / FOLDER / "two")
    (clips.path / FOLDER / "half").mkdir()
    assert set(token_sets(clips)) == {"one"}


def test_tokens_move_with_the_store_and_are_split_and_merged_with_it(tmp_path: Path) -> None:
    add_tokens(clip_store(tmp_path / "there", 0, 7), "one")
    (tmp_path / "there").rename(tmp_path / "here")
    whole = open_store(tmp_path / "here")
    assert_tokens_are_of_their_clips(whole, "one")
    parts = split(whole.path, by_label(whole.path, "difficulty", tmp_path / "parts"))
    for part in parts.values():
        assert_tokens_are_of_their_clips(part, "one")
    assert_tokens_are_of_their_clips(merge(list(parts), tmp_path / "back"), "one")


@pytest.mark.parametrize("depth_range", [None, [1.0, 2.0]])
def test_tokens_stay_behind_where_a_merged_store_would_not_make_them_so(
    tmp_path: Path, depth_range: list[float] | None
) -> None:
    stores = [clip_store(tmp_path / "a", 0, 3, depth_range), clip_store(tmp_path / "b", 10, 3, [0.5, 3.0])]
    for store in stores:
        add_tokens(store, "one")
    if depth_range is None:
        merged = merge([stores[0].path, clip_store(tmp_path / "c", 20, 3).path], tmp_path / "out")  # c has no tokens
    else:
        merged = merge([store.path for store in stores], tmp_path / "out")  # depth ranges differ
    assert token_sets(merged) == {}
