"""The training loop: steps, logs, validation and checkpoints. It stops and resumes exactly."""

import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax

from rsjax.config import LoopConfig
from rsjax.data.loader import DeviceBatch, Loader, Prefetch
from rsjax.errors import Preempted, UserError
from rsjax.progress import Progress, note
from rsjax.trainable import Params, Trainable
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.distributed import agree, barrier, is_lead
from rsjax.training.log import SKIPPED, ScalarLog, SkippedSteps, memory_scalars
from rsjax.training.preemption import StopRequest
from rsjax.training.profile import Profile
from rsjax.training.sharding import Sharding
from rsjax.training.state import TrainState
from rsjax.training.step import Metrics, as_numbers, train_step
from rsjax.training.validation import Validate


class DivergedError(UserError):
    """More steps were skipped than ``skip_budget`` allows."""


class DispatchedStep(NamedTuple):
    """A step that the device may still be computing."""

    step: int
    batch: DeviceBatch
    metrics: Metrics


def fit(
    model: Trainable[Any],
    loop: LoopConfig,
    loader: Callable[[dict[str, Any] | None], Loader],
    directory: Path,
    *,
    name: str,
    start: Callable[[Params], Params] | None = None,
    resume: bool = True,
    stop_at: int | None = None,
    validate: Validate | None = None,
    per_step: tuple[str, float] | None = None,
) -> TrainState:
    """Trains for ``loop.steps`` steps in total, resuming from the newest checkpoint in ``directory``.

    All processes call this with the same arguments; only the lead writes logs.

    Args:
        model: the model to train.
        loader: takes a loader's saved state (or None) and returns the loader that continues from it.
        directory: of checkpoints and logs; made if it does not exist.
        name: of the training, for the progress line.
        start: as for :meth:`rsjax.training.sharding.Sharding.init`; not called on resuming from a checkpoint.
        resume: False deletes earlier checkpoints.
        stop_at: stop (and save) after this step, as if interrupted.
        validate: scores the weights every ``loop.validate_every`` steps; it affects training only by
            ``loop.early_stop``.
        per_step: the unit and amount of a step's work, such as ("frames", 64), for the rates that are shown and logged.

    Returns:
        The final state on this process's first device; only its weights if it is sharded (``loop.fsdp``). With
        ``loop.early_stop``, that of the best validation.

    Raises:
        CheckpointError: the newest checkpoint does not fit, or none can be read.
        DivergedError: too many steps were skipped; their batches are recorded.
        Preempted: the process received SIGTERM; everything up to the current step is saved.
        StoreError: too many records are damaged.
        FileError: the disk is full.
    """
    if not resume and is_lead():
        shutil.rmtree(directory / "checkpoints", ignore_errors=True)
    barrier(f"{name} begins")
    sharding = Sharding.create(loop)
    with ExitStack() as stack:
        checkpoints = Checkpoints(directory / "checkpoints", loop.keep_last, loop.keep_every, loop.keep_best)
        stack.callback(checkpoints.close)
        if agree(checkpoints.latest(), f"{name}: newest checkpoint") is None:
            state = sharding.init(model, loop, start)
            data = None
        else:
            state, data = checkpoints.restore(sharding.template(model, loop))
            state = sharding.adopt(state)
        first = int(state.step)
        last = min(stop_at or loop.steps, loop.steps)
        if exhausted(loop, checkpoints.best(), first):
            last = first
        skips = int(state.skipped)
        # train_step(model, loop, state, batch) as one program: on one device, on many, or over a mesh.
        compiled_step = sharding.compile(train_step, model, loop)

        batches = stack.enter_context(Prefetch(loader(data), model.batch, sharding.put_batch))
        log = None
        progress = None
        skipped_steps = None
        if is_lead():
            skipped_steps = SkippedSteps(directory, first)
            log = stack.enter_context(ScalarLog(directory, first, loop.wandb, resume=first > 0))
            progress = stack.enter_context(Progress(name, loop.steps, "steps", first, per_unit=per_step))
        profile = stack.enter_context(Profile.after(directory / "profile", first, last, loop.profile))
        stop = stack.enter_context(StopRequest())
        clock = _Clock(batches, first)
        pending: DispatchedStep | None = None
        for step in range(first + 1, last + 1):
            profile.at(step, state)
            batch = next(batches)
            with jax.profiler.StepTraceAnnotation("train", step_num=step):
                state, metrics = compiled_step(state, batch.batch)
            if pending is not None:  # only one step is computed while the next is prepared
                skips = _count_skips(pending, skips, loop, directory, batches, skipped_steps)
            pending = DispatchedStep(step, batch, metrics)
            if progress is not None:
                progress.update(step, **{term: metrics[term] for term in ("loss", *model.loss_weights)})

            stopping = stop.asked(step)
            log_due = _is_due(step, loop.log_every, last)
            validation_due = validate is not None and _is_due(step, loop.validate_every, last)
            checkpoint_due = stopping or _is_due(step, loop.checkpoint_every, last)
            if not (log_due or validation_due or checkpoint_due):
                continue
            skips = _count_skips(pending, skips, loop, directory, batches, skipped_steps)
            pending = None
            if log is not None and log_due:
                measured = clock.lap(step, per_step) | memory_scalars()
                log.write(step, as_numbers(metrics) | measured)
            metric = None
            if validate is not None and validation_due:
                with clock.stopped(), stop.impatient():
                    weights = sharding.gather(state.weights)
                    score = 0.0
                    if log is not None:
                        validation = validate(step, weights)
                        score = validation.metric
                        log.write(step, validation.scalars)
                        for picture, pixels in validation.pictures.items():
                            log.image(step, picture, pixels)
                    metric = agree(score, f"validation {step}")  # the lead's, in all processes
            if checkpoint_due or (metric is not None and loop.keep_best):
                checkpoints.save(step, sharding.portable(state), batches.state(), metric)
            if metric is not None and step < last and exhausted(loop, checkpoints.best(), step):
                if is_lead():
                    note(f"{name}: stops after step {step}, as the best validation was at step {checkpoints.best()}")
                last = step
                break
            if stopping and step < last:
                checkpoints.wait()
                raise Preempted(f"{name}: stopped by SIGTERM and saved after step {step}; the same command resumes")
        # Here SIGTERM is only recorded; after this block it may keep the caller from closing the checkpoints.
        checkpoints.wait()
        profile.at(last + 1, state)
        best = checkpoints.best()
        whole = last == loop.steps or exhausted(loop, best, last)
        if loop.early_stop is not None and whole and best not in (None, last):
            state = sharding.adopt(checkpoints.restore(sharding.template(model, loop), best)[0])
        damaged = batches.quarantined()
        if damaged and is_lead():
            note(f"{damaged} damaged records were replaced; {directory / 'quarantine.jsonl'} lists them")
    if sharding.shares:  # the whole state need not fit one device
        kept = "params" if state.ema is None else "ema"
        rest: dict[str, Any] = dict.fromkeys(("params", "opt_state", "ema", "extra"))
        return dataclasses.replace(state, **rest | {kept: sharding.gather(state.weights)})  # type: ignore[type-var]
    return sharding.gather(state)


