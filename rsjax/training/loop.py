"""The training loop: batches in, steps, logs and checkpoints out; stops and resumes exactly."""

import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax

from rsjax.config import LoopConfig
from rsjax.data.loader import Loader
from rsjax.data.prefetch import DeviceBatch, Prefetch
from rsjax.errors import Preempted, UserError
from rsjax.progress import Progress, note
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.distributed import agree, barrier, is_lead
from rsjax.training.log import ScalarLog
from rsjax.training.memory import memory_scalars
from rsjax.training.objectives import Objective
from rsjax.training.placement import Placement
from rsjax.training.preemption import StopRequest
from rsjax.training.profile import Profile
from rsjax.training.skipped import NAME as SKIPPED
from rsjax.training.skipped import SkippedSteps
from rsjax.training.state import TrainState
from rsjax.training.validation import Evaluate, HeldOut


class DivergedError(UserError):
    """More steps were not finite than the configuration allows."""


@dataclass(frozen=True)
class Watch:
    """How a run is looked at while it goes on; nothing that it makes depends on this.

    Attributes:
        per_step: what a step works on and how much of it, such as ("tokens", 16384), for rates.
        held_out: looks at the weights every ``loop.eval_every`` steps.
    """

    per_step: tuple[str, float] | None = None
    held_out: Evaluate | None = None


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
    watch: Watch | None = None,
) -> TrainState:
    """Trains until ``loop.steps`` steps are done, going on from the newest checkpoint in ``directory``.

    Of several processes all call this with the same arguments; the lead alone writes logs.

    Args:
        loader: given a loader's saved state (or None), the loader that goes on from there.
        directory: holds checkpoints and logs; made if it is not there.
        name: what is trained, for the progress line.
        to_batch: a loader's arrays to the objective's batch.
        start: fresh parameters to those that training begins with; not asked where there is a checkpoint to resume.
        resume: False throws earlier checkpoints away.
        stop_at: stop (and save) after this step, as if interrupted.

    Returns:
        The final state, on this process's first device; of one that devices share (``loop.fsdp``), the weights alone.

    Raises:
        CheckpointError: the newest checkpoint does not fit, or none can be read.
        DivergedError: the loss or the gradient of too many steps was not finite; their batches are written down.
        Preempted: SIGTERM; everything up to the step that was under way is saved.
        StoreError: too many damaged records, or a full disk.
    """
    if not resume and is_lead():
        shutil.rmtree(directory / "checkpoints", ignore_errors=True)
    barrier(f"{name} begins")
    placement = Placement.create(loop)
    with ExitStack() as stack:
        checkpoints = Checkpoints(directory / "checkpoints", loop.keep_last, loop.keep_every, loop.keep_best)
        stack.callback(checkpoints.close)
        if agree(checkpoints.latest(), f"{name}: newest checkpoint") is None:
            state, data = placement.init(objective, loop, start), None
        else:
            state, data = checkpoints.restore(placement.template(objective, loop))
            state = placement.adopt(state)
        run = _Run(objective, loop, directory, placement, checkpoints, watch or Watch())
        last = min(stop_at or loop.steps, loop.steps)
        batches = stack.enter_context(Prefetch(loader(data), lambda arrays: placement.put_batch(to_batch(arrays))))
        state = run.steps(state, batches, last, name)
    if placement.shares:  # the whole state need not fit one device
        kept = "params" if state.ema is None else "ema"
        weights = placement.gather(state.weights)
        left = {"params": None, "opt_state": None, "ema": None, "extra": None} | {kept: weights}
        return dataclasses.replace(state, **left)  # type: ignore[type-var]
    return placement.gather(state)


class _Taken(NamedTuple):
    """A step that was dispatched, and may still be computed."""

    step: int
    fed: DeviceBatch
    metrics: dict[str, Any]


