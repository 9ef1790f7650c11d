"""Worlds, in which a policy acts: several episodes together, in the simulator or in a world model.

Axes: B episodes, T frames, S×S pixels, A action dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.tools.policies.judges.judge import UNINTERPRETABLE
from rsjax.tools.policies.worlds.actions import ActionRange

Observation: TypeAlias = dict[str, np.ndarray]  # "rgb": uint8 (B, S, S, 3); perhaps "depth": float32 (B, S, S), metres
Actor: TypeAlias = Callable[[Observation], Any]  # a policy in B episodes that began together: returns their actions
FIRST_SEED = 2**31  # of the test episodes; collected episodes have seeds from anywhere, so few coincide


@dataclass(frozen=True)
class WorldState:
    """The state of B episodes after a reset or a step.

    Attributes:
        observation: the current frames.
        success: whether the task is done, as the simulator or the judge says.
        actions: the actions that led here, after clipping; zeros after a reset.
        clipped: how many numbers of these actions were clipped.
        verdict: the judge's probability of each label; None without a judge.
        read: what the model's state heads read from the current frames (:data:`rsjax.data.state_labels.STATE`); None in
            the simulator and for a model without them.
    """

    observation: Observation
    success: Bool[np.ndarray, " B"]
    actions: Float32[np.ndarray, "B A"]
    clipped: Int[np.ndarray, " B"]
    verdict: Float[np.ndarray, "B 3"] | None = None
    read: Float[np.ndarray, "B 3"] | None = None


class World(Protocol):
    """At most ``count`` episodes that are stepped together.

    Attributes:
        actions: the actions that it takes.
    """

    actions: ActionRange

    @property
    def count(self) -> int: ...

    @property
    def key(self) -> str:
        """A hash of all that success depends on except policy and starts: the simulator, or model and judge."""
        ...

    @property
    def validation(self) -> dict[str, Any] | None:
        """The validation of the world's judge, if it has one that was validated."""
        ...

    def reset(self, starts: Sequence[Any], which: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        """Begins an episode from each start: a seed in the simulator, a :class:`FirstFrame` in a world model.

        Args:
            which: a mask of the episodes that begin again while the others stay as they are; by default all end, and
                as many begin as there are starts.
        """
        ...

    def step(self, actions: Any, ignored: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        """Clips the actions, generates or simulates the next frame of every episode, and judges it.

        Args:
            actions: (B, A); numbers out of range are clipped and counted.
            ignored: episodes whose actions do not matter, nor what becomes of them.

        Raises:
            ActionError: the actions have the wrong shape, or a value that is not finite.
        """
        ...

    def unfamiliarity(self, episodes: Sequence["EpisodeRecord"], frames: int) -> list[float]:
        """Returns how far episodes in a world model are from its training clips, as percentiles, 0 to 1.

        Empty in the simulator, and for a model whose distances are not measured.

        Args:
            frames: of the longest episode that may be; programs are compiled for this number.
        """
        ...


@dataclass(frozen=True)
class EpisodeRecord:
    """The record of one episode in a world.

    Attributes:
        rgb: all frames, including the first one.
        depth: of the same frames, metres; None if the world has none.
        actions: row t led to frame t; row 0 is zeros, as in clips.
        success: whether the task was done at each frame.
        clipped: how many numbers of the actions were clipped to their range.
        uninterpretable: whether the judge cannot interpret the last frame.
    """

    rgb: UInt8[np.ndarray, "T S S 3"]
    depth: Float32[np.ndarray, "T S S"] | None
    actions: Float32[np.ndarray, "T A"]
    success: Bool[np.ndarray, " T"]
    clipped: int
    uninterpretable: bool = False


def run_episodes(world: World, act: Actor, starts: Sequence[Any], steps: int) -> list[EpisodeRecord]:
    """Runs at most ``world.count`` episodes together, each until it succeeds or has had all its steps.

    Args:
        act: the policy, fresh for these episodes.

    Raises:
        ActionError: the policy returns actions of the wrong shape, or a value that is not finite.
    """
    state = world.reset(starts)
    states = [state]
    over = np.zeros(len(starts), bool)
    ends = np.full(len(starts), steps)
    for step in range(1, steps + 1):
        if over.all():
            break
        state = world.step(act(state.observation), ignored=over)
        states.append(state)
        ends[state.success & ~over] = step
        over = over | state.success
    episodes = []
    for number, end in enumerate(ends.tolist()):
        own = states[: end + 1]
        success = np.array([state.success[number] for state in own])
        success[0] = False  # the policy has done nothing yet, whatever a judge says of the first frame
        depth = None
        if "depth" in own[0].observation:
            depth = np.stack([state.observation["depth"][number] for state in own])
        verdict = own[-1].verdict
        episode = EpisodeRecord(
            rgb=np.stack([state.observation["rgb"][number] for state in own]),
            depth=depth,
            actions=np.stack([state.actions[number] for state in own]),
            success=success,
            clipped=int(sum(state.clipped[number] for state in own)),
            uninterpretable=verdict is not None and int(verdict[number].argmax()) == UNINTERPRETABLE,
        )
        episodes.append(episode)
    return episodes
