"""A data set into a store of clips. ``python -m experiments.ingest rlds /data/bridge --out data/bridge``"""

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from experiments.cli import main_errors, parse_options
from rsjax.annotate.windows import WindowConfig
from rsjax.config import ConfigError
from rsjax.data.actions import ActionConfig

PROG = "python -m experiments.ingest"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    out: Path | None = None
    """The store; data/SOURCE if not given."""
    option: tuple[str, ...] = ()
    """The source's own settings, such as keys=bridge or fps=5, as docs/formats.md lists them; lists as JSON."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    actions: ActionConfig = field(default_factory=ActionConfig)
    image_size: int = 64
    """Pixels of a clip's side."""
    points: int = 256
    """Tracks of a clip."""
    camera: str = ""
    """The camera that is taken; the episode's first if not given."""
    difficulty: tuple[str, ...] = ()
    """Which tasks are how difficult, the first that matches: 'pick*=simple' '*fold*=difficult'."""
    scene: tuple[str, ...] = ()
    """Likewise, what descriptions of scenes come to."""
    test_share: float = 0.1
    """Of the episodes, whose clips are the test split."""
    shots: str = "hsv-histogram"
    """hsv-histogram, transnetv2 or none, as docs/annotate.md says; so are the next four."""
    motion: str = "dis"
    """dis, raft or none."""
    depth: str = "recorded"
    """recorded, depth-anything, video-depth-anything or none."""
    tracks: str = "lucas-kanade"
    """lucas-kanade, spatial-tracker, bootstapir or none."""
    semantics: str = "own"
    """own, internvl or none."""
    runner: Literal["pool", "ray"] = "pool"
    """Processes of this machine, or a Ray cluster."""
    workers: int = -1
    """Processes; 0: this one alone, -1: one per core. With Ray, of each stage at most."""
    ray_address: str = "local"
    """Of the cluster (auto: the one that this machine is part of)."""
    gpus: float = 0.0
    """Of each worker that has a network, on Ray; fractions share a GPU."""
    retry: bool = False
    """Try again what was quarantined before."""
    keep_clips: bool = False
    """Keep the clips of each episode beside the store too: more disk, less time when episodes are added."""


@main_errors()
def main() -> None:
    """Ingests what is not there yet, and says what became of every episode."""
    argv = sys.argv[1:]
    asked = {"-h", "--help"} & {*argv}
    if not asked and (len(argv) < 2 or argv[0].startswith("-") or argv[1].startswith("-")):
        raise ConfigError(f"name a source and its path first; usage: {PROG} SOURCE PATH --out STORE")
    name, place, rest = ("", "", argv) if asked else (argv[0], argv[1], argv[2:])
    options = parse_options(rest, f"{PROG} SOURCE PATH", "Reads, annotates, cuts and packs episodes.", Options())
    from rsjax.annotate.ingest import ingest, listed
    from rsjax.annotate.report import lines
    from rsjax.progress import Progress, note

    plan = make_plan(name, Path(place), options)
    found = listed(plan.job)
    with Progress("ingest", len(found[0]) * len(plan.job.stages), "units") as progress:
        counts = ingest(
            plan,
            lambda: make_executor(plan.job, options),
            lambda done, total: progress.update(done),
            found,
            keep_clips=options.keep_clips,
            retry=options.retry,
        )
    if counts is None:
        note("up to date: the store was made of the same episodes in the same way")
    else:
        print(*lines(counts), sep="\n")
        print(f"what was left out, and why: {plan.job.folder.absolute()}/summary.json and quarantine.jsonl")
    print(f"store: {plan.out.absolute()}")


def make_plan(name: str, place: Path, options: Options) -> Any:
    """What the arguments ask for, checked before anything is run."""
    from rsjax.annotate.categories import CategoryConfig, parse_table
    from rsjax.annotate.choose import choose_annotators
    from rsjax.annotate.clips import ClipConfig
    from rsjax.annotate.ingest import Plan
    from rsjax.annotate.stages import make_stages
    from rsjax.annotate.units import Job
    from rsjax.config import content_key, to_dict
    from rsjax.data.formats import open_source

    if not 0 <= options.test_share < 1:
        raise ConfigError(f"--test-share is {options.test_share}; it is a share of the episodes, 0 to below 1")
    categories = CategoryConfig(
        parse_table("--difficulty", options.difficulty),
        parse_table("--scene", options.scene),
    )
    config = ClipConfig(
        options.windows, options.image_size, options.points, options.camera, 0.5, options.actions, categories
    )
    words = {stage: getattr(options, stage) for stage in ("shots", "motion", "depth", "tracks", "semantics")}
    stages = make_stages(choose_annotators(words), config, options.gpus)
    settings = source_options(options.option)
    source = open_source(name, place.absolute(), **settings)
    out = options.out or Path("data") / name
    job = Job(
        source, content_key(json.dumps(settings, sort_keys=True)), stages, out.absolute().with_name(f"{out.name}.work")
    )
    return Plan(job, out, options.test_share, {"config": to_dict(config) | {"methods": words, "source": settings}})


def make_executor(job: Any, options: Options) -> Any:
    """The workers that the arguments ask for."""
    from rsjax.annotate.pool import ProcessPool
    from rsjax.annotate.runner import Inline

    cores = len(os.sched_getaffinity(0))
    if options.runner == "ray":
        from rsjax.annotate.ray_runner import RayExecutor

        return RayExecutor(job, options.ray_address, most=cores if options.workers < 0 else max(1, options.workers))
    return ProcessPool(job, cores if options.workers < 0 else options.workers) if options.workers else Inline(job)


def source_options(words: tuple[str, ...]) -> dict[str, Any]:
    """``fps=5`` as a number, ``held=[6]`` as a list, everything that is no JSON as text.

    Raises:
        ConfigError: a word is not of this form.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals):
            raise ConfigError(f"--option {word!r}: write NAME=VALUE, such as fps=5")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


if __name__ == "__main__":
    main()
