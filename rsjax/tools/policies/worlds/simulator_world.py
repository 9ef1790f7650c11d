"""Lift in the simulator as a world, so that a policy can act in what clips recorded.

One step is one frame at the clips' rate. An action is like a clip's: ``control_steps`` controls of 7 numbers
(docs/policies.md). Frames are rendered as in clips, so replaying a clip's actions from its start gives its frames.

Axes: B episodes, S×S pixels, A = k·D action dimensions of k control steps.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from rsjax.config import SimConfig, content_key, require
from rsjax.progress import note
from rsjax.tools.policies.worlds.actions import PANDA_UNIT, ActionRange
from rsjax.tools.policies.worlds.world import EpisodeRecord, WorldState
from rsjax.tools.sim.episode import Simulator
from rsjax.tools.sim.expert import LiftState
from rsjax.tools.sim.lift import LiftSim

Control: TypeAlias = Callable[[LiftState], Float[np.ndarray, " D"]]  # from the simulator's state, at each control step


class SimulatorWorld:
    """Episodes in simulators, which start from seeds.

    An episode whose simulation diverges keeps its last state and does not succeed; a note says so.

    Args:
        simulators: one for each episode.
        control_steps: k.
        width: D, the numbers of a control.
        key: a hash of the simulators' settings.

    Attributes:
        diverged: the errors of the episodes that diverged, by their numbers.
    """

    validation = None

    def __init__(self, simulators: Sequence[Simulator], control_steps: int, width: int, key: str = "simulator") -> None:
        self.simulators = list(simulators)
        self.key = key
        self.diverged: dict[int, ArithmeticError] = {}
        self._controls = (control_steps, width)
        ones = np.ones(control_steps * width, np.float32)
        self.actions = ActionRange(-ones, ones, PANDA_UNIT)
        self._views: list[Any] = []
        self._success: list[bool] = []

    @classmethod
    def lift(cls, config: SimConfig, count: int) -> "SimulatorWorld":
        """Opens ``count`` simulators of Lift with the camera, image size and control steps of clips.

        Raises:
            GLError: no OpenGL context can be made.
            ConfigError: there is no such camera, or the clips are of another simulator.
        """
        require(config.env == "lift", f"sim.env is {config.env}; only lift can be acted in so far")
        with ExitStack() as opened:
            simulators = [opened.enter_context(LiftSim(config.camera, config.image_size)) for _ in range(count)]
            opened.pop_all()
        return cls(
            simulators, config.control_steps, config.action_dim // config.control_steps, content_key("lift", config)
        )

    @property
    def count(self) -> int:
        return len(self.simulators)

    def close(self) -> None:
        """Frees the renderers and the simulations."""
        for simulator in self.simulators:
            simulator.close()

    def reset(self, starts: Sequence[int], which: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        """Begins an episode from each seed (0 … 2³² - 1), which determines the arm's start and the cube's place."""
        if which is None:
            self.diverged = {}
            self._views = [None] * len(starts)
            self._success = [False] * len(starts)
            which = np.ones(len(starts), bool)
        for number, seed in zip(np.flatnonzero(which).tolist(), starts, strict=True):
            self.diverged.pop(number, None)
            self.simulators[number].reset(int(seed))
            self._look(number)
        return self._state(np.zeros((len(self._views), *self._controls), np.float32), np.zeros(len(self._views), int))

    def step(
        self, actions: Float[np.ndarray, "B A"] | Sequence[Control], ignored: Bool[np.ndarray, " B"] | None = None
    ) -> WorldState:
        """Runs one frame's control steps of each episode that is not ignored.

        Args:
            actions: (B, A), or a control for each episode, which is called at each control step.

        Raises:
            ActionError: the actions have the wrong shape, or a value that is not finite.
        """
        count = len(self._views)
        controls = np.zeros((count, *self._controls), np.float32)
        clipped = np.zeros(count, int)
        scripted = isinstance(actions, list) and all(map(callable, actions))
        if not scripted:
            rows, outside = self.actions.clip(actions, count, ignored=ignored)
            controls = rows.reshape(controls.shape)
            clipped = outside.sum(1)
        for number, simulator in enumerate(self.simulators[:count]):
            if number in self.diverged or (ignored is not None and ignored[number]):
                controls[number] = 0
                clipped[number] = 0
                continue
            try:
                for control in controls[number]:
                    if scripted:
                        control[:] = actions[number](simulator.state)  # type: ignore[operator]
                    simulator.step(control)
            except ArithmeticError as error:
                note(f"{error}; the episode stays as it was, and does not succeed")
                self.diverged[number] = error
                controls[number] = 0
                clipped[number] = 0
            else:
                self._look(number)
        return self._state(controls, clipped)

    def unfamiliarity(self, episodes: Sequence[EpisodeRecord], frames: int) -> list[float]:
        return []

    def _look(self, number: int) -> None:
        self._views[number] = self.simulators[number].render()
        self._success[number] = bool(self.simulators[number].success)

    def _state(self, controls: Float[np.ndarray, "B k D"], clipped: np.ndarray) -> WorldState:
        observation = {
            "rgb": np.stack([view.rgb for view in self._views]),
            "depth": np.stack([view.depth for view in self._views]),
        }
        return WorldState(observation, np.array(self._success), controls.reshape(len(controls), -1), clipped)
