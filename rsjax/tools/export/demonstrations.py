"""Simulates demonstrations of the tabletop, with the keys and numbers of openpi's data of LIBERO.

Row t has what is seen before control step t and the action of that step: ``image`` from before the arm, ``wrist_image``
from the hand, ``state`` (8 numbers) and ``actions`` (7 numbers). Only episodes that succeed are written, up to a few
steps after they do. The actions move the goal pose by up to 1.5 cm and 0.15 rad (:mod:`rsjax.tools.sim.panda`), where
LIBERO's ask for up to 5 cm and 0.5 rad from the current pose.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsjax.config.fields import require_range
from rsjax.errors import UserError
from rsjax.tools.export.lerobot import CONTROLS, LAYOUTS, new_data_set
from rsjax.tools.export.lerobot_files import LeRobotEpisode, VideoSettings, describe_features
from rsjax.tools.sim.panda import CONTROL_HZ
from rsjax.tools.sim.tabletop import OBJECTS, STEPS, TabletopSim, demonstration

CAMERAS = ("image", "wrist_image")
STATE = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right")
AFTER = 5  # control steps that an episode goes on after success
MOST_FAILURES = 5  # episodes in a row; more mean a broken installation


@dataclass(frozen=True)
class DemonstrationOptions:
    """The options of simulated demonstrations, and of how they are written.

    Attributes:
        demos: demonstrations; the tasks take turns.
        seed: of the scenes and motions.
        size: pixels along each side of both cameras' pictures.
        version: version of LeRobotDataset; openpi reads v2.1.
        codec: codec of the videos.
        crf: constant rate factor of the codec, 0 to 63 (av1) or 51 (h264): lower is larger and sharper.
    """

    demos: int = 40
    seed: int = 0
    size: int = 256
    version: Literal["v2.1", "v3.0"] = "v2.1"
    codec: Literal["av1", "h264"] = "h264"
    crf: int = 18

    def __post_init__(self) -> None:
        require_range(self, "export", 1, 10**6, "demos")
        require_range(self, "export", 16, 1024, "size")
        require_range(self, "export", 0, 63 if self.codec == "av1" else 51, "crf")


def export_libero(
    out: Path,
    options: DemonstrationOptions = DemonstrationOptions(),
    report: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Writes the demonstrations to ``out``, which appears only when they are complete.

    Args:
        report: called with (demonstrations done, demonstrations in all).

    Returns:
        The content of the data set's ``meta/info.json``.

    Raises:
        UserError: ``out`` exists, a side is odd, or ``MOST_FAILURES`` episodes in a row fail.
        GLError: there is no usable OpenGL library.
        FileError: the disk is full, or ``out`` cannot be written.
    """
    if options.size % 2:
        raise UserError(f"--size is {options.size}; videos need an even side")
    video = VideoSettings(options.codec, options.crf, CONTROL_HZ, options.size)
    features = describe_features(video, CAMERAS, {"state": STATE, "actions": CONTROLS})
    tasks = list(OBJECTS)
    failures = 0
    number = 0
    with new_data_set(out) as root, TabletopSim(camera="near", image_size=options.size) as sim:
        layout = LAYOUTS[options.version](root, video, features)
        while layout.episodes < options.demos:
            sim.task = tasks[layout.episodes % len(tasks)]
            episode = demonstrate(sim, np.random.default_rng([options.seed, number]))
            number += 1
            if episode is None:
                failures += 1
            else:
                failures = 0
                layout.add(episode)
                report(layout.episodes, options.demos)
            if failures == MOST_FAILURES:
                raise UserError(f"{failures} demonstrations in a row failed; check the installation with `make test`")
        splits = {"train": f"0:{layout.episodes}"}
        return layout.finish({"codebase_version": options.version, "robot_type": "panda", "splits": splits})


def demonstrate(sim: TabletopSim, rng: np.random.Generator) -> LeRobotEpisode | None:
    """Simulates one demonstration of the simulator's task; returns None if it fails."""
    sim.reset(int(rng.integers(2**32)))
    expert = demonstration(rng, sim.task).expert(rng)
    videos: dict[str, list[np.ndarray]] = {camera: [] for camera in CAMERAS}
    states = []
    actions = []
    left = STEPS
    succeeded = False
    while left:
        videos["image"].append(sim.render().rgb)
        videos["wrist_image"].append(sim.wrist_image)
        states.append(sim.robot_state)
        actions.append(expert.act(sim.state).astype(np.float32))
        sim.step(actions[-1])
        left -= 1
        if sim.success and not succeeded:
            succeeded = True
            left = min(left, AFTER)
    if not sim.success:
        return None
    columns = {"state": np.stack(states), "actions": np.stack(actions)}
    return LeRobotEpisode({name: np.stack(frames) for name, frames in videos.items()}, columns, sim.instruction)
