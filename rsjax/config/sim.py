"""Settings of the simulator's episodes."""

import math
from dataclasses import dataclass
from typing import Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import require, require_range
from rsjax.config.metaworld import ML45, ML45_UNSEEN, TASKS
from rsjax.errors import did_you_mean

CONTROLS = {
    "lift": 7,
    "metaworld": 4,
    "rope": 7,
    "tabletop": 7,
}  # numbers of a control step: change of the pose (6-D, or position alone) and gripper
ROPE_TASKS = ("rope", "rod")  # soft and rigid, alike in all else
TABLETOP_TASKS = ("cube", "can", "bread", "milk")  # which of the objects on the table goes into the basket


EXPERT = "expert"  # the scripted expert, the only one of the recipes that Meta-World has too
MIDWAY = "midway"  # the recipe whose clips begin in the middle of an episode
RECIPES = (EXPERT, "grasps", "pushes", "slips", "driving", "novices", MIDWAY)
RECORDED = "recorded:"  # precedes the path of a store of a policy's recorded episodes


@dataclass(frozen=True)
class SimConfig:
    """Episodes collected in a simulator (:mod:`rsjax.tools.sim`)."""

    episodes: int = 200  # those of the test split included; more where training clips are learned by heart
    test_episodes: int = 20  # the last ones collected, never used in training
    frames: int = 16  # of a clip, as in the paper
    # Control steps between frames, at 20 Hz, and 80 Hz in metaworld; a frame's action is their concatenation.
    control_steps: int = 4
    image_size: int = 64  # pixels a side; 256 in the paper
    camera: str = "agentview"  # near: our own, in which objects and gripper are larger
    tracks: int = 256  # N₀: dense keypoint tracks per clip, of which the loss takes the K that move most
    # Where tracks start. grid: evenly over the image, as in the paper, which avoids segmentation on purpose.
    # objects: up to half on a grid, the others on the objects and the arm's moving links, found by segmentation.
    track_points: Literal["grid", "objects"] = "grid"
    seed: int = 0  # of the scenes and the motions
    # lift: one cube to lift; metaworld: up to 50 tasks; rope: a rope and a rigid rod; tabletop: four objects, a basket
    env: Literal["lift", "metaworld", "rope", "tabletop"] = "lift"
    tasks: tuple[str, ...] = ()  # none: the 45 training tasks of Meta-World's ML45, or all of another scene
    unseen_tasks: tuple[str, ...] = ()  # for the protocol "unseen"; none: in Meta-World the 5 that ML45 holds out
    # What the training episodes show, each with its share: expert, grasps, pushes, slips, driving, novices,
    # midway, or recorded:PATH, such as expert=0.6 grasps=0.4. The test split is the expert's, whatever the recipe.
    recipe: tuple[str, ...] = (EXPERT,)
    # wrist: each frame also has the picture of the camera on the Panda's hand, of the same size, without depth.
    second_view: Literal["off", "wrist"] = "off"

    def __post_init__(self) -> None:
        require(self.frames >= 2, f"sim.frames is {self.frames}; a clip needs at least 2 frames")
        require(
            0 < self.test_episodes < self.episodes,
            f"sim.test_episodes is {self.test_episodes}; it must lie between 1 and sim.episodes - 1 "
            f"({self.episodes - 1}), so that both splits have clips",
        )
        require_range(self, "sim", 1, math.inf, "control_steps", "image_size", "tracks")
        named = {"tasks": self.tasks, "unseen_tasks": self.unseen_tasks}
        for field, tasks in named.items():
            for task in tasks:
                require(
                    self.env != "lift",
                    f"sim.{field} names {task!r}, but sim.env is {self.env}, which has one task",
                )
                known = {"metaworld": TASKS, "rope": ROPE_TASKS, "tabletop": TABLETOP_TASKS}[self.env]
                scene = {"metaworld": "Meta-World"}.get(self.env, self.env)
                require(task in known, f"sim.{field} names {task!r}, no task of {scene}{did_you_mean(task, known)}")
        require(self.env != "metaworld" or self.camera != "agentview", _NO_AGENTVIEW)
        require(
            self.env != "metaworld" or self.second_view == "off",
            f"sim.second_view is {self.second_view}, but Meta-World's arm has no such camera here; leave it off",
        )
        both = sorted(set(self.train_tasks) & set(self.held_out_tasks))
        require(
            not both, f"sim.unseen_tasks has {', '.join(both)}, which sim.tasks trains on; a task is seen or unseen"
        )
        require(bool(self.recipe), f"sim.recipe is empty; name at least one of {', '.join(RECIPES)}")
        for entry in self.recipe:
            name, share = _parted(entry)
            require(
                name in RECIPES or name.startswith(RECORDED),
                f"sim.recipe names {name!r}{did_you_mean(name, RECIPES)} (recipes: {', '.join(RECIPES)}, "
                f"{RECORDED}PATH)",
            )
            require(0 < share < math.inf, f"sim.recipe has {entry!r}; a share must be a number above 0")
            require(
                self.env == "lift" or name == EXPERT,
                f"sim.recipe names {name!r}, but sim.env is {self.env}, which has {EXPERT} alone",
            )
        names = [_parted(entry)[0] for entry in self.recipe]
        require(len(set(names)) == len(names), f"sim.recipe is {' '.join(self.recipe)}; name each recipe once")

    @property
    def shares(self) -> dict[str, float]:
        """The recipes' shares of the training episodes, which sum to 1."""
        shares = dict(map(_parted, self.recipe))
        return {name: share / sum(shares.values()) for name, share in shares.items()}

    @property
    def one_start(self) -> bool:
        """Whether all clips begin where an episode does, with the robot in one place."""
        return MIDWAY not in self.shares

    @property
    def train_tasks(self) -> tuple[str, ...]:
        """The tasks of the train and test splits; empty in lift, which has only one task."""
        return self.tasks or {"metaworld": ML45, "rope": ROPE_TASKS, "tabletop": TABLETOP_TASKS}.get(self.env, ())

    @property
    def held_out_tasks(self) -> tuple[str, ...]:
        """The tasks that training never sees."""
        if self.env != "metaworld":
            return self.unseen_tasks
        return self.unseen_tasks or tuple(task for task in ML45_UNSEEN if task not in self.tasks)

    @property
    def action_dim(self) -> int:
        """Width of one frame's action: ``control_steps`` controls."""
        return CONTROLS[self.env] * self.control_steps

    @property
    def clips(self) -> ClipShape:
        """The shape of its clips; each episode is one clip."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_episodes)


def _parted(entry: str) -> tuple[str, float]:
    """Returns name and share of an entry ``NAME=SHARE``, or of ``NAME``, whose share is 1; NaN if it is no number."""
    name, found, share = entry.rpartition("=")
    if not found:
        return entry, 1.0
    try:
        return name, float(share)
    except ValueError:
        return name, math.nan


_NO_AGENTVIEW = "sim.camera is 'agentview', which Meta-World does not have; choose near, or one of its own, e.g. corner"
