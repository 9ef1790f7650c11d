"""Simulators that carry out orders: begin an episode, or act for one frame. They share the cores as worker processes.

Axes: k controls of D numbers, S×S pixels.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.errors import UserError
from rsjax.processes import Helper, WorkerDied
from rsjax.tools.sim.episode import Simulator
from rsjax.tools.sim.expert import LiftState
from rsjax.tools.sim.gl import share_cores

SECONDS = 600.0  # for an answer; a frame takes a fraction of one, starting on a busy machine up to a minute

Control: TypeAlias = Callable[[LiftState], Float[np.ndarray, " D"]]  # from the simulator's state, at each control step
# A seed, with which an episode begins; or the controls of one frame, or functions that return them, in this process.
Order: TypeAlias = int | Sequence[Control] | Float[np.ndarray, "k D"]


@dataclass(frozen=True)
class Outcome:
    """The state of a simulator that has carried out an order.

    Attributes:
        rgb: the current frame.
        depth: of the same frame, metres.
        success: whether the task is done.
        controls: those that led here; none after a reset.
    """

    rgb: UInt8[np.ndarray, "S S 3"]
    depth: Float32[np.ndarray, "S S"]
    success: bool
    controls: Float32[np.ndarray, "k D"]


def carry_out(simulator: Simulator, order: Order) -> Outcome | ArithmeticError:
    """Carries out an order, and returns the error if the simulation diverges on the way."""
    done: list[np.ndarray] = []
    if isinstance(order, int):
        simulator.reset(order)
    else:
        try:
            for control in order:
                if callable(control):
                    done.append(np.asarray(control(simulator.state), np.float32))
                else:
                    done.append(control)
                simulator.step(done[-1])
        except ArithmeticError as error:
            return error
    view = simulator.render()
    return Outcome(view.rgb, view.depth, bool(simulator.success), np.array(done))


class SimulatorProcesses:
    """Simulators in worker processes that carry out orders together, with the same results as in this process.

    Args:
        opener: opens a simulator. Picklable.
        count: the number of simulators.
        workers: the number of processes; each opens its share of the simulators.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
        UserError: a process died.
    """

    def __init__(self, opener: Callable[[], Simulator], count: int, workers: int) -> None:
        self._count = count
        self._helpers: list[Helper[Any, Any]] = []
        for worker in range(workers):
            share = range(worker, count, workers)
            self._helpers.append(Helper(functools.partial(open_share, opener, share, workers)))
        try:
            self({})  # raises what opening raises
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return self._count

    def __call__(self, orders: Mapping[int, Order]) -> dict[int, Outcome | ArithmeticError]:
        """Carries out an order in each simulator that has one, and returns the outcomes by the simulators' numbers.

        Raises:
            UserError: a process died.
        """
        outcomes: dict[int, Outcome | ArithmeticError] = {}
        try:
            for worker, helper in enumerate(self._helpers):
                helper.send({number: orders[number] for number in orders if number % len(self._helpers) == worker})
            for helper in self._helpers:
                outcomes |= helper.receive(SECONDS)
        except WorkerDied as error:
            self.close()
            raise UserError(
                "a process of the simulator died, most likely for lack of memory; run again with a smaller --together"
            ) from error
        return outcomes

    def close(self) -> None:
        """Ends the processes."""
        for helper in self._helpers:
            helper.close()


def open_share(
    opener: Callable[[], Simulator], numbers: Sequence[int], workers: int
) -> Callable[[Mapping[int, Order]], dict[int, Outcome | ArithmeticError]]:
    """Opens a worker's simulators, and returns the function that carries out its orders."""
    share_cores(workers)
    simulators = {number: opener() for number in numbers}
    return lambda orders: {number: carry_out(simulators[number], order) for number, order in orders.items()}
