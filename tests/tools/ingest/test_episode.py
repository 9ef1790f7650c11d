import os
import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.files import safe_id
from rsjax.tools.ingest.episode import Episode, EpisodeError, checked, fingerprint


class Black:
    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> np.ndarray:
        return np.zeros((len(indices), 4, 4, 3), np.uint8)


GOOD = Episode(
    id="e",
    fingerprint="0" * 16,
    task="go",
    fps=10.0,
    timestamps=np.arange(3) / 10,
    actions=np.zeros((3, 2), np.float32),
    states=np.zeros((3, 1), np.float32),
    cameras={"main": Black(3)},
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"timestamps": np.zeros(0)}, "f: episode e has no frames"),
        ({"cameras": {}}, "f: episode e has no camera"),
        ({"cameras": {"main": Black(2)}}, "f: camera main has 2 rows, timestamps 3"),
        ({"depth": {"main": Black(4)}}, "f: depth main has 4 rows, timestamps 3"),
        ({"actions": np.zeros((2, 2), np.float32)}, "f: actions has 2 rows, timestamps 3"),
        ({"states": np.zeros((4, 2), np.float32)}, "f: states has 4 rows, timestamps 3"),
        ({"actions": np.array([[0], [1], [np.inf]], np.float32)}, "f: actions of frame 2 is not finite"),
        ({"states": np.array([[0], [np.nan], [1]], np.float32)}, "f: states of frame 1 is not finite"),
        ({"timestamps": np.array([0, np.nan, 1])}, "f: timestamps of frame 1 is not finite"),
        ({"timestamps": np.array([0, 0.1, 0.1])}, "f: timestamps do not increase at frame 2"),
        ({"fps": 0.0}, "f: fps is 0.0"),
        ({"fps": float("nan")}, "f: fps is nan"),
    ],
)
def test_what_is_wrong_is_named(changes: dict, message: str) -> None:
    with pytest.raises(EpisodeError, match=f"^{re.escape(message)}"):
        checked(replace(GOOD, **changes), "f")


def test_an_error_that_comes_from_another_process_keeps_its_kind() -> None:
    error = pickle.loads(pickle.dumps(EpisodeError("f: late", "time")))
    assert (str(error), error.kind, EpisodeError("f").kind) == ("f: late", "time", "unreadable")


@given(st.lists(st.text(st.characters(exclude_categories=())), unique=True, max_size=20))  # and what is no text
def test_ids_are_file_names_and_stay_apart(texts: list[str]) -> None:
    ids = [safe_id(text) for text in texts]
    assert len(set(ids)) == len(ids)
    for name in ids:
        assert re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,120}", name)


@given(st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,90}", fullmatch=True))
def test_an_id_that_is_a_file_name_is_kept(text: str) -> None:
    assert safe_id(text) == text


@pytest.mark.parametrize("size", [10, 2**20])
def test_fingerprints_change_with_files_and_values_but_not_with_the_place(tmp_path: Path, size: int) -> None:
    def write(folder: str, name: str, payload: bytes, date: int) -> Path:
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_bytes(payload)
        os.utime(tmp_path / folder / name, (date, date))
        return tmp_path / folder / name

    one = fingerprint([write("a", "x", bytes(size), 1000)], "v")
    assert re.fullmatch("[0-9a-f]{16}", one)
    assert fingerprint([write("b", "x", bytes(size), 1000)], "v") == one
    assert fingerprint([tmp_path / "a/x"], "w") != one
    others = [
        write("c", "y", bytes(size), 1000),
        write("d", "x", bytes(size + 1), 1000),
        write("e", "x", bytes(size - 1) + b"1", 1000),
        tmp_path / "gone/x",
    ]
    assert len({one, *(fingerprint([path], "v") for path in others)}) == 5
    # a value mended in the middle of a large file shows in its date
    middle = write("f", "x", bytes(size // 2) + b"1" + bytes(size - size // 2 - 1), 2000)
    assert fingerprint([middle], "v") != one
