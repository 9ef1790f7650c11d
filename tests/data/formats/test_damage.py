"""Whatever happens to one file of a data set, each episode is read or told of in one line, and all are counted."""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.data import video
from rsjax.data.formats import open_source
from rsjax.errors import UserError
from tests.data.formats import test_agibot, test_folder, test_lerobot

WRITERS: dict[str, Callable[[Path], Any]] = {
    "lerobot v2": test_lerobot.write_v2,
    "lerobot v3": test_lerobot.write_v3,
    "agibot": test_agibot.write_agibot,
    "folder": test_folder.write_episode,
}


def read_everything(name: str, root: Path) -> tuple[int, list[str]]:
    """How many episodes are listed, and what is told."""
    listed, told = 0, []
    try:
        source = open_source(name.partition(" ")[0], root)
        for ref in source.episodes():
            listed += 1
            try:
                episode = source.read(ref)
                for pictures in episode.cameras.values():
                    pictures.read([0, len(pictures) - 1])
            except UserError as error:
                told.append(str(error))
    except UserError as error:
        told.append(str(error))
    return listed, told


@pytest.fixture(scope="module", params=WRITERS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    root = tmp_path_factory.mktemp("whole") / "set"
    root.mkdir()
    WRITERS[request.param](root)
    return request.param, root


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_damage_to_one_file(whole: tuple[str, Path], data: st.DataObject) -> None:
    name, root = whole
    count, told = read_everything(name, root)
    assert not told
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
        listed, told = read_everything(name, root)
    finally:
        path.write_bytes(payload)
    assert all("\n" not in message for message in told)
    if path.parent.name not in ("meta", "task_info") and "episodes" not in path.parts:
        assert listed == count


@contextlib.contextmanager
def forbidden(path: Path) -> Iterator[None]:
    """Nobody may read it, not even root, who reads as somebody else."""
    mode, user = path.stat().st_mode, os.geteuid()
    path.chmod(0)
    try:
        if user == 0:
            os.seteuid(65534)
        yield
    finally:
        os.seteuid(user)
        path.chmod(mode)


@pytest.mark.parametrize("name", WRITERS)
def test_what_may_not_be_read(name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:  # pytest's own folders are closed to others
        root = Path(folder) / "set"
        root.mkdir()
        Path(folder).chmod(0o755)
        WRITERS[name](root)
        read_everything(name, root)  # libraries import parts of themselves at first use
        for path in [root, *sorted(root.rglob("*"))]:
            video.close_all()
            with forbidden(path):
                _, told = read_everything(name, root)
            assert told or "depth" in path.parts, path
            assert all("\n" not in message for message in told)


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_in_place_of_a_file(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path)
    for path in [path for path in tmp_path.rglob("*") if path.suffix in (".mp4", ".h5", ".parquet", ".csv")]:
        path.unlink()
        path.mkdir()
    _, told = read_everything(name, tmp_path)
    assert told
    assert all("\n" not in message for message in told)
