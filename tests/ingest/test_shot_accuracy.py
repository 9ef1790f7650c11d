from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from rsjax.errors import UserError
from rsjax.ingest.annotators.protocols import ArrayFrames
from rsjax.ingest.annotators.shots import HistogramShots, spans_between
from rsjax.ingest.shot_accuracy import ShotAccuracy, main, pictures_of, shot_accuracy

BRIDGE = Path(__file__).parents[3] / "shared" / "data" / "bridge"
EPISODES = [np.full((20, 8, 8, 3), 80 * number, np.uint8) for number in range(4)]


@dataclass(frozen=True)
class Says:
    """Says that cuts are in these frames of a long video, and none in a short one."""

    name: ClassVar[str] = "says"
    version: ClassVar[int] = 1
    cuts: tuple[int, ...]

    def __call__(self, frames):
        return spans_between([cut for cut in self.cuts if len(frames) > 20], len(frames))


def test_cuts_are_counted_as_exact_near_or_false():
    assert shot_accuracy(Says((20, 41, 70)), EPISODES) == ShotAccuracy(cuts=3, exact=1, near=2, false=1, inside=0)
    assert shot_accuracy(Says(()), EPISODES) == ShotAccuracy(cuts=3, exact=0, near=0, false=0, inside=0)


def test_the_default_finds_what_is_plain_to_see():
    assert shot_accuracy(HistogramShots(), EPISODES) == ShotAccuracy(cuts=3, exact=3, near=3, false=0, inside=0)
    assert len(HistogramShots()(ArrayFrames(EPISODES[1]))) == 1


@pytest.mark.skipif(not BRIDGE.exists(), reason="needs shared/data/bridge")
def test_it_measures_a_data_set(capsys):
    main(["rlds", str(BRIDGE), "--camera", "image_0"])
    assert "cuts=24, exact=6, near=6, false=0, inside=0" in capsys.readouterr().out
    with pytest.raises(UserError, match="no episode has a camera 'none'"):
        pictures_of("rlds", str(BRIDGE), "none")