class _Run:
    """One call of :func:`fit`."""

    def __init__(
        self,
        objective: Objective,
        loop: LoopConfig,
        directory: Path,
        placement: Placement,
        checkpoints: Checkpoints,
        watch: Watch,
    ) -> None:
        self.objective, self.loop, self.directory = objective, loop, directory
        self.placement, self.checkpoints, self.watch = placement, checkpoints, watch

    def steps(self, state: TrainState, batches: Prefetch, last: int, name: str) -> TrainState:
        """From the state's step to the last."""
        loop, first = self.loop, int(state.step)
        step_fn = self.placement.compile(self.objective, loop)
        self._skips = int(state.skipped)
        self._skipped_steps = SkippedSteps(self.directory, first) if is_lead() else None
        with ExitStack() as stack:
            log = stack.enter_context(self._log(first)) if is_lead() else None
            shown = (name, loop.steps, "steps", first)
            progress = stack.enter_context(Progress(*shown, per_unit=self.watch.per_step)) if is_lead() else None
            traces = (self.directory / "profile", first, last, self.loop.profile)
            profile = stack.enter_context(Profile.after(*traces))
            stop = stack.enter_context(StopRequest())
            clock, before = _Clock(batches, first), None
            for step in range(first + 1, last + 1):
                profile.at(step, state)
                fed = next(batches)
                with jax.profiler.StepTraceAnnotation("train", step_num=step):
                    state, metrics = step_fn(state, fed.batch)
                if before is not None:  # one step is computed while the next one is prepared, not more
                    self._check(before, batches)
                before = _Taken(step, fed, metrics)
                if progress is not None:
                    progress.update(step, **{term: metrics[term] for term in ("loss", *self.objective.weights)})
                asked = stop.asked(step)
                due = {every: at > 0 and (step % at == 0 or step == last) for every, at in self._schedule().items()}
                if asked or any(due.values()):
                    self._check(before, batches)
                    before = None
                    if log is not None and due["log"]:
                        measured = clock.lap(step, self.watch.per_step) | memory_scalars()
                        log.write(step, self.placement.scalars(metrics) | measured)
                    found = None
                    if due["held_out"]:
                        with clock.stopped():
                            found = self._look(state, step, log)
                    if due["checkpoint"] or asked or (found is not None and loop.keep_best):
                        metric = None if found is None else found.metric
                        self.checkpoints.save(step, self.placement.portable(state), batches.state(), metric)
                if asked and step < last:
                    self.checkpoints.wait()
                    raise Preempted(f"{name}: stopped by SIGTERM and saved after step {step}; the same command resumes")
            profile.at(last + 1, state)
            damaged = batches.quarantined()
            if damaged and is_lead():
                note(f"{damaged} damaged records were replaced; {self.directory / 'quarantine.jsonl'} lists them")
        return state

    def _schedule(self) -> dict[str, int]:
        loop = self.loop
        held_out = loop.eval_every if self.watch.held_out is not None else 0
        return {"log": loop.log_every, "checkpoint": loop.checkpoint_every, "held_out": held_out}

    def _log(self, first: int) -> ScalarLog:
        return ScalarLog(self.directory, first, self.loop.wandb, resume=first > 0)

    def _check(self, taken: _Taken, batches: Prefetch) -> None:
        """Waits for a step; writes it down if it was left out.

        Raises:
            DivergedError: it was one too many.
        """
        skips, allowed = int(taken.metrics["skipped"]), self.loop.skip_budget
        if skips == self._skips:
            return
        self._skips, scalars = skips, self.placement.scalars(taken.metrics)
        if self._skipped_steps is not None:
            self._skipped_steps.add(taken.step, scalars, batches.identify(taken.fed), taken.fed.before)
            told = f"loss {scalars['loss']:.4g}, gradient {scalars['grad_norm']:.4g}"
            note(f"step {taken.step} is left out ({told}): {skips} of at most {allowed}")
        if skips > allowed:
            raise DivergedError(
                f"{self.directory}: {skips} steps were not finite, more than skip_budget = {allowed} (the last was "
                f"step {taken.step}, loss {scalars['loss']}); {SKIPPED} there has their batches; raise skip_budget "
                f"and start again, or train anew with a lower optimizer.learning-rate and --overwrite"
            )

    def _look(self, state: TrainState, step: int, log: ScalarLog | None) -> HeldOut:
        """What the lead finds on held-out clips; the others learn the metric."""
        assert self.watch.held_out is not None
        weights = self.placement.gather(state.weights)
        found = self.watch.held_out(step, weights) if log is not None else HeldOut(0.0, {})
        if log is not None:
            log.write(step, found.scalars)
            for name, picture in found.pictures.items():
                log.image(step, name, picture)
        return HeldOut(agree(found.metric, f"held out {step}"), found.scalars)


class _Clock:
    """Seconds a step, rates, and the share of the time that steps waited for data, since the last lap."""

    def __init__(self, batches: Prefetch, first: int) -> None:
        self._batches = batches
        self._began, self._waited, self._step = time.monotonic(), batches.waited, first

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Around what is no training."""
        began = time.monotonic()
        yield
        self._began += time.monotonic() - began

    def lap(self, step: int, per_step: tuple[str, float] | None) -> dict[str, float]:
        """The scalars of the time since the last lap, or the start; ``step`` is the last one done."""
        now, waited = time.monotonic(), self._batches.waited
        steps = step - self._step
        seconds = now - self._began
        scalars = {"seconds_per_step": seconds / steps, "data_wait_share": (waited - self._waited) / seconds}
        if per_step is not None:
            scalars[f"{per_step[0]}_per_second"] = per_step[1] * steps / seconds
        self._began, self._waited, self._step = now, waited, step
        return scalars
