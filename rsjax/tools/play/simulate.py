"""The code of a simulator's process, which loads neither jax nor the model."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.config import SimConfig
from rsjax.tools.sim.episode import Simulators


@dataclass(frozen=True)
class Job:
    """One job of a simulator: begins an episode if ``seed`` is set, or takes a frame's action; then perhaps renders."""

    task: str
    seed: int | None
    action: Float32[np.ndarray, " A"] | None
    render: bool


@dataclass(frozen=True)
class Rendered:
    """A simulator's frame."""

    rgb: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    success: bool


Simulate = Callable[[Job], Rendered | None]


def simulate(config: SimConfig) -> Simulate:
    """Returns the function that does jobs, in order. It runs in the simulator's process."""
    simulators = Simulators(config)

    def work(job: Job) -> Rendered | None:
        sim = simulators(job.task)
        if job.seed is not None:
            sim.reset(job.seed)
        if job.action is not None:
            for control in job.action.reshape(config.control_steps, -1):
                sim.step(control)
        if not job.render:
            return None
        view = sim.render()
        return Rendered(view.rgb, view.depth, sim.success)

    return work