def exhausted(loop: LoopConfig, best: int | None, step: int) -> bool:
    """Returns whether a training ends early at this step: its patience is over since the best validation.

    Validations before the curriculum's last stage do not count, since its clips may be others.
    """
    stop = loop.early_stop
    return stop is not None and best is not None and step - max(best, loop.last_stage) >= stop.every * stop.patience


def _is_due(step: int, every: int, last: int) -> bool:
    """Returns whether something is due at this step that happens every ``every`` steps (0: never) and at the end."""
    return every > 0 and (step % every == 0 or step == last)


def _count_skips(
    done: DispatchedStep,
    before: int,
    loop: LoopConfig,
    directory: Path,
    batches: Prefetch,
    record: SkippedSteps | None,
) -> int:
    """Waits for a step, records it if it was skipped, and returns the number of skipped steps so far.

    Args:
        before: the number of skipped steps before it.
        record: where the lead process records it.

    Raises:
        DivergedError: too many steps were skipped.
    """
    skips = int(done.metrics["skipped"])
    if skips == before:
        return skips
    scalars = as_numbers(done.metrics)
    if record is not None:
        record.add(done.step, scalars, batches.identify(done.batch), done.batch.before)
        norms = f"loss {scalars['loss']:.4g}, gradient {scalars['grad_norm']:.4g}"
        note(f"step {done.step} is skipped ({norms}): {skips} of at most {loop.skip_budget}")
    if skips > loop.skip_budget:
        raise DivergedError(
            f"{directory}: {skips} steps were not finite, more than {loop.skip_budget} (the last was "
            f"step {done.step}, loss {scalars['loss']}); {SKIPPED} lists their batches; "
            f"train anew with a lower optimizer.learning-rate and --overwrite"
        )
    return skips


class _Clock:
    """Measures seconds per step, rates, and the share of time spent waiting for data since the last lap."""

    def __init__(self, batches: Prefetch, first: int) -> None:
        self._batches = batches
        self._began = time.monotonic()
        self._waited = batches.waited
        self._step = first

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stops the clock while something other than training runs."""
        began = time.monotonic()
        yield
        self._began += time.monotonic() - began

    def lap(self, step: int, per_step: tuple[str, float] | None) -> dict[str, float]:
        """Returns scalars for the time since the last lap or the start; ``step`` is the last finished step."""
        now = time.monotonic()
        waited = self._batches.waited
        steps = step - self._step
        seconds = now - self._began
        scalars = {"seconds_per_step": seconds / steps, "data_wait_share": (waited - self._waited) / seconds}
        if per_step is not None:
            scalars[f"{per_step[0]}_per_second"] = per_step[1] * steps / seconds
        self._began = now
        self._waited = waited
        self._step = step
        return scalars
