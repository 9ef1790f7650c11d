"""Measures by how many recorded frames a robot's commands act later than its format says.

A robot moves a moment after a command, and its camera shows the motion later still. A format documents which command
followed which picture, not how long that takes. If a clip's action leads into the frame before the one that shows it,
a world model has to find the right one among its neighbours, and the first motion of a clip has no cause at all.

Axes: N motions of all episodes, A numbers of an action, T sampled frames of an episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rsjax.tools.ingest.actions import ActionConfig, ActionLayout, sampled_actions
from rsjax.tools.ingest.annotate import camera_of
from rsjax.tools.ingest.annotators.motion import DISFlow
from rsjax.tools.ingest.episode import Episode, EpisodeError

MOST_STEPS = 2  # of a clip, by which commands may be late
MOST_FRAMES = 60  # of an episode that are looked at
LEAST_MOTIONS = 40  # in at least three episodes; with fewer, nothing is measured
SIDE = 128  # pixels
FASTEST = 0.05  # share of the pixels whose mean flow is the motion
RIDGE = 5.0
LEAST_EXPLAINED = 0.1  # of the motion's variance by the commands
MARGIN = 0.07  # by which they have to explain more than as recorded; in simulated Lift a controller's lag brings 0.05


@dataclass(frozen=True)
class Delay:
    """The delay with which commands act.

    Attributes:
        explained: the share of the motion's variance that commands explain if they act 0, 1, 2, … recorded frames late;
            empty: too few motions.
    """

    explained: tuple[float, ...]

    @property
    def frames(self) -> int:
        """The delay at which commands explain most, or 0 if that is not clearly more than without any."""
        if not self.explained:
            return 0
        best = int(np.argmax(self.explained))
        if self.explained[best] < max(LEAST_EXPLAINED, self.explained[0] + MARGIN):
            return 0
        return best

    def __str__(self) -> str:
        if not self.explained:
            return "commands count as they are recorded: too few motions to measure a delay"
        shares = f"{max(0.0, self.explained[0]):.0%} of the motion as they are recorded"
        if not self.frames:
            return f"commands count as they are recorded, and explain {shares}"
        frames = "1 recorded frame"
        if self.frames > 1:
            frames = f"{self.frames} recorded frames"
        late = f"{max(0.0, self.explained[self.frames]):.0%} if they act {frames} later"
        return f"commands explain {shares}, and {late}; so clips have them (--delay 0: as they are recorded)"


def measure_delay(episodes: Sequence[Episode], camera: str, every: int) -> Delay:
    """Measures the delay: the one for which a linear function of the action explains most of the motion in the picture.

    Each episode's motions are predicted by ridge regression on the other episodes.

    Args:
        episodes: those of the training split, whose actions are declared as deltas or targets.
        camera: as of ``rsjax ingest``.
        every: recorded frames from one frame of a clip to the next.
    """
    delays = range(MOST_STEPS * every + 1)
    motions = []
    actions: list[list[Float[np.ndarray, "T A"]]] = [[] for _ in delays]
    numbers: list[int] = []
    known = slice(MOST_STEPS + 1, None)  # frames into which a command of the episode led at every delay
    for number, episode in enumerate(episodes):
        frames = np.arange(0, len(episode.timestamps), every)[:MOST_FRAMES]
        if episode.actions.shape[1] != episodes[0].actions.shape[1]:
            continue  # the ingest says what is wrong with it, here and below
        try:
            moved = motion(episode.cameras[camera_of(episode, camera)].read(frames.tolist()))[known]
        except EpisodeError:
            continue
        motions.append(moved)
        numbers += [number] * len(moved)
        for delay in delays:
            actions[delay].append(delayed(episode, frames, delay)[known])
    if len(numbers) < LEAST_MOTIONS or len(set(numbers)) < 3:
        return Delay(())
    target = np.concatenate(motions)
    return Delay(tuple(explained(np.concatenate(rows), target, np.array(numbers)) for rows in actions))


def delayed(episode: Episode, frames: Int[np.ndarray, " T"], delay: int) -> Float[np.ndarray, "T A"]:
    """Returns the change that was commanded for each of these frames if commands act ``delay`` recorded frames late."""
    layout = ActionLayout.from_json(episode.meta.get("actions", {}))
    config = ActionConfig(offset=delay)
    if layout.kind == "absolute":
        config = replace(config, kind="delta")
    return sampled_actions(episode.actions, frames, config, layout)


def motion(pictures: UInt8[np.ndarray, "T H W 3"]) -> Float[np.ndarray, "T 2"]:
    """Returns the mean flow of the fastest pixels into each frame, in pixels of a small picture; row 0 is zeros."""
    small = np.stack([cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for picture in pictures])
    moved = np.zeros((len(small), 2))
    if len(small) < 2:
        return moved
    flow = DISFlow()(small[:-1], small[1:]).reshape(len(small) - 1, -1, 2)
    count = int(FASTEST * flow.shape[1])
    for row, field in enumerate(flow):
        fastest = np.argpartition(np.linalg.norm(field, axis=-1), -count)[-count:]
        moved[row + 1] = field[fastest].mean(0)
    return moved


def explained(
    actions: Float[np.ndarray, "N A"], motions: Float[np.ndarray, "N 2"], episode: Int[np.ndarray, " N"]
) -> float:
    """Returns R², the share of the motions' variance that actions explain in episodes that the regression left out."""
    spread = actions.std(0)
    scaled = (actions - actions.mean(0)) / np.where(spread > 0, spread, 1)
    inputs = np.concatenate([scaled, np.ones((len(scaled), 1))], axis=1)
    errors = np.zeros_like(motions)
    for number in np.unique(episode):
        out = episode == number
        known = inputs[~out]
        weights = np.linalg.solve(known.T @ known + RIDGE * np.eye(known.shape[1]), known.T @ motions[~out])
        errors[out] = motions[out] - inputs[out] @ weights
    variance = np.sum((motions - motions.mean(0)) ** 2)
    if not variance:
        return 0.0
    return float(1 - np.sum(errors**2) / variance)
