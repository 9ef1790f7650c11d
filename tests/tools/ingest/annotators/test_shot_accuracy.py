import numpy as np

from rsjax.tools.ingest.annotators.shots import spans_between
from tests.bridge import BRIDGE, needs_bridge
from tests.tools.ingest.annotators.shot_accuracy import ShotAccuracy, main, shot_accuracy

EPISODES = [np.full((20, 8, 8, 3), 80 * number, np.uint8) for number in range(4)]


def says(*cuts):
    """Detects these cuts in a long video, and none in a short one."""
    return lambda frames: spans_between([cut for cut in cuts if len(frames) > 20], len(frames))


def test_cuts_are_counted_as_exact_near_or_false():
    assert shot_accuracy(says(20, 41, 70), EPISODES) == ShotAccuracy(cuts=3, exact=1, near=2, false=1, inside=0)
    assert shot_accuracy(says(), EPISODES) == ShotAccuracy(cuts=3, exact=0, near=0, false=0, inside=0)


@needs_bridge
def test_it_measures_a_data_set(capsys):
    main(["rlds", str(BRIDGE), "--camera", "image_0"])
    assert "cuts=24, exact=6, near=6, false=0, inside=0" in capsys.readouterr().out
