"""Clips that begin in the middle of an episode: of free driving, and of a policy's attempts.

All other clips begin where an episode does, with the arm at its home pose, so that a model may take every first frame
for that pose. A rollout that is longer than a clip moves its window of frames, and the window's first frame then shows
the arm anywhere (:mod:`rsjax.models.roboscape.sample`).
"""

from dataclasses import replace

import numpy as np

from rsjax.tools.sim.episode import Manner
from rsjax.tools.sim.recipes.driving import driving
from rsjax.tools.sim.recipes.novices import novices

LEAD = (2, 40)  # frames of the episode before the clip's first one


def midway(rng: np.random.Generator, number: int) -> Manner:
    """Draws an episode of free driving or, if its number is odd, the attempts of one policy; both go on for ever."""
    if number % 2:
        return replace(novices(rng, number // 2), mode="midway")
    return replace(driving(rng, number // 2), mode="midway")
