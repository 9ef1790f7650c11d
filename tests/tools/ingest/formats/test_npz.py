import contextlib
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import EpisodeError, SourceError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_all, read_first

COUNT = 5


def arrays(count: int = COUNT, **changes: Any) -> dict[str, Any]:
    """Frame t is t, action t is t + 1."""
    steps = np.arange(count)
    made = {
        "frames": np.broadcast_to(steps.astype(np.uint8)[:, None, None, None], (count, 6, 8, 3)),
        "actions": np.repeat(steps[:, None] + 1.0, 2, 1),
        "fps": 10,
        "kind": "delta",
    }
    return {name: value for name, value in (made | changes).items() if value is not None}


def write(path: Path, packed: bool = True, **changes: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    (np.savez_compressed if packed else np.savez)(path, **arrays(**changes))
    return path


@pytest.mark.parametrize("packed", [True, False])
def test_everything_that_a_file_can_have(tmp_path: Path, packed: bool) -> None:
    extra = {"depth": np.full((COUNT, 6, 8), 1500, np.uint16), "state": np.ones((COUNT, 3)), "task": "push"}
    success = np.arange(COUNT) > 2
    write(tmp_path / "day/1.npz", packed, **extra, success=success, timestamps=7 + np.arange(COUNT) / 4)
    episode = pickle.loads(pickle.dumps(read_first("npz", tmp_path)))
    assert (episode.id, episode.task, episode.fps) == (episode.id, "push", 4.0)
    np.testing.assert_array_equal(episode.cameras["main"].read([4, 0, 4])[:, 0, 0, 0], [4, 0, 4])
    np.testing.assert_allclose(episode.depth["main"].read([1]), 1.5)
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3, 4])  # row t - 1 of the file led into frame t
    np.testing.assert_allclose(episode.timestamps, np.arange(COUNT) / 4)
    assert episode.states is not None and episode.meta["success"] == success.tolist()


def test_other_names_and_options(tmp_path: Path) -> None:
    made = arrays()
    for number in range(2):
        np.savez(tmp_path / f"{number}.npz", image=made["frames"], action=made["actions"][: COUNT - number])
    options = {"frames": "image", "actions": "action", "fps": 5, "kind": "absolute", "held": [1], "task": "push"}
    for episode in read_all("npz", tmp_path, **options):
        assert (episode.fps, episode.task, episode.depth, episode.states) == (5.0, "push", {}, None)
        np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3, 4])
        assert episode.meta["actions"] == {"kind": "absolute", "held": [1], "quaternions": []}
    after = read_first("npz", tmp_path / "0.npz", **options, after=True)
    np.testing.assert_array_equal(after.actions[:, 0], [0, 2, 3, 4, 5])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": None}, r"frames is none \(\), should be uint8"),
        ({"frames": np.zeros((COUNT, 3, 6, 8), np.uint8)}, r"frames is uint8 \(5, 3, 6, 8\), should be uint8"),
        ({"frames": np.zeros((COUNT, 6, 8, 3))}, r"frames is float64"),
        ({"actions": None}, "actions is missing, should be numbers"),
        ({"actions": np.zeros((COUNT - 2, 3))}, "actions has 3 rows, timestamps 5"),
        ({"actions": np.full((COUNT, 1), np.nan)}, "actions of frame 1 is not finite"),
        ({"depth": np.zeros((COUNT, 6, 8), np.int64)}, r"depth is int64 \(5, 6, 8\), should be floats or uint16"),
        ({"task": np.array([None])}, "task is of Python objects, which are not read; save the file again with numbers"),
        ({"task": 3}, "task is int64"),
        ({"fps": 0}, "fps is array"),
        ({"fps": None}, "does not say how fast its pictures are; add fps to it, or say --option fps"),
        ({"kind": "relative"}, "kind is 'relative'"),
        ({"timestamps": np.zeros(COUNT)}, "timestamps do not increase at frame 1"),
        ({"success": [True]}, r"success is bool \(1,\)"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "a.npz", **changes)
    with pytest.raises(EpisodeError, match=f"a.npz: {message}"):
        read_first("npz", path)


def test_an_array_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.npz")
    with zipfile.ZipFile(path, "a") as archive, archive.open("state.npy", "w") as file:
        header = {"shape": (2**40, 1), "fortran_order": False, "descr": "<f8"}
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(EpisodeError, match="state has 8796093022208 bytes unpacked"):
        read_first("npz", path)


def test_nothing_to_read_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no \*.npz files"):
        open_source("npz", tmp_path)


@settings(max_examples=30)
@given(data=st.data())
def test_damage_is_harmless_or_an_episodes_error(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = write(tmp_path_factory.mktemp("npz") / "a.npz", data.draw(st.booleans()))
    payload = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(payload[: data.draw(st.integers(0, len(payload)))])
    with contextlib.suppress(EpisodeError):
        read_first("npz", path).cameras["main"].read([0])
