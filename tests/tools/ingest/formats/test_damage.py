"""Whatever happens to one file of a data set, each episode is read or reported in one line, and all are counted."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tools.ingest.formats import (
    test_agibot,
    test_bair,
    test_folder,
    test_lerobot,
    test_libero,
    test_npz,
    test_sim,
)
from tests.tools.ingest.formats.reading import read_everything
from tests.tools.ingest.formats.toy_demos import demo, write_demos
from tests.tools.ingest.formats.toy_tfrecord import bridge_episode, write_bridge
from tests.tools.ingest.formats.videos import close_videos


def write_sim(root: Path) -> None:
    root.rmdir()
    test_sim.write(root, *(test_sim.clip(number) for number in range(3)))


WRITERS: dict[str, Callable[[Path], Any]] = {
    "lerobot v2": test_lerobot.write_v2,
    "lerobot v3": test_lerobot.write_v3,
    "agibot": test_agibot.write_agibot,
    "folder": test_folder.write_episode,
    "robomimic": lambda root: write_demos(root / "a.hdf5", {f"demo_{number}": demo() for number in range(3)}),
    "libero": lambda root: write_demos(root / "a_demo.hdf5", {"demo_0": test_libero.libero_demo()}),
    "rlds": lambda root: write_bridge(root, [bridge_episode(3), bridge_episode(4)]),
    "bair": lambda root: test_bair.write(root, *[test_bair.episode_bytes()] * 2),
    "npz": lambda root: [test_npz.write(root / f"{number}.npz", bool(number)) for number in range(2)],
    "sim": write_sim,
}


@pytest.fixture(scope="module", params=WRITERS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, int]:
    """The name of a format, a data set of it, and how many episodes this has."""
    name = request.param.partition(" ")[0]
    root = tmp_path_factory.mktemp("whole") / "set"
    root.mkdir()
    WRITERS[request.param](root)
    count, errors = read_everything(name, root)
    assert not errors
    return name, root, count


@settings(max_examples=20)
@given(data=st.data())
def test_damage_to_one_file(whole: tuple[str, Path, int], data: st.DataObject) -> None:
    name, root, count = whole
    files = [path.relative_to(root) for path in sorted(root.rglob("*")) if path.is_file()]
    path = root / data.draw(st.sampled_from(files))
    payload = path.read_bytes()
    share = data.draw(st.floats(0, 0.99))
    place = int(share * len(payload))
    made = {
        "truncated": payload[:place],
        "overwritten": payload[:place] + data.draw(st.binary(min_size=1, max_size=40)) + payload[place + 40 :],
        "something else": data.draw(st.binary(max_size=100)),
    }
    try:
        path.write_bytes(made[data.draw(st.sampled_from(sorted(made)))])
        listed, errors = read_everything(name, root)
    finally:
        path.write_bytes(payload)
    assert listed == count or errors


@contextlib.contextmanager
def forbidden(path: Path) -> Iterator[None]:
    """Nobody may read it, not even root, who reads as somebody else."""
    mode = path.stat().st_mode
    user = os.geteuid()
    path.chmod(0)
    try:
        if user == 0:
            os.seteuid(65534)
        yield
    finally:
        os.seteuid(user)
        path.chmod(mode)


def test_what_may_not_be_read(whole: tuple[str, Path, int]) -> None:
    name, written, _ = whole
    with tempfile.TemporaryDirectory() as folder:  # pytest's own folders are closed to others
        root = shutil.copytree(written, Path(folder) / "set")
        Path(folder).chmod(0o755)
        for path in [root, *sorted(root.rglob("*"))]:
            close_videos()
            with forbidden(path):
                _, errors = read_everything(name, root)
            assert errors or "depth" in path.parts, path


def test_a_folder_in_place_of_a_file(whole: tuple[str, Path, int], tmp_path: Path) -> None:
    name, written, _ = whole
    root = shutil.copytree(written, tmp_path / "set")
    for path in [path for path in root.rglob("*") if path.is_file() and path.suffix != ".json"]:
        path.unlink()
        path.mkdir()
    assert read_everything(name, root)[1]


LISTED = ("lerobot", "agibot")  # whose metadata name every file; others take what is there
CONTENTS = {
    "pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n", "git lfs pull"),
    "page": (b'\n<!DOCTYPE html>\n<html lang="en"><head><title>Sign in</title></head></html>\n', "a web page"),
    "pipe": (None, "a pipe or device"),
    "nothing": (None, "missing"),
}


@pytest.mark.parametrize("kind", CONTENTS)
def test_what_stands_in_place_of_a_file_is_named(whole: tuple[str, Path, int], tmp_path: Path, kind: str) -> None:
    name, written, _ = whole
    content, words = CONTENTS[kind]
    root = shutil.copytree(written, tmp_path / "set")
    for path in [path for path in sorted(root.rglob("*")) if path.is_file()]:
        payload = path.read_bytes()
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        elif kind == "pipe":
            os.mkfifo(path)
        close_videos()
        messages = [str(error) for error in read_everything(name, root)[1]]
        named = any(f"{path.name}: " in message and words in message for message in messages)
        needed = content is not None or name in LISTED or (name == "folder" and kind == "pipe")
        optional = "depth" in path.parts or (kind == "nothing" and {"meta", "task_info"} & {*path.parts})
        assert named or optional or not needed, (path, messages)
        path.unlink(missing_ok=True)
        path.write_bytes(payload)
