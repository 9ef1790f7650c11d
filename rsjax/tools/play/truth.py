"""Runs the simulator beside the generated video: the same actions from the same start, in a separate process.

A simulator's state cannot be saved, so it follows one branch. For another branch it begins again and repeats that
branch's actions.
"""

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from rsjax.config import SimConfig
from rsjax.errors import first_line
from rsjax.processes import Helper, WorkerDied
from rsjax.tools.play.messages import Refused
from rsjax.tools.play.simulate import Job, Rendered, Simulate, simulate
from rsjax.tools.play.tree import Node, Truth
from rsjax.tools.sim.episode import WINDOW, clip_seed

SECONDS = 120.0  # time limit for a step or for the simulator's start
MOST = 2  # simulators of a server
PEAK = 255.0


class Truths:
    """The simulators of a server.

    Args:
        make: called in a new process, such as :func:`simulate` with its configuration; None without a simulator.
        most: processes at a time.
    """

    def __init__(self, make: Callable[[], Simulate] | None, most: int = MOST) -> None:
        self.make = make
        self._free = most

    @classmethod
    def of(cls, config: SimConfig | None) -> "Truths":
        """Returns the simulators of a run's clips."""
        return cls(None if config is None else functools.partial(simulate, config))

    def take(self) -> Callable[[], Simulate]:
        """Reserves a process and returns the function to start in it; raises :class:`Refused` if all are in use."""
        if self.make is None:
            raise Refused("no_truth", "the clips are of no simulator that is here")
        if not self._free:
            raise Refused("no_truth", "all simulators are in use by other viewers")
        self._free -= 1
        return self.make

    def give_back(self) -> None:
        """Notes that a process has ended."""
        self._free += 1


class Follower:
    """A simulator that follows one viewer's branches.

    Raises:
        Refused: all simulators are in use, or the clip begins later than its episode.
    """

    def __init__(self, truths: Truths, origin: dict[str, Any], task: str) -> None:
        if origin.get(WINDOW):  # cut from an episode, and not its beginning
            raise Refused("no_truth", "the clip begins in the middle of its episode, where the simulator cannot begin")
        self._make = truths.take()
        self._truths = truths
        self._seed = clip_seed(origin)
        self._task = task
        self._pool = ThreadPoolExecutor(1, "play-truth")  # the process ends with the thread that started it
        self._helper: Helper[Job, Rendered | None] | None = None
        self._applied: list[Node] = []

    async def follow(self, nodes: list[Node]) -> list[int]:
        """Adds the truth to each of a branch's frames, and returns the numbers of the frames that had none.

        Raises:
            Refused: the simulator fails or does not answer.
        """
        return await asyncio.get_running_loop().run_in_executor(self._pool, self._follow, nodes)

    def close(self) -> None:
        """Ends the process."""

        def end() -> None:
            if self._helper is not None:
                self._helper.close()

        self._pool.submit(end)
        self._pool.shutdown(wait=False)
        self._truths.give_back()

    def _follow(self, nodes: list[Node]) -> list[int]:
        try:
            self._helper = self._helper or Helper(self._make)
            done = len(self._applied)
            if not done or len(nodes) < done or any(a is not b for a, b in zip(self._applied, nodes, strict=False)):
                done = 0
                self._applied = []
            filled = []
            for number in range(done, len(nodes)):
                node = nodes[number]
                if number == 0:
                    seed = self._seed
                else:
                    seed = None
                made = self._helper(Job(self._task, seed, node.action, node.truth is None), SECONDS)
                self._applied.append(node)
                if made is not None:
                    squared = np.mean((made.rgb.astype(np.float64) - node.state.rgb) ** 2)
                    psnr = None  # of equal pictures
                    if squared != 0:
                        psnr = round(float(10 * np.log10(PEAK**2 / squared)), 3)
                    node.truth = Truth(made.rgb, made.depth, made.success, psnr)
                    filled.append(number)
            return filled
        except WorkerDied as error:
            self._helper = None
            self._applied = []
            raise Refused("no_truth", "the simulator does not answer; it begins again with the next frame") from error
        except Exception as error:  # from the simulator; the action may have been taken
            self._applied = []
            raise Refused("no_truth", first_line(error)) from error
