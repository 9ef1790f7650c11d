"""Lift in the simulator as a world, so that a policy can act in what clips recorded.

One step is one frame at the clips' rate. An action is like a clip's: ``control_steps`` controls of 7 numbers
(docs/policies.md). Frames are rendered as in clips, so replaying an episode's actions from its start gives its frames.

Axes: B episodes, S×S pixels, A = k·D action dimensions of k control steps.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from rsjax.config import SimConfig, content_key, require
from rsjax.progress import note
from rsjax.tools.policies.worlds.actions import PANDA_UNIT, ActionRange
from rsjax.tools.policies.worlds.simulator_processes import (
    Control,
    Order,
    Outcome,
    SimulatorProcesses,
    carry_out,
)
from rsjax.tools.policies.worlds.world import EpisodeRecord, WorldState
from rsjax.tools.sim.episode import Simulator
from rsjax.tools.sim.lift import LiftSim


class SimulatorWorld:
    """Episodes in simulators, which start from seeds.

    An episode whose simulation diverges keeps its last state and does not succeed; a note says so.

    Args:
        simulators: one for each episode, in this process or in several.
        control_steps: k.
        width: D, the numbers of a control.
        key: a hash of the simulators' settings.

    Attributes:
        simulators: those in this process.
        diverged: the errors of the episodes that diverged, by their numbers.
    """

    validation = None

    def __init__(
        self,
        simulators: Sequence[Simulator] | SimulatorProcesses,
        control_steps: int,
        width: int,
        key: str = "simulator",
    ) -> None:
        self.simulators: list[Simulator] = []
        self._processes: SimulatorProcesses | None = None
        if isinstance(simulators, SimulatorProcesses):
            self._processes = simulators
        else:
            self.simulators = list(simulators)
        self.count = len(simulators)
        self.key = key
        self.diverged: dict[int, ArithmeticError] = {}
        self._controls = (control_steps, width)
        ones = np.ones(control_steps * width, np.float32)
        self.actions = ActionRange(-ones, ones, PANDA_UNIT)
        self._states: dict[int, Outcome] = {}

    @classmethod
    def lift(cls, config: SimConfig, count: int, workers: int = 1) -> "SimulatorWorld":
        """Opens ``count`` simulators of Lift with the camera, image size and control steps of clips.

        Args:
            workers: processes that simulate, at most one for each simulator. 1: this process; only there can
                :class:`Control` act.

        Raises:
            GLError: no OpenGL context can be made.
            ConfigError: there is no such camera, or the clips are of another simulator.
            UserError: a process died.
        """
        require(config.env == "lift", f"sim.env is {config.env}; only lift can be acted in so far")
        opener = partial(LiftSim, config.camera, config.image_size)
        simulators: Sequence[Simulator] | SimulatorProcesses
        if min(workers, count) > 1:
            simulators = SimulatorProcesses(opener, count, min(workers, count))
        else:
            with ExitStack() as opened:
                simulators = [opened.enter_context(opener()) for _ in range(count)]
                opened.pop_all()
        controls = (config.control_steps, config.action_dim // config.control_steps)
        return cls(simulators, *controls, content_key("lift", config))

    def close(self) -> None:
        """Frees the renderers and the simulations."""
        if self._processes:
            self._processes.close()
        for simulator in self.simulators:
            simulator.close()

    def reset(self, starts: Sequence[int], which: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        """Begins an episode from each seed (0 … 2³² - 1), which determines the arm's start and the cube's place."""
        if which is None:
            self.diverged = {}
            self._states = {}
            which = np.ones(len(starts), bool)
        orders = dict(zip(np.flatnonzero(which).tolist(), map(int, starts), strict=True))
        for number in orders:
            self.diverged.pop(number, None)
        self._carry_out(orders)
        count = len(self._states)
        return self._state(np.zeros((count, *self._controls), np.float32), np.zeros(count, int))

    def step(
        self, actions: Float[np.ndarray, "B A"] | Sequence[Control], ignored: Bool[np.ndarray, " B"] | None = None
    ) -> WorldState:
        """Runs one frame's control steps of each episode that is not ignored.

        Args:
            actions: (B, A), or a control for each episode, which is called at each control step.

        Raises:
            ActionError: the actions have the wrong shape, or a value that is not finite.
            UserError: a process of the simulator died.
        """
        count = len(self._states)
        acting = [n for n in range(count) if n not in self.diverged and (ignored is None or not ignored[n])]
        controls = np.zeros((count, *self._controls), np.float32)
        clipped = np.zeros(count, int)
        orders: dict[int, Order]
        if isinstance(actions, list) and all(map(callable, actions)):
            require(not self._processes, "functions act only in simulators of this process: SimulatorWorld.lift(…, 1)")
            orders = {number: [actions[number]] * self._controls[0] for number in acting}
        else:
            rows, outside = self.actions.clip(actions, count, ignored=ignored)
            orders = {number: rows[number].reshape(self._controls) for number in acting}
            clipped[acting] = outside[acting].sum(1)
        self._carry_out(orders)
        for number in acting:
            if number in self.diverged:
                clipped[number] = 0
            else:
                controls[number] = self._states[number].controls
        return self._state(controls, clipped)

    def unfamiliarity(self, episodes: Sequence[EpisodeRecord], frames: int) -> list[float]:
        return []

    def _carry_out(self, orders: Mapping[int, Order]) -> None:
        if self._processes:
            outcomes = self._processes(orders)
        else:
            outcomes = {number: carry_out(self.simulators[number], order) for number, order in orders.items()}
        for number, outcome in outcomes.items():
            if isinstance(outcome, Outcome):
                self._states[number] = outcome
            else:
                note(f"{outcome}; the episode stays as it was, and does not succeed")
                self.diverged[number] = outcome

    def _state(self, controls: Float[np.ndarray, "B k D"], clipped: np.ndarray) -> WorldState:
        states = [self._states[number] for number in range(len(self._states))]
        observation = {
            "rgb": np.stack([state.rgb for state in states]),
            "depth": np.stack([state.depth for state in states]),
        }
        success = np.array([state.success for state in states])
        return WorldState(observation, success, controls.reshape(len(controls), -1), clipped)
