import contextlib
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import EpisodeError
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
    after = read_first("npz", tmp_path / "0.npz", **options, after=True, angles=[0])
    np.testing.assert_array_equal(after.actions[:, 0], [1, 2, 3, 4, 5])
    assert after.meta["actions"]["angles"] == [0]


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
