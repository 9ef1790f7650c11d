"""The training loop: steps, logs, validation and checkpoints. It stops and resumes exactly."""

import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax

from rsjax.config import LoopConfig
from rsjax.data.loader import Loader
from rsjax.data.order import Arrays
from rsjax.data.prefetch import DeviceBatch, Prefetch
from rsjax.errors import Preempted, UserError
from rsjax.progress import Progress, note
from rsjax.trainable import Params, Trainable
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.distributed import agree, barrier, is_lead
from rsjax.training.log import ScalarLog
from rsjax.training.memory import memory_scalars
from rsjax.training.preemption import StopRequest
from rsjax.training.profile import Profile
from rsjax.training.sharding import Sharding
from rsjax.training.skipped import NAME as SKIPPED
from rsjax.training.skipped import SkippedSteps
from rsjax.training.state import TrainState
from rsjax.training.step import Metrics, train_step
from rsjax.training.validation import Validate, Validation

B = TypeVar("B")


class DivergedError(UserError):
    """More steps were skipped than ``skip_budget`` allows."""


@dataclass(frozen=True)
class Monitor:
    """Settings of progress display and validation, which do not affect the results of training.

    Attributes:
        per_step: the unit and amount of a step's work, such as ("frames", 64), for rates.
        validate: scores the weights every ``loop.eval_every`` steps.
    """

    per_step: tuple[str, float] | None = None
    validate: Validate | None = None


def fit(
    model: Trainable[B],
    loop: LoopConfig,
    loader: Callable[[dict[str, Any] | None], Loader],
    directory: Path,
    *,
    name: str,
    to_batch: Callable[[Arrays], B],
    start: Callable[[Params], Params] | None = None,
    resume: bool = True,
    stop_at: int | None = None,
    monitor: Monitor = Monitor(),
) -> TrainState:
    """Trains for ``loop.steps`` steps in total, resuming from the newest checkpoint in ``directory``.

    All processes call this with the same arguments; only the lead writes logs.

    Args:
        model: the model to train.
        loader: takes a loader's saved state (or None) and returns the loader that continues from it.
        directory: of checkpoints and logs; made if it does not exist.
        name: of the training, for the progress line.
        to_batch: converts a loader's arrays to the model's batch.
        start: makes the initial parameters from fresh ones; not called on resuming from a checkpoint.
        resume: False deletes earlier checkpoints.
        stop_at: stop (and save) after this step, as if interrupted.

    Returns:
        The final state on this process's first device; only its weights if it is sharded (``loop.fsdp``).

    Raises:
        CheckpointError: the newest checkpoint does not fit, or none can be read.
        DivergedError: too many steps were skipped; their batches are recorded.
        Preempted: the process received SIGTERM; everything up to the current step is saved.
        StoreError: too many records are damaged, or the disk is full.
    """
    if not resume and is_lead():
        shutil.rmtree(directory / "checkpoints", ignore_errors=True)
    barrier(f"{name} begins")
    sharding = Sharding.create(loop)
    with ExitStack() as stack:
        checkpoints = Checkpoints(directory / "checkpoints", loop.keep_last, loop.keep_every, loop.keep_best)
        stack.callback(checkpoints.close)
        if agree(checkpoints.latest(), f"{name}: newest checkpoint") is None:
            state, data = sharding.init(model, loop, start), None
        else:
            state, data = checkpoints.restore(sharding.template(model, loop))
            state = sharding.adopt(state)
        training = _Training(model, loop, directory, sharding, checkpoints, monitor)
        last = min(stop_at or loop.steps, loop.steps)
        batches = stack.enter_context(Prefetch(loader(data), lambda arrays: sharding.put_batch(to_batch(arrays))))
        state = training.steps(state, batches, last, name)
    if sharding.shares:  # the whole state need not fit one device
        kept = "params" if state.ema is None else "ema"
        rest: dict[str, Any] = dict.fromkeys(("params", "opt_state", "ema", "extra"))
        return dataclasses.replace(state, **rest | {kept: sharding.gather(state.weights)})  # type: ignore[type-var]
    return sharding.gather(state)


class _Dispatched(NamedTuple):
    """A step that the device may still be computing."""

    step: int
    batch: DeviceBatch
    metrics: Metrics


