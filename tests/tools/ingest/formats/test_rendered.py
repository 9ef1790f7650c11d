"""Demos without pictures: their simulator states are rendered."""

import importlib.util
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rsjax.tools.ingest.episode import EpisodeError, SourceError
from rsjax.tools.ingest.formats import open_source
from rsjax.tools.ingest.formats.rendered import FAR
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.toy_demos import demo, write_demos
from tests.tools.sim.test_playback import scene

COUNT = 5
WALL = '<geom group="1" type="box" size="3 3 .1" pos="0 0 -30" rgba="0 0 1 1"/>'


def write_states(path: Path, model: str, **changes: np.ndarray) -> Path:
    """A ball that moves to the right."""
    arrays: dict[str, Any] = {"states": np.zeros((COUNT, 3)), "actions": demo(COUNT)["actions"]}
    arrays["states"][:, 1] = np.linspace(-0.5, 0.5, COUNT)
    write_demos(path, {"demo_1": arrays | changes}, env_info={"env_name": "Ball", "control_freq": 10})
    with h5py.File(path, "a") as file:
        file["data/demo_1"].attrs["model_file"] = model
    return path


def test_states_become_pictures_and_depth(gl: str, tmp_path: Path) -> None:
    model = scene(more=WALL).replace('size="2 2 .1"', 'size=".5 .5 .1"')
    path = write_states(tmp_path / "demo.hdf5", model)
    episode = pickle.loads(pickle.dumps(read_first("robomimic", path, size=32)))
    assert (episode.task, list(episode.cameras), list(episode.depth)) == ("Ball", ["agentview"], ["agentview"])
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3, 4])  # states[t] was recorded before actions[t]
    pictures, maps = (frames["agentview"].read([4, 0]) for frames in (episode.cameras, episode.depth))
    assert pictures.shape == (2, 32, 32, 3) and pictures.dtype == np.uint8
    red = pictures[..., 0].astype(int) - pictures[..., 2]
    assert [np.argwhere(row > 50)[:, 1].mean() > 16 for row in red] == [True, False]
    assert maps.dtype == np.float32 and maps.max() < FAR and (maps == 0).any(), "what is far was not measured"


def test_an_older_demo_keeps_its_model_in_a_file(gl: str, tmp_path: Path) -> None:
    path = write_states(tmp_path / "demo.hdf5", "model_1.xml")
    with pytest.raises(SourceError, match="model_file: missing"):
        open_source("robomimic", path)
    (tmp_path / "models").mkdir()
    (tmp_path / "models/model_1.xml").write_text(scene())
    assert len(read_first("robomimic", path).cameras["agentview"]) == COUNT


def test_what_cannot_be_rendered_is_refused_with_the_cure(gl: str, tmp_path: Path) -> None:
    path = write_states(tmp_path / "a.hdf5", scene('<mesh file="/etc/passwd"/>'))
    cure = "render the file with robomimic's dataset_states_to_obs.py"
    with pytest.raises(SourceError, match=f"a.hdf5: data/demo_1: the model names the file '/etc/passwd'.*{cure}"):
        open_source("robomimic", path)
    path = write_states(tmp_path / "b.hdf5", scene(), states=np.zeros((COUNT, 9)))
    with pytest.raises(EpisodeError, match=f"b.hdf5: data/demo_1: a state has 9 numbers, the model takes 3.*{cure}"):
        read_first("robomimic", path).cameras["agentview"].read([0])
    path = write_states(tmp_path / "c.hdf5", scene(), states=np.zeros((COUNT + 1, 3)))
    with pytest.raises(EpisodeError, match="camera agentview has 6 rows, timestamps 5"):
        read_first("robomimic", path)


def test_robosuites_own_demos_are_read(gl: str) -> None:
    package = importlib.util.find_spec("robosuite")
    assert package is not None and package.origin is not None
    path = Path(package.origin).parent / "models/assets/demonstrations/lift/demo.hdf5"
    episode = read_first("robomimic", path)
    assert (episode.task, episode.fps, list(episode.cameras)) == ("Lift", 20, ["agentview", "robot0_eye_in_hand"])
    assert len(episode.cameras["agentview"]) == len(episode.actions) == 482


def test_the_renderer_is_gone_before_the_interpreter(gl: str, tmp_path: Path) -> None:
    path = write_states(tmp_path / "demo.hdf5", scene())
    code = f"""
from tests.tools.ingest.formats.reading import read_first
print(read_first("robomimic", {str(path)!r}, size=16).cameras["agentview"].read([0]).shape)"""
    root = Path(__file__).parents[4]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert (done.stdout.strip(), done.stderr) == ("(1, 16, 16, 3)", "")
