"""The runs of a soak: where they lie, the commands that make them, and the reference, the one without faults."""

import json
import shutil
import statistics
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.soak.attempt import last_logged
from benchmarks.soak.compare import compare_stages, compare_stores
from benchmarks.soak.faults import copy_tree
from benchmarks.soak.rounds import SoakError, Stage, Target, run_without_faults
from rsjax.config import Config
from rsjax.tools.pipeline.run import TRAINED, Run
from rsjax.training.log import read_log

CHECKPOINTS = 40  # of a run with faults, by default
NEVER_STOPPED = "never-stopped"  # a file in a reference that was made here, once it is complete


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    minutes: float = 30.0
    """For how long faults are injected; the reference, and the end of the last run, come on top."""
    seed: int = 0
    """Of the faults."""
    stage: Literal["world_model", "tokenizer", "all"] = "world_model"
    """What is hit; the stages before it are copied from the reference."""
    out: Path | None = None
    """Where everything is kept; runs/soak-PRESET if not given."""
    data_dir: Path = Path("data")
    """Where the reference's clips are kept, if they were simulated."""
    reference: Path | None = None
    """A finished run of the same configuration that was never stopped; made first if not given."""
    checkpoint_every: int = 0
    """Steps between the checkpoints of runs with faults; 0: a fortieth of the shorter training."""


@dataclass(frozen=True)
class Soak:
    """A soak's configuration.

    Attributes:
        config: of the runs.
        arguments: the preset and overrides that give it, for ``experiments.train``.
    """

    config: Config
    arguments: tuple[str, ...]
    options: Options

    @property
    def out(self) -> Path:
        return self.options.out or Path("runs") / f"soak-{self.config.name}"

    @property
    def all_stages(self) -> tuple[str, ...]:
        """The stages of a run."""
        return Run(self.config, self.out, self.options.data_dir).stages

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that are hit."""
        return self.all_stages if self.options.stage == "all" else (self.options.stage,)

    @property
    def trained(self) -> tuple[str, ...]:
        return tuple(stage for stage in self.stages if stage in TRAINED)

    @property
    def reference(self) -> Path:
        return self.options.reference or self.out / "reference"

    def command(self, run: Path, data: Path, *more: str) -> tuple[str, ...]:
        """Returns the training command, as a user would type it; ``more`` replaces options of the user's."""
        more = ("--run-dir", str(run), "--data-dir", str(data), *more)
        own = without(self.arguments, {word.partition("=")[0] for word in more if word.startswith("--")})
        return (sys.executable, "-m", "experiments.train", *own, *more)


def without(argv: Sequence[str], flags: Collection[str]) -> tuple[str, ...]:
    """Returns arguments without these options, each with one value, whose names have dashes."""
    kept = []
    words = iter(argv)
    for word in words:
        if word.partition("=")[0].replace("_", "-") not in flags:
            kept.append(word)
        elif "=" not in word:
            next(words, None)  # its value
    return tuple(kept)


def make_reference(soak: Soak, show: Callable[[str], None]) -> None:
    """Makes the run without faults, or checks ``--reference``.

    Every step is logged, so that every step is compared. An incomplete reference of an earlier soak is started afresh:
    the reference must never have been stopped.

    Raises:
        SoakError: ``--reference`` is of another configuration or not finished, or making the run failed.
    """
    folder = soak.reference
    last = soak.all_stages.index(soak.stages[-1])
    if soak.options.reference is not None:
        run = Run(soak.config, folder, soak.options.data_dir)
        if missing := [stage for stage in soak.all_stages[: last + 1] if not run.finished(stage)]:
            raise SoakError(
                f"{folder}: holds no finished {missing[0]} of this configuration; finish it, or leave --reference out, "
                f"so that one is made"
            )
        return
    if (folder / NEVER_STOPPED).exists():
        return
    for stage in soak.stages:
        shutil.rmtree(folder / stage, ignore_errors=True)
    show(f"the reference: one run without faults, in {folder}")
    command = soak.command(folder, soak.options.data_dir, "--no-resume", "--runtime.log-every", "1")
    stages = tuple(Stage(folder / stage) for stage in soak.stages)
    run_without_faults(Target(command, stages, soak.out / "reference.log", to_the_end=soak.stages == soak.all_stages))
    (folder / NEVER_STOPPED).touch()


def prepare(soak: Soak, place: Path) -> Target:
    """Prepares a run for faults: a directory that is empty except for the stages that the reference provides."""
    run = place / "run"
    whole = soak.stages == soak.all_stages
    for stage in soak.all_stages[: soak.all_stages.index(soak.stages[0])]:
        copy_tree(soak.reference / stage, run / stage)
    place.mkdir(parents=True, exist_ok=True)
    saved = json.loads((soak.reference / "config.json").read_text())
    logged = saved["runtime"]["log_every"]
    shortest = min(last_logged(soak.reference / stage) for stage in soak.trained)
    every = soak.options.checkpoint_every or max(1, shortest // CHECKPOINTS)
    flags = ("--runtime.checkpoint-every", str(every), "--runtime.log-every", str(logged))
    seconds = step_seconds(soak.reference / soak.trained[-1])
    reference = Run(soak.config, soak.reference, soak.options.data_dir)
    return Target(
        command=soak.command(run, place / "data" if whole else soak.options.data_dir, *flags),
        stages=tuple(Stage(run / stage, stage in TRAINED, reference.seconds(stage)) for stage in soak.stages),
        output=place / "output.log",
        interval=every * seconds,
        step_seconds=seconds,
        to_the_end=whole,
    )


def step_seconds(folder: Path) -> float:
    """Returns the median duration of a training stage's steps, without compilation."""
    return statistics.median(row["seconds_per_step"] for row in read_log(folder) if "seconds_per_step" in row)


def compare_with_reference(soak: Soak, place: Path) -> list[str]:
    """Returns the differences between a run with faults and the reference; none if they are bit-identical."""
    run = place / "run"
    reference = soak.reference
    lines = [f"{stage}: {line}" for stage in soak.trained for line in compare_stages(run / stage, reference / stage)]
    if soak.stages == soak.all_stages:
        pairs = ((run, place / "data"), (reference, soak.options.data_dir))
        lines += compare_stores(*(Run(soak.config, *pair).clips for pair in pairs))
        lines += compare_stores(run / "tokens" / "store", reference / "tokens" / "store")
        scores, others = (json.loads((folder / "metrics.json").read_text()) for folder in (run, reference))
        names = sorted(name for name in scores | others if not name.startswith("seconds"))
        lines += [f"metrics.json: {name} differs" for name in names if scores.get(name) != others.get(name)]
    return lines
