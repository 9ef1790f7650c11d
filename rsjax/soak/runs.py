"""The runs of a soak: where they lie, the commands that make them, and the one that nothing disturbs."""

import json
import math
import shutil
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rsjax.config import Config
from rsjax.errors import UserError
from rsjax.pipeline.run import STAGES, TRAINED, Run
from rsjax.soak.compare import compare_stages, compare_stores
from rsjax.soak.disturb import copy_tree
from rsjax.soak.rounds import Stage, Target
from rsjax.soak.watch import Attempt, last_logged
from rsjax.training.log import read_log

CHECKPOINTS = 40  # of a disturbed run, if not told otherwise
NEVER_STOPPED = "never-stopped"  # a file in a reference that was made here, once it is whole

What = Literal["world_model", "tokenizer", "all"]


class SoakError(UserError):
    """A soak that cannot be made as asked."""


@dataclass(frozen=True)
class Plan:
    """What is soaked.

    Attributes:
        config: of the runs.
        arguments: what makes it: a preset and its overrides, for ``experiments.train``.
        what: the stages that are disturbed; those before are taken from the reference.
        out: holds all that the soak makes.
        data: where the reference's clips are kept.
        given: a finished run of the same configuration that was never stopped; None: one is made.
        minutes: for how long runs are disturbed.
        seed: of the disturbances.
        checkpoint_every: steps; 0: a fortieth of the run's.
    """

    config: Config
    arguments: tuple[str, ...]
    what: What
    out: Path
    data: Path
    given: Path | None
    minutes: float
    seed: int
    checkpoint_every: int

    @property
    def stages(self) -> tuple[str, ...]:
        """Those that are disturbed."""
        return STAGES if self.what == "all" else (self.what,)

    @property
    def trained(self) -> tuple[str, ...]:
        return tuple(stage for stage in self.stages if stage in TRAINED)

    @property
    def reference(self) -> Path:
        return self.given or self.out / "reference"

    def command(self, run: Path, data: Path, *more: str) -> tuple[str, ...]:
        """The training command, as a user would type it."""
        places = ("--run-dir", str(run), "--data-dir", str(data))
        return (sys.executable, "-m", "experiments.train", *self.arguments, *places, *more)


def make_reference(plan: Plan, say: Callable[[str], None]) -> None:
    """Makes the run that nothing disturbs, or checks the one that was given.

    Every step is logged, so that every step is compared. A run that an earlier soak did not come to the end with is
    begun again: it has to be one that was never stopped.

    Raises:
        SoakError: the given one is of another configuration or not finished, or making one failed.
    """
    if plan.given is not None:
        run = Run(plan.config, plan.given, plan.data)
        missing = [stage for stage in STAGES[: STAGES.index(plan.stages[-1]) + 1] if not run.finished(stage)]
        if missing:
            raise SoakError(
                f"{plan.given}: holds no finished {missing[0]} of this configuration; finish it, or leave --reference "
                f"out, so that one is made"
            )
        return
    folder = plan.reference
    if (folder / NEVER_STOPPED).exists():
        return
    for stage in plan.stages:
        shutil.rmtree(folder / stage, ignore_errors=True)
    say(f"the reference: one run that nothing disturbs, in {folder}")
    every_step = [word for stage in plan.trained for word in (f"--{_section(stage)}.log-every", "1")]
    command = plan.command(folder, plan.data, "--no-resume", *every_step)
    folders = [folder / stage for stage in plan.stages]
    run_through(Target(command, tuple(map(Stage, folders)), plan.out / "reference.log", 0, 0, plan.what == "all"))
    (folder / NEVER_STOPPED).touch()


def run_through(target: Target) -> None:
    """Runs a command until its stages are finished.

    Raises:
        SoakError: it ended before.
    """
    attempt = Attempt(target.command, [stage.folder for stage in target.stages], target.output)
    try:
        attempt.linger(math.inf)
        if target.to_the_end:
            attempt.process.wait()
        problem = target.problem(attempt)
    finally:
        attempt.kill()
    if problem:
        raise SoakError(f"an undisturbed run failed: {problem}; see {target.output}")


def prepare(plan: Plan, place: Path) -> Target:
    """A run about to be disturbed: an empty directory but for the stages that are taken from the reference."""
    run = place / "run"
    data = place / "data" if plan.what == "all" else plan.data
    for stage in STAGES[: STAGES.index(plan.stages[0])]:
        copy_tree(plan.reference / stage, run / stage)
    place.mkdir(parents=True, exist_ok=True)
    logged = _logged_every(plan)
    flags: list[str] = []
    for stage in plan.trained:
        every = plan.checkpoint_every or max(1, steps_of(plan, stage) // CHECKPOINTS)
        section = _section(stage)
        flags += [f"--{section}.checkpoint-every", str(every), f"--{section}.log-every", str(logged[stage])]
    last = plan.trained[-1]
    seconds = step_seconds(plan.reference / last)
    every = plan.checkpoint_every or max(1, steps_of(plan, last) // CHECKPOINTS)
    return Target(
        command=plan.command(run, data, *flags),
        stages=tuple(
            Stage(run / stage, stage in TRAINED, Run(plan.config, plan.reference, plan.data).mark(stage)["seconds"])
            for stage in plan.stages
        ),
        output=place / "output.log",
        interval=every * seconds,
        step_seconds=seconds,
        to_the_end=plan.what == "all",
    )


def steps_of(plan: Plan, stage: str) -> int:
    """How many steps a training stage has, by the reference's log."""
    return last_logged(plan.reference / stage)


def step_seconds(folder: Path) -> float:
    """What a step of a training stage took, in the middle; compiling is not in it."""
    return statistics.median(row["seconds_per_step"] for row in read_log(folder) if "seconds_per_step" in row)


def differences(plan: Plan, place: Path) -> list[str]:
    """Where a disturbed run differs from the reference, one line each; none where they are bit-identical."""
    run, found = place / "run", []
    for stage in plan.trained:
        found += [f"{stage}: {line}" for line in compare_stages(run / stage, plan.reference / stage)]
    if plan.what == "all":
        clips = [Run(plan.config, *places).clips for places in ((run, place / "data"), (plan.reference, plan.data))]
        found += compare_stores(*clips)
        found += compare_stores(run / "tokens" / "store", plan.reference / "tokens" / "store")
        scores = [json.loads((folder / "metrics.json").read_text()) for folder in (run, plan.reference)]
        names = {name for score in scores for name in score if not name.startswith("seconds")}
        found += [f"metrics.json: {name} differs" for name in sorted(names) if scores[0][name] != scores[1][name]]
    return found


def _logged_every(plan: Plan) -> dict[str, int]:
    saved = json.loads((plan.reference / "config.json").read_text())
    return {stage: saved[_section(stage).replace("-", "_")]["log_every"] for stage in plan.trained}


def _section(stage: str) -> str:
    return "tokenizer-train" if stage == "tokenizer" else "train"
