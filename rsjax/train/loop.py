"""The training loop: batches in, steps, logs and checkpoints out; stops and resumes exactly."""

import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from rsjax.config import LoopConfig
from rsjax.data.loader import Loader
from rsjax.errors import UserError
from rsjax.progress import Progress
from rsjax.train.checkpoint import Checkpoints
from rsjax.train.log import ScalarLog
from rsjax.train.objectives import Objective
from rsjax.train.placement import Placement
from rsjax.train.state import TrainState, create_state


class DivergedError(UserError):
    """The loss or a parameter is not a number any more."""


def fit(
    objective: Objective,
    loop: LoopConfig,
    loader: Callable[[dict[str, Any] | None], Loader],
    directory: Path,
    *,
    name: str,
    to_batch: Callable[[dict[str, Any]], Any],
    start: Callable[[Any], Any] | None = None,
    resume: bool = True,
    stop_at: int | None = None,
) -> TrainState:
    """Trains until ``loop.steps`` steps are done, going on from the newest checkpoint in ``directory``.

    Args:
        loader: given a loader's saved state (or None), the loader that goes on from there.
        directory: holds checkpoints and logs; made if it is not there.
        name: what is trained, for the progress line.
        to_batch: a loader's arrays to the objective's batch.
        start: fresh parameters to those that training begins with; not asked where there is a checkpoint to resume.
        resume: False throws earlier checkpoints away.
        stop_at: stop (and save) after this step, as if interrupted.

    Returns:
        The final state, on the host's first device.

    Raises:
        CheckpointError: the newest checkpoint does not fit.
        DivergedError: the loss or a parameter is not finite; such a state is never saved.
        StoreError: too many damaged records, or a full disk.
    """
    if not resume:
        shutil.rmtree(directory / "checkpoints", ignore_errors=True)
    checkpoints = Checkpoints(directory / "checkpoints")
    placement = Placement.create(loop)
    begun = checkpoints.latest() is not None
    state, data = create_state(objective, loop, None if begun else start), None
    if begun:
        state, data = checkpoints.restore(state)
    first, last = int(state.step), min(stop_at or loop.steps, loop.steps)
    state, step_fn = placement.put_state(state), placement.compile(objective, loop)
    try:
        with (
            loader(data) as batches,
            ScalarLog(directory, first) as log,
            Progress(name, loop.steps, "steps", start=first) as progress,
        ):
            clock = _Clock()
            for step in range(first + 1, last + 1):
                with clock.waiting():
                    batch = placement.put_batch(to_batch(next(batches)))
                state, metrics = step_fn(state, batch)
                logs, saves = (step % every == 0 or step == last for every in (loop.log_every, loop.checkpoint_every))
                if logs or saves:
                    scalars = {k: float(v) for k, v in placement.first(metrics).items()}
                    _check_finite(scalars, step, directory)
                if logs:
                    log.write(step, scalars | clock.lap())
                progress.update(step, loss=placement.first(metrics)["loss"])
                if saves:
                    checkpoints.save(placement.first(state), batches.state())
    finally:
        checkpoints.close()
    return jax.device_put(placement.first(state), jax.local_devices()[0])


def _check_finite(scalars: dict[str, float], step: int, directory: Path) -> None:
    # A finite loss can have a gradient that is not: then the parameters tell.
    for name in ("loss", "param_norm"):
        if not math.isfinite(scalars[name]):
            raise DivergedError(
                f"{directory}: {name} is {scalars[name]} at step {step}; lower the learning rate "
                f"(optimizer.learning-rate) and start again with --no-resume"
            )


class _Clock:
    """Seconds a step, and the share of the time that steps waited for data, since the last lap."""

    def __init__(self) -> None:
        self._began, self._waited, self._step = time.monotonic(), 0.0, 0

    def waiting(self) -> "_Clock":
        return self

    def __enter__(self) -> None:
        self._wait_began = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._waited += time.monotonic() - self._wait_began
        self._step += 1

    def lap(self) -> dict[str, float]:
        seconds = time.monotonic() - self._began
        scalars = {"seconds_per_step": seconds / self._step, "data_wait_share": self._waited / seconds}
        self._began, self._waited, self._step = time.monotonic(), 0.0, 0
        return scalars