class _Training:
    """One call of :func:`fit`."""

    def __init__(
        self,
        model: Trainable[Any],
        loop: LoopConfig,
        directory: Path,
        sharding: Sharding,
        checkpoints: Checkpoints,
        monitor: Monitor,
    ) -> None:
        self.model, self.loop, self.directory = model, loop, directory
        self.sharding, self.checkpoints, self.monitor = sharding, checkpoints, monitor

    def steps(self, state: TrainState, batches: Prefetch, last: int, name: str) -> TrainState:
        """Trains from the state's step to step ``last``."""
        loop, first = self.loop, int(state.step)
        step_fn = self.sharding.compile(train_step, self.model, loop)
        self._skips = int(state.skipped)
        self._skipped_steps = SkippedSteps(self.directory, first) if is_lead() else None
        with ExitStack() as stack:
            log = stack.enter_context(self._log(first)) if is_lead() else None
            shown = (name, loop.steps, "steps", first)
            progress = stack.enter_context(Progress(*shown, per_unit=self.monitor.per_step)) if is_lead() else None
            traces = (self.directory / "profile", first, last, self.loop.profile)
            profile = stack.enter_context(Profile.after(*traces))
            stop = stack.enter_context(StopRequest())
            clock, before = _Clock(batches, first), None
            for step in range(first + 1, last + 1):
                profile.at(step, state)
                batch = next(batches)
                with jax.profiler.StepTraceAnnotation("train", step_num=step):
                    state, metrics = step_fn(state, batch.batch)
                if before is not None:  # only one step is computed while the next is prepared
                    self._check(before, batches)
                before = _Dispatched(step, batch, metrics)
                if progress is not None:
                    progress.update(step, **{term: metrics[term] for term in ("loss", *self.model.loss_weights)})
                stopping = stop.asked(step)
                due = {every: at > 0 and (step % at == 0 or step == last) for every, at in self._schedule().items()}
                if stopping or any(due.values()):
                    self._check(before, batches)
                    before = None
                    if log is not None and due["log"]:
                        measured = clock.lap(step, self.monitor.per_step) | memory_scalars()
                        log.write(step, self.sharding.scalars(metrics) | measured)
                    scored = None
                    if due["validation"]:
                        with clock.stopped(), stop.impatient():
                            scored = self._validate(state, step, log)
                    if due["checkpoint"] or stopping or (scored is not None and loop.keep_best):
                        metric = None if scored is None else scored.metric
                        self.checkpoints.save(step, self.sharding.portable(state), batches.state(), metric)
                if stopping and step < last:
                    self.checkpoints.wait()
                    raise Preempted(f"{name}: stopped by SIGTERM and saved after step {step}; the same command resumes")
            # Here SIGTERM is only recorded; after this block it may keep the caller from closing the checkpoints.
            self.checkpoints.wait()
            profile.at(last + 1, state)
            damaged = batches.quarantined()
            if damaged and is_lead():
                note(f"{damaged} damaged records were replaced; {self.directory / 'quarantine.jsonl'} lists them")
        return state

    def _schedule(self) -> dict[str, int]:
        loop = self.loop
        validation = loop.eval_every if self.monitor.validate is not None else 0
        return {"log": loop.log_every, "checkpoint": loop.checkpoint_every, "validation": validation}

    def _log(self, first: int) -> ScalarLog:
        return ScalarLog(self.directory, first, self.loop.wandb, resume=first > 0)

    def _check(self, done: _Dispatched, batches: Prefetch) -> None:
        """Waits for a step and records it if it was skipped.

        Raises:
            DivergedError: too many steps were skipped.
        """
        skips, allowed = int(done.metrics["skipped"]), self.loop.skip_budget
        if skips == self._skips:
            return
        self._skips, scalars = skips, self.sharding.scalars(done.metrics)
        if self._skipped_steps is not None:
            self._skipped_steps.add(done.step, scalars, batches.identify(done.batch), done.batch.before)
            norms = f"loss {scalars['loss']:.4g}, gradient {scalars['grad_norm']:.4g}"
            note(f"step {done.step} is skipped ({norms}): {skips} of at most {allowed}")
        if skips > allowed:
            raise DivergedError(
                f"{self.directory}: {skips} steps were not finite, more than {allowed} (the last was "
                f"step {done.step}, loss {scalars['loss']}); {SKIPPED} lists their batches; "
                f"train anew with a lower optimizer.learning-rate and --overwrite"
            )

    def _validate(self, state: TrainState, step: int, log: ScalarLog | None) -> Validation:
        """Scores the weights on the lead process, and sends the metric to the others."""
        assert self.monitor.validate is not None
        weights = self.sharding.gather(state.weights)
        scored = self.monitor.validate(step, weights) if log is not None else Validation(0.0, {})
        if log is not None:
            log.write(step, scored.scalars)
            for name, picture in scored.pictures.items():
                log.image(step, name, picture)
        return Validation(agree(scored.metric, f"validation {step}"), scored.scalars)


class _Clock:
    """Measures seconds per step, rates, and the share of time spent waiting for data since the last lap."""

    def __init__(self, batches: Prefetch, first: int) -> None:
        self._batches = batches
        self._began, self._waited, self._step = time.monotonic(), batches.waited, first

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stops the clock while something other than training runs."""
        began = time.monotonic()
        yield
        self._began += time.monotonic() - began

    def lap(self, step: int, per_step: tuple[str, float] | None) -> dict[str, float]:
        """Returns scalars for the time since the last lap or the start; ``step`` is the last finished step."""
        now, waited = time.monotonic(), self._batches.waited
        steps = step - self._step
        seconds = now - self._began
        scalars = {"seconds_per_step": seconds / steps, "data_wait_share": (waited - self._waited) / seconds}
        if per_step is not None:
            scalars[f"{per_step[0]}_per_second"] = per_step[1] * steps / seconds
        self._began, self._waited, self._step = now, waited, step
        return scalars
