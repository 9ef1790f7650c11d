"""Paired grasps at several heights: the same start and approach, then fingers that close low or high, near or beside.

Most grasps of other recipes close within a few millimetres of one height, or so far above the cube that they miss it. A
model that has seen only these takes every grasp that is a little higher for a miss.
"""

from dataclasses import replace

import numpy as np

from rsjax.tools.sim.recipes.grasps import GraspManner, grasps

# From the cube's centre to the point where the fingers close, metres: an interval for either choice.
BESIDE = ((0.0, 0.012), (0.015, 0.035))
HEIGHT = ((-0.012, 0.002), (0.008, 0.034))
GROUP = len(BESIDE) * len(HEIGHT)


def heights(rng: np.random.Generator, number: int) -> GraspManner:
    """Draws a group of grasps, and returns one of it: its ``offset`` alone depends on the episode's number."""
    manner = grasps(rng, number)
    angle = rng.uniform(0, 2 * np.pi)
    distances = [rng.uniform(*interval) for interval in BESIDE]
    levels = [rng.uniform(*interval) for interval in HEIGHT]
    beside, level = divmod(number % GROUP, len(HEIGHT))
    x, y = distances[beside] * np.array([np.cos(angle), np.sin(angle)])
    return replace(manner, mode="heights", offset=(float(x), float(y), levels[level]))
