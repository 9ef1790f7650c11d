from pathlib import Path

import numpy as np
import pytest

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.reading import read_first
from tests.tools.ingest.formats.toy_demos import SIDE, demo, write_demos


def libero_demo(count: int = 4) -> dict[str, np.ndarray]:
    return demo(count, bottom_first=True, ending="_rgb")


def test_pictures_and_depth_are_flipped_upright_and_mirrored_only_if_asked(tmp_path: Path) -> None:
    maps = np.ones((4, SIDE, SIDE, 1), np.float32)
    maps[:, -1, 0] = 3  # upper left: the bottom row comes first
    path = tmp_path / "libero_goal" / "open_the_drawer_demo.hdf5"
    write_demos(path, {"demo_0": libero_demo() | {"obs/agentview_depth": maps}})
    for half_turn, corner in ((False, (0, 0)), (True, (0, SIDE - 1))):
        episode = read_first("libero", tmp_path, depth=True, half_turn=half_turn)
        picture = episode.cameras["agentview"].read([1])[0, ..., 0]
        assert np.argwhere(picture == 255).tolist() == [list(corner)]
        assert np.argwhere(episode.depth["agentview"].read([1])[0] == 3).tolist() == [list(corner)]


def test_opengls_depth_buffer_is_not_taken_for_metres(tmp_path: Path) -> None:
    maps = np.full((4, SIDE, SIDE, 1), 0.98, np.float32)
    write_demos(tmp_path / "a_demo.hdf5", {"demo_0": libero_demo() | {"obs/agentview_depth": maps}})
    with pytest.raises(EpisodeError) as raised:
        read_first("libero", tmp_path, depth=True)
    assert "data/demo_0/obs/agentview_depth is OpenGL's depth buffer, from 0 to 1" in str(raised.value)
    assert not read_first("libero", tmp_path).depth


def test_an_action_stands_with_the_frame_that_was_recorded_after_it(tmp_path: Path) -> None:
    path = write_demos(tmp_path / "a_demo.hdf5", {"demo_0": libero_demo()})
    episode = read_first("libero", path)
    assert episode.cameras["agentview"].read(range(4))[:, 3, 3, 0].tolist() == [10, 11, 12, 13]
    # Action t of the file is t + 1 and led into frame t; the first one's start was not recorded.
    np.testing.assert_array_equal(episode.actions[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(np.asarray(episode.states)[:, 0], [0, 10, 20, 30])
    assert episode.fps == 20.0
    before = read_first("libero", path, after=False)
    np.testing.assert_array_equal(before.actions[:, 0], [0, 1, 2, 3])
    assert before.task == episode.task == "a"


def test_the_task_is_what_is_said_or_the_name_of_the_file(tmp_path: Path) -> None:
    write_demos(tmp_path / "a_demo.hdf5", {"demo_0": libero_demo()}, problem_info={"language_instruction": "lift it"})
    write_demos(tmp_path / "open_the_drawer_demo.hdf5", {"demo_0": libero_demo()})
    source = open_source("libero", tmp_path)
    assert [source.read(ref).task for ref in source.episodes()] == ["lift it", "open the drawer"]
