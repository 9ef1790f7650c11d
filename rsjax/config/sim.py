"""Settings of the simulator's episodes."""

import math
from dataclasses import dataclass
from typing import Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import require, require_range, runtime


@dataclass(frozen=True)
class SimConfig:
    """Lift episodes collected in the simulator (:mod:`rsjax.sim`)."""

    episodes: int = 200
    test_episodes: int = 20  # the last ones collected, never used in training
    frames: int = 16
    control_steps: int = 4  # 20 Hz control steps between frames; a frame's action is their concatenation
    image_size: int = 64
    camera: str = "agentview"  # near: our own, in which cube and gripper are larger
    tracks: int = 256  # N₀: dense keypoint tracks per clip
    # Where tracks start. grid: evenly over the image, as in the paper, which avoids segmentation on purpose.
    # objects: up to half on a grid, the others on the cube and the arm's moving links, found by segmentation.
    track_points: Literal["grid", "objects"] = "grid"
    seed: int = 0
    workers: int = runtime(0)  # 0: one process per core

    def __post_init__(self) -> None:
        require(self.frames >= 2, f"sim.frames is {self.frames}; a clip needs at least 2 frames")
        require(
            0 < self.test_episodes < self.episodes,
            f"sim.test_episodes is {self.test_episodes}; it must lie between 1 and sim.episodes - 1 "
            f"({self.episodes - 1}), so that both splits have clips",
        )
        require_range(self, "sim", 1, math.inf, "control_steps", "image_size", "tracks")
        require_range(self, "sim", 0, math.inf, "workers")

    @property
    def action_dim(self) -> int:
        """Width of one frame's action: ``control_steps`` controls of 7 (6-D pose delta, gripper)."""
        return 7 * self.control_steps

    @property
    def clips(self) -> ClipShape:
        """The shape of its clips; each episode is one clip."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_episodes)
