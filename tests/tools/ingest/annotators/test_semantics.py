import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.ingest.annotators.semantics import OwnSemantics, gripper_changes
from rsjax.tools.ingest.episode import Segment
from tests.tools.ingest.videos import episode, sliding

FRAMES = sliding(20, (0, 0), (8, 8))
PARTS = (Segment(0, 10, "reach", "Reach"), Segment(10, 20, ""))


def grip(*closed):
    command = np.full(20, -1.0, np.float32)
    for start, end in closed:
        command[start:end] = 1.0
    return command


def test_text_is_the_data_sets_own():
    semantics = OwnSemantics()(episode(FRAMES, "tidy up", PARTS), "top")
    assert [(part.text, part.skill, part.text_by) for part in semantics.parts] == [
        ("reach", "Reach", "segment"),
        ("tidy up", "", "task"),
    ]


def test_without_language_no_text_is_made_up():
    (part,) = OwnSemantics()(episode(FRAMES), "top").parts
    assert (part.start, part.end, part.text, part.text_by) == (0, 20, "", "")


def test_key_frames_are_where_the_gripper_closes_and_opens():
    recording = episode(FRAMES, "tidy up", PARTS, grip((4, 13)))
    parts = OwnSemantics()(recording, "top", np.ones(20)).parts
    assert [(part.key_frames, part.key_by) for part in parts] == [((4,), "gripper"), ((13,), "gripper")]


def test_without_a_gripper_the_peak_of_motion_counts_and_without_motion_nothing():
    motion = np.zeros(20)
    motion[4:9] = [1, 2, 5, 2, 1]
    parts = OwnSemantics()(episode(FRAMES, "", PARTS), "top", motion).parts
    assert [(part.key_frames, part.key_by) for part in parts] == [((6,), "motion"), ((), "")]


def test_row_0_is_no_change():
    command = grip((0, 20))
    command[0] = 0.0
    assert gripper_changes(episode(FRAMES, grip=command), 0.1) == []


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_slow_and_noisy_gripper_changes_once(noise):
    rng = np.random.default_rng(0)
    command = np.clip(np.linspace(-2, 2, 20), -1, 1) + rng.uniform(-noise, noise, 20)
    assert len(gripper_changes(episode(FRAMES, grip=command.astype(np.float32)), 0.1)) == 1


def test_a_gripper_that_hardly_moves_is_not_used():
    assert gripper_changes(episode(FRAMES, grip=grip((4, 13)) * 0.01), 0.1) == []


@given(st.lists(st.sampled_from([-1.0, 1.0]), min_size=20, max_size=20))
def test_every_flip_of_a_clean_command_is_found(values):
    command = np.array(values, np.float32)
    wanted = [t for t in range(2, 20) if command[t] != command[t - 1]]
    assert gripper_changes(episode(FRAMES, grip=command), 0.1) == wanted
