import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.toy_demos import SIDE, demo, write_demos

ENVIRONMENT = {"env_name": "Lift", "env_kwargs": {"control_freq": 10}}


def test_an_action_stands_with_the_frame_that_it_led_into(tmp_path: Path) -> None:
    path = write_demos(tmp_path / "lift.hdf5", {"demo_0": demo()}, env_args=ENVIRONMENT)
    source = pickle.loads(pickle.dumps(open_source("robomimic", path)))
    (ref,) = source.episodes()
    episode = source.read(ref)
    frames = episode.cameras["agentview"].read([3, 0, 3])
    assert frames[:, 3, 3, 0].tolist() == [13, 10, 13] and frames[0, 0, 0, 0] == 255
    # Action t of the file is t + 1, given at frame t: it led into frame t + 1. The last led to a frame not recorded.
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(np.asarray(episode.states)[:, 0], [0, 10, 20, 30])
    assert (episode.task, episode.fps, episode.depth) == ("Lift", 10.0, {})
    np.testing.assert_allclose(episode.timestamps, [0, 0.1, 0.2, 0.3])


def test_demos_are_sorted_by_number_and_chosen_by_a_filter(tmp_path: Path) -> None:
    demos = {f"demo_{number}": demo(2) for number in (10, 2, 1, 0)}
    path = write_demos(tmp_path / "a.hdf5", demos, {"train": ["demo_10", "demo_2"]})
    for chosen, numbers in (("", (0, 1, 2, 10)), ("train", (2, 10))):
        refs = open_source("robomimic", path, filter=chosen).episodes()
        assert [ref.location["demo"] for ref in refs] == [f"demo_{number}" for number in numbers]


def test_depth_is_taken_when_asked(tmp_path: Path) -> None:
    depth = np.arange(4.0)[:, None, None, None] * np.ones((4, SIDE, SIDE, 1)) + 0.5
    path = write_demos(tmp_path / "a.hdf5", {"demo_0": demo() | {"obs/agentview_depth": depth}})
    maps = read_first("robomimic", path, depth=True).depth["agentview"].read([2, 0])
    assert maps.shape == (2, SIDE, SIDE) and maps.dtype == np.float32 and maps[:, 1, 1].tolist() == [2.5, 0.5]


def test_quaternions_of_the_state_keep_their_sign(tmp_path: Path) -> None:
    turns = np.tile([0.0, 0.6, 0.0, 0.8], (4, 1)) * np.array([[1], [-1], [-1], [1]])
    path = write_demos(tmp_path / "a.hdf5", {"demo_0": demo() | {"obs/robot0_eef_quat": turns}})
    episode = read_first("robomimic", path)
    np.testing.assert_allclose(np.asarray(episode.states)[:, 3:7], [[0, 0.6, 0, 0.8]] * 4, atol=1e-6)
    assert episode.meta["notes"] == {"flipped": {"robot0_eef_quat": 2}}


@pytest.mark.parametrize("place", ["data/demo_0", "data/demo_0/obs"])
def test_data_in_place_of_a_group_are_refused_one_by_one(tmp_path: Path, place: str) -> None:
    path = write_demos(tmp_path / "a.hdf5", {"demo_0": demo(), "demo_1": demo()})
    with h5py.File(path, "a") as file:
        del file[place]
        file[place] = np.zeros(3)
    source = open_source("robomimic", path)
    bad, good = source.episodes()
    assert len(source.read(good).timestamps) == 4
    with pytest.raises(EpisodeError):
        source.read(bad)


def test_an_unreadable_file_among_others_is_one_entry(tmp_path: Path) -> None:
    write_demos(tmp_path / "b.hdf5", {"demo_0": demo()})
    (tmp_path / "a.hdf5").write_bytes((tmp_path / "b.hdf5").read_bytes()[:900])
    (tmp_path / "loop").symlink_to(tmp_path, target_is_directory=True)
    source = open_source("robomimic", tmp_path)
    bad, good = source.episodes()
    assert len(source.read(good).timestamps) == 4
    with pytest.raises(EpisodeError, match="a.hdf5: not a readable HDF5 file"):
        source.read(bad)


@pytest.mark.parametrize(
    ("controller", "kind"),
    [
        ({"type": "OSC_POSE", "control_delta": True}, "delta"),
        ({"type": "OSC_POSE", "control_delta": False}, "absolute"),
        ([{"control_delta": False}], "absolute"),
        ({"body_parts": {"right": {"input_type": "absolute"}}}, "absolute"),
        (None, "delta"),
    ],
)
def test_the_controller_says_whether_commands_are_steps(tmp_path: Path, controller: object, kind: str) -> None:
    arguments = {"env_kwargs": {"controller_configs": controller}}
    path = write_demos(tmp_path / "a.hdf5", {"demo_0": demo()}, env_args=arguments)
    assert read_first("robomimic", path).meta["actions"] == {"kind": kind, "held": [6], "quaternions": []}
    own = write_demos(tmp_path / "b.hdf5", {"demo_0": demo()}, env_info={"controller_configs": controller})
    assert read_first("robomimic", own).meta["actions"]["kind"] == kind


def test_what_is_declared_replaces_what_the_controller_says(tmp_path: Path) -> None:
    path = write_demos(tmp_path / "a.hdf5", {"demo_0": demo()}, env_args=ENVIRONMENT)
    declared = read_first("robomimic", path, kind="absolute", held=[0, 6])
    assert declared.meta["actions"] == {"kind": "absolute", "held": [0, 6], "quaternions": []}
    assert declared.fingerprint != read_first("robomimic", path).fingerprint
    with pytest.raises(EpisodeError):
        read_first("robomimic", path, held=[7])


def test_a_demo_that_several_files_have_is_one_recording(tmp_path: Path) -> None:
    demos = {f"demo_{number}": demo() | {"states": np.full((4, 3), number)} for number in range(2)}
    for name in ("image", "low_dim"):
        write_demos(tmp_path / f"{name}.hdf5", demos)
    write_demos(tmp_path / "other.hdf5", {"demo_0": demo()})
    *shared, other = [ref.location["recording"] for ref in open_source("robomimic", tmp_path).episodes()]
    assert shared[:2] == shared[2:] and len({*shared, other}) == 3 and other == "other-demo_0"
