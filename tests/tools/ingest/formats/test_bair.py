import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.toy_tfrecord import Values, example, write_records

STEPS = 4


def episode_bytes(value: int = 0, **changes: Values | None) -> bytes:
    """Pixel (0, 1) of each picture is red as its step; action t is t + 1 in every dimension."""
    features: dict[str, Values | None] = {}
    for step in range(STEPS):
        for camera in ("image_main", "image_aux1"):
            pixels = np.full((64, 64, 3), value, np.uint8)
            pixels[0, 1, 0] = step + (100 if camera == "image_aux1" else 0)
            features[f"{step}/{camera}/encoded"] = [pixels.tobytes()]
        features[f"{step}/action"] = np.full(4, step + 1.0)
        features[f"{step}/endeffector_pos"] = np.full(3, step * 10.0)
    return example({name: values for name, values in (features | changes).items() if values is not None})


def write(folder: Path, *payloads: bytes) -> Path:
    name = f"traj_0_to_{len(payloads) - 1}.tfrecords"
    return write_records(folder / "softmotion30_44k" / "train" / name, payloads)


def test_pictures_actions_and_states_stand_where_they_belong(tmp_path: Path) -> None:
    write(tmp_path, episode_bytes(), episode_bytes(7))
    source = open_source("bair", tmp_path, fps=10.0)
    refs = list(source.episodes())
    episode = source.read(refs[1])
    pictures = episode.cameras["main"].read([3, 0])
    assert pictures.shape == (2, 64, 64, 3)
    assert pictures[:, 0, 1, 0].tolist() == [3, 0] and pictures[0, 5, 5].tolist() == [7, 7, 7]
    assert episode.cameras["aux1"].read([2])[0, 0, 1, 0] == 102
    # Action t of the file is t + 1 and leads from frame t into frame t + 1; the last leads nowhere.
    np.testing.assert_array_equal(episode.actions[:, 3], [0, 1, 2, 3])
    np.testing.assert_array_equal(np.asarray(episode.states)[:, 0], [0, 10, 20, 30])
    assert episode.fps == 10.0 and episode.timestamps[-1] == pytest.approx(0.3) and episode.task == ""


def test_files_come_in_the_order_of_their_trajectories(tmp_path: Path) -> None:
    for first in (1000, 256, 0):
        write_records(tmp_path / "train" / f"traj_{first}_to_{first + 1}.tfrecords", [episode_bytes(), episode_bytes()])
    (tmp_path / "again").symlink_to(tmp_path, target_is_directory=True)
    ids = [ref.id for ref in open_source("bair", tmp_path).episodes()]
    assert [name.split("_")[1] for name in ids] == ["0", "0", "256", "256", "1000", "1000"]
    assert len(set(ids)) == 6


def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path) -> None:
    path = write(tmp_path, *[episode_bytes()] * 60)
    source = open_source("bair", path)
    tracemalloc.start()
    for ref in source.episodes():
        source.read(ref).cameras["main"].read(range(STEPS))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert path.stat().st_size > 5e6 and most < 2e6
