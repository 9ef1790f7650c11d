"""A data set into a store of clips. ``python -m experiments.ingest rlds /data/bridge --out data/bridge``"""

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from experiments.cli import main_errors, parse_options
from rsjax.config import ConfigError
from rsjax.ingest.actions import ActionConfig
from rsjax.ingest.formats import FORMATS
from rsjax.ingest.windows import WindowConfig

PROG = "python -m experiments.ingest"
ABOUT = f"""Reads, annotates, cuts and packs episodes.

SOURCE is the format: {", ".join(FORMATS)}. PATH is the folder or file of the data set, as docs/formats.md says of each;
of sim it is a store of clips."""


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
    manifest: Path | None = None
    """What experiments.doctor --fix wrote: the episodes that it leaves out are quarantined with its reasons."""
    camera: str = ""
    """The camera that is taken; the episode's first if not given."""
    difficulty: tuple[str, ...] = ()
    """Which tasks are how difficult, the first that matches: 'pick*=simple' '*fold*=difficult'. Where none matches the
    task, they are tried on the text of the segment, and then on its skill."""
    scene: tuple[str, ...] = ()
    """Likewise, what descriptions of scenes come to."""
    test_share: float = 0.1
    """Of the episodes, whose clips are the test split."""
    shots: str = "hsv-histogram"
    """hsv-histogram, transnetv2 or none, as docs/annotate.md says; so are the next four."""
    motion: str = "dis"
    """dis, raft or none."""
    depth: str = "recorded"
    """recorded (or recorded:most_holes=0.8), depth-anything, video-depth-anything or none."""
    tracks: str = "lucas-kanade"
    """lucas-kanade, spatial-tracker, bootstapir or none."""
    semantics: str = "own"
    """own, internvl or none."""
    runner: Literal["pool", "ray"] = "pool"
    """Processes of this machine, or a Ray cluster."""
    workers: int = -1
    """Processes; 0: this one alone, -1: one per core. With Ray, of each stage at most; -1: as many as there is room."""
    ray_address: str = "local"
    """Of the cluster (auto: the one that this machine is part of)."""
    cpus: float = 1.0
    """Of each worker, on Ray; fractions share a core."""
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
        raise ConfigError(
            f"name a source and its path first; usage: {PROG} SOURCE PATH --out STORE; sources: {', '.join(FORMATS)}"
        )
    name, place, rest = ("", "", argv) if asked else (argv[0], argv[1], argv[2:])
    options = parse_options(rest, f"{PROG} SOURCE PATH", ABOUT, Options())
    from rsjax.ingest.ingest import ingest, is_made, listed
    from rsjax.ingest.report import lines, tables
    from rsjax.progress import Progress, note

    plan = make_plan(name, Path(place), options)
    found = listed(plan.job)
    if not options.retry and is_made(plan, found[0]):
        note(f"{plan.out} is up to date: it was made of the same {len(found[0])} episodes in the same way")
        return
    stages = ", ".join(stage.name for stage in plan.job.stages)
    print(f"{len(found[0])} episodes; steps of each: {stages}, packing", flush=True)
    with Progress("ingest", plan.steps(found[0]), "steps", settle=2 * len(plan.job.stages)) as progress:
        counts = ingest(
            plan,
            lambda: make_executor(plan.job, options),
            lambda done, total: progress.update(done),
            found,
            keep_clips=options.keep_clips,
            retry=options.retry,
        )
    if counts is None:
        note("nothing is quarantined that could be tried again")
    else:
        print(*lines(counts), sep="\n")
        if tables(counts):
            print(f"what was left out, and why: {tables(counts)} in {plan.job.folder}")
    print(f"store: {plan.out}")


def make_plan(name: str, place: Path, options: Options) -> Any:
    """What the arguments ask for, checked before anything is run."""
    from rsjax.config import content_key, to_dict
    from rsjax.ingest.annotators.categories import CategoryConfig, parse_table
    from rsjax.ingest.annotators.choose import choose_annotators, choose_recorded
    from rsjax.ingest.clips import ClipConfig
    from rsjax.ingest.formats import open_source
    from rsjax.ingest.ingest import Plan
    from rsjax.ingest.jobs.work_items import Job
    from rsjax.ingest.selection import select
    from rsjax.ingest.stages import make_stages

    out = check(name, options)
    words = {stage: getattr(options, stage) for stage in ("shots", "motion", "depth", "tracks", "semantics")}
    recorded = choose_recorded(words["depth"])
    config = ClipConfig(
        options.windows,
        options.image_size,
        options.points,
        options.camera,
        recorded_depth=recorded is not None,
        most_holes=recorded.most_holes if recorded else 0.0,
        actions=options.actions,
        categories=CategoryConfig(
            parse_table("--difficulty", options.difficulty), parse_table("--scene", options.scene)
        ),
    )
    stages = make_stages(choose_annotators(words), config, options.cpus, options.gpus)
    settings = source_options(options.option)
    source: Any = open_source(name, place.absolute(), **settings)
    if options.manifest is not None:
        source = select(source, options.manifest)
    job = Job(source, content_key(json.dumps(settings, sort_keys=True)), stages, out.with_name(f"{out.name}.work"))
    return Plan(job, out, options.test_share, {"config": to_dict(config) | {"methods": words, "source": settings}})


def check(name: str, options: Options) -> Path:
    """The store's absolute path.

    Raises:
        ConfigError: an option that cannot be, or that the runner would not heed.
    """
    if not 0 <= options.test_share < 1:
        raise ConfigError(f"--test-share is {options.test_share}; it is a share of the episodes, 0 to below 1")
    if not (options.cpus > 0 and options.gpus >= 0):
        raise ConfigError(f"--cpus is {options.cpus} and --gpus {options.gpus}; they cannot be negative, nor --cpus 0")
    if options.runner != "ray":
        for option in ("ray_address", "cpus", "gpus"):
            if getattr(options, option) != getattr(Options(), option):
                raise ConfigError(f"--{option.replace('_', '-')} is for Ray alone; add --runner ray or leave it out")
    out = Path(os.path.abspath(options.out or Path("data") / name))
    if not out.name:
        raise ConfigError(f"--out is {options.out}; name a directory that the store is to be")
    return out


def make_executor(job: Any, options: Options) -> Any:
    """The workers that the arguments ask for."""
    from rsjax.ingest.jobs.pool import ProcessPool, check_workers, count_workers
    from rsjax.ingest.jobs.runner import Inline

    if options.runner == "ray":
        from rsjax.ingest.jobs.ray_runner import RayExecutor

        most = None if check_workers(options.workers) < 0 else max(1, options.workers)
        return RayExecutor(job, options.ray_address, most=most)
    workers = count_workers(options.workers)
    return ProcessPool(job, workers) if workers else Inline(job)


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
