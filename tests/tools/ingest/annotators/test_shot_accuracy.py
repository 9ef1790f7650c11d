from pathlib import Path

import numpy as np
import pytest

from rsjax.tools.ingest.annotators.shots import HistogramShots, spans_between
from tests.tools.ingest.annotators.shot_accuracy import ShotAccuracy, main, shot_accuracy

BRIDGE = Path(__file__).parents[5] / "shared" / "data" / "bridge"
EPISODES = [np.full((20, 8, 8, 3), 80 * number, np.uint8) for number in range(4)]


def says(*cuts):
    """Detects these cuts in a long video, and none in a short one."""
    return lambda frames: spans_between([cut for cut in cuts if len(frames) > 20], len(frames))


def test_cuts_are_counted_as_exact_near_or_false():
    assert shot_accuracy(says(20, 41, 70), EPISODES) == ShotAccuracy(cuts=3, exact=1, near=2, false=1, inside=0)
    assert shot_accuracy(says(), EPISODES) == ShotAccuracy(cuts=3, exact=0, near=0, false=0, inside=0)


def test_the_default_detects_plain_cuts():
    assert shot_accuracy(HistogramShots(), EPISODES) == ShotAccuracy(cuts=3, exact=3, near=3, false=0, inside=0)


@pytest.mark.skipif(not BRIDGE.exists(), reason="needs shared/data/bridge")
def test_it_measures_a_data_set(capsys):
    main(["rlds", str(BRIDGE), "--camera", "image_0"])
    assert "cuts=24, exact=6, near=6, false=0, inside=0" in capsys.readouterr().out
