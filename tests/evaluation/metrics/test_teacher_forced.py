import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.registry import Scene, Unavailable
from rsjax.models.base import TeacherForced
from tests.evaluation.metrics.scored import per_frame, score

VIDEO = Video(np.zeros((2, 4, 8, 8, 3), np.uint8))
FRAMES = {"rgb": np.arange(6.0).reshape(2, 3), "depth": np.array([[1.0, 2.0, 6.0], [np.nan] * 3])}


@pytest.mark.parametrize("name", ["token_cross_entropy", "token_accuracy"])
def test_scores_are_means_over_frames_by_branch(name: str) -> None:
    other = {branch: -frames for branch, frames in FRAMES.items()}
    pair = (FRAMES, other) if name == "token_cross_entropy" else (other, FRAMES)
    scene = Scene(VIDEO, VIDEO, teacher_forced=TeacherForced(*pair))
    scores = score(name, scene)
    np.testing.assert_array_equal(scores[""], [1, 4])
    np.testing.assert_array_equal(scores["_depth"], [3])
    np.testing.assert_array_equal(per_frame(name, scene), FRAMES["rgb"])
    blind = {"rgb": FRAMES["rgb"], "depth": FRAMES["depth"] * np.nan}
    assert score(name, Scene(VIDEO, VIDEO, teacher_forced=TeacherForced(blind, blind))).keys() == {""}


def test_a_family_without_it_has_a_reason() -> None:
    with pytest.raises(Unavailable, match="predicts no tokens"):
        score("token_accuracy", Scene(VIDEO, VIDEO))
