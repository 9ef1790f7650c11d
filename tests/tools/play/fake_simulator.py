"""A simulator of a few lines, for processes that load nothing else."""

import os
import time

import numpy as np

from rsjax.tools.play.simulate import Job, Rendered, Simulate


def adding(slow: float) -> Simulate:
    """A simulator whose frame is the sum of all actions; an action of 0.5 kills it, one of 0.75 diverges, one of 0.625
    is taken and then fails, the first time."""
    total, failures = [0.0], [RuntimeError("the simulator failed")]

    def work(job: Job) -> Rendered | None:
        time.sleep(slow)
        if job.seed is not None:
            total[0] = 0.0
        if job.action is not None:
            total[0] += float(job.action[0])
            if job.action[0] == 0.5:
                os._exit(1)
            if job.action[0] == 0.75:
                raise ArithmeticError("the simulation diverged")
            if job.action[0] == 0.625 and failures:
                raise failures.pop()
        picture = np.full((64, 64, 3), round(100 * total[0]), np.uint8)
        return Rendered(picture, np.ones((64, 64), np.float32), total[0] > 1) if job.render else None

    return work
