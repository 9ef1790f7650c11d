from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from rsjax.tools.ingest.formats.hdf5 import H5Frames, member, open_file, rows
from tests.tools.ingest.formats.toy_demos import demo, write_demos


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rows"] = np.arange(6.0).reshape(3, 2)
        file["group/inner"] = np.arange(3)
    return tmp_path / "a.h5"


def test_rows_are_float32_with_a_row_for_each_frame(path: Path) -> None:
    with open_file(path) as file:
        np.testing.assert_array_equal(rows(file, "rows", path), [[0, 1], [2, 3], [4, 5]])
        np.testing.assert_array_equal(rows(file["group"], "inner", path), [[0], [1], [2]])
        assert member(file, "nothing", path) is None


def read_rows(path: Path, key: str) -> np.ndarray:
    with open_file(path) as file:
        return rows(file, key, path)


def link_into_another_file(path: Path) -> None:
    with h5py.File(path.with_name("secret.h5"), "w") as secret:
        secret["rows"] = np.ones((3, 2))
    with h5py.File(path, "a") as file:
        file["linked"] = h5py.ExternalLink("secret.h5", "/rows")


def store_in_another_file(path: Path) -> None:
    path.with_name("secret").write_bytes(bytes(48))
    with h5py.File(path, "a") as file:
        file.create_dataset("linked", (3, 2), np.float64, external=[(str(path.with_name("secret")), 0, 48)])


def put_together_of_another_file(path: Path) -> None:
    link_into_another_file(path)
    with h5py.File(path, "a") as file:
        del file["linked"]
        layout = h5py.VirtualLayout((3, 2), np.float64)
        layout[:] = h5py.VirtualSource(str(path.with_name("secret.h5")), "rows", (3, 2))
        file.create_virtual_dataset("linked", layout)


@pytest.mark.parametrize("change", [link_into_another_file, store_in_another_file, put_together_of_another_file])
def test_what_lies_in_another_file_is_refused(path: Path, change: object) -> None:
    change(path)  # type: ignore[operator]
    reads: tuple[Callable[[], object], ...] = (
        lambda: read_rows(path, "linked"),
        *(partial(H5Frames, path, "linked", depth=depth) for depth in (False, True)),
    )
    for read in reads:
        with pytest.raises(EpisodeError, match=r"a.h5: /?linked lies in another file"):
            read()


def test_a_demo_of_another_file_is_refused(tmp_path: Path) -> None:
    write_demos(tmp_path / "secret.h5", {"demo_0": demo()})
    write_demos(tmp_path / "set" / "a.hdf5", {"demo_0": demo()})
    with h5py.File(tmp_path / "set" / "a.hdf5", "a") as file:
        file["data/demo_1"] = h5py.ExternalLink("../secret.h5", "/data/demo_0")
        file["data/demo_2/obs"] = h5py.ExternalLink("../secret.h5", "/data/demo_0/obs")
    source = open_source("robomimic", tmp_path / "set")
    good, *bad = source.episodes()
    assert len(source.read(good).timestamps) == 4
    for ref in bad:
        with pytest.raises(EpisodeError, match=r"a.hdf5: .*lies in another file"):
            source.read(ref)


def test_what_is_no_data_set_of_pictures_is_reported(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["one"] = h5py.SoftLink("/two")
        file["two"] = h5py.SoftLink("/one")
        file.create_dataset("frames", (600, 1024, 1024, 3), np.uint8, chunks=(600, 1024, 1024, 3), compression="gzip")
    refused: list[tuple[str, Callable[[], object]]] = [
        ("a.h5: ", lambda: read_rows(path, "one")),  # links that lead in a circle
        ("frames has chunks of 1887436800 bytes", lambda: H5Frames(path, "frames")),
    ]
    for key in ("group", "nothing", "rows"):
        refused += [(f"a.h5: {key} is ", partial(H5Frames, path, key, depth=depth)) for depth in (False, True)]
    for message, read in refused:
        with pytest.raises(EpisodeError, match=message):
            read()
