"""The options of an ingest, and the plan and runner that are made from them."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rsjax.config import ConfigError, content_key, require, to_dict
from rsjax.tools.ingest.actions import ActionConfig
from rsjax.tools.ingest.windows import WindowConfig

if TYPE_CHECKING:  # loaded only when needed: --help needs none of them
    from rsjax.tools.ingest.episode import EpisodeSource
    from rsjax.tools.ingest.ingest import Runner
    from rsjax.tools.ingest.work_items import IngestPlan


@dataclass(frozen=True)
class IngestOptions:
    """Options of ``rsjax ingest``."""

    out: Path | None = None
    """The store; data/SOURCE by default."""
    option: tuple[str, ...] = ()
    """The source's own settings, such as keys=bridge or fps=5, as docs/formats.md lists them; lists as JSON."""
    recipe: Literal["paper"] | None = None
    """paper: keep only windows of one action with a key frame and clear motion (§2.2), as docs/ingest.md says."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    actions: ActionConfig = field(default_factory=ActionConfig)
    image_size: int = 64
    """Side of a clip in pixels."""
    fit: Literal["crop", "pad", "stretch"] = "crop"
    """How a picture that is not square becomes a clip: crop its middle square, pad it with bars, or stretch it."""
    points: int = 256
    """Number of tracks of a clip."""
    selection: Path | None = None
    """A list written by rsjax doctor --fix: the episodes that it leaves out are quarantined with its reasons."""
    camera: str = ""
    """The camera to use; the episode's first by default."""
    difficulty: tuple[str, ...] = ()
    """The difficulty of tasks, by the first pattern that matches: 'pick*=simple' '*fold*=difficult'. If none matches
    the task, the patterns are tried on the segment's text, and then on its skill. agibot: those of AgiBot-World's tasks
    (docs/agibot.md)."""
    scene: tuple[str, ...] = ()
    """The word for a scene, by the first pattern that matches its description."""
    test_share: float = 0.1
    """Share of the episodes whose clips form the test split."""
    validation_share: float = 0.0
    """Share of the episodes whose clips form the split validation, for an early stop; taken from the train split."""
    split_seed: int = 0
    """Another number chooses other episodes for these splits."""
    shots: str = "hsv-histogram"
    """hsv-histogram, transnetv2 or none; docs/annotate.md explains these and the next four options."""
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
    """Processes; 0: this one alone, -1: one per core. With Ray: workers of each step at most; -1: as many as fit."""
    ray_address: str = "local"
    """Address of the cluster (auto: the one that this machine belongs to)."""
    cpus: float = 1.0
    """CPUs of each worker, on Ray; fractions share a core."""
    gpus: float = 0.0
    """GPUs of each worker that has a network, on Ray; fractions share a GPU."""
    retry: bool = False
    """Try the quarantined episodes again."""
    keep_clips: bool = False
    """Also keep the clips of each episode beside the store: more disk, less time when episodes are added."""

    def __post_init__(self) -> None:
        require(
            0 <= self.test_share < 1, f"--test-share is {self.test_share}; it is a share of the episodes, 0 to below 1"
        )
        require(
            0 <= self.validation_share < 1 - self.test_share,
            f"--validation-share is {self.validation_share} and --test-share {self.test_share}; together they must "
            f"leave episodes to train on",
        )
        require(
            self.cpus > 0 and self.gpus >= 0,
            f"--cpus is {self.cpus} and --gpus {self.gpus}; they cannot be negative, nor --cpus 0",
        )
        require(
            self.workers >= -1,
            f"--workers is {self.workers}; give a number, 0 for this process alone or -1 for as many as fit",
        )
        if self.runner != "ray":
            for name in ("ray_address", "cpus", "gpus"):
                flag = f"--{name.replace('_', '-')}"
                default = type(self).__dataclass_fields__[name].default
                require(getattr(self, name) == default, f"{flag} is for Ray alone; add --runner ray or leave it out")


# The windows that the paper keeps (§2.2). It gives no bounds of motion: these bounds keep all of BridgeData (3 to 41
# px/s) and leave out still pictures, and pictures of which a twentieth moves by the picture's width each second.
RECIPES = {"paper": WindowConfig(within_segments=True, key_frame=True, least_motion=2.0, most_motion=256.0)}


def unfiltered(windows: WindowConfig) -> str:
    """Names the paper's filters of windows that these settings leave out."""
    filters = {
        "windows of one action": windows.within_segments,
        "a key frame in each": windows.key_frame,
        "clear motion": windows.least_motion > 0 or windows.most_motion < float("inf"),
    }
    return ", ".join(name for name, is_on in filters.items() if not is_on)


def make_plan(source: str, path: Path, options: IngestOptions) -> "IngestPlan":
    """Returns the plan for a data set of the format ``source`` at ``path``.

    Raises:
        UserError: an option is impossible, or the source is unknown or not at its path.
    """
    from rsjax.tools.ingest.annotate import annotation_steps
    from rsjax.tools.ingest.annotators.categories import CategoryConfig, parse_table
    from rsjax.tools.ingest.annotators.choose import choose_annotators, choose_recorded
    from rsjax.tools.ingest.clips import ClipConfig, check_first, clip_step
    from rsjax.tools.ingest.doctor import select
    from rsjax.tools.ingest.formats import open_source
    from rsjax.tools.ingest.work_items import IngestPlan, SplitShares

    out = Path(os.path.abspath(options.out or Path("data") / source))
    require(bool(out.name), f"--out is {options.out}; name a directory for the store")
    methods = {step: getattr(options, step) for step in ("shots", "motion", "depth", "tracks", "semantics")}
    recorded = choose_recorded(methods["depth"])
    difficulties = parse_table("--difficulty", options.difficulty)
    scenes = parse_table("--scene", options.scene)
    config = ClipConfig(
        options.windows,
        options.image_size,
        options.points,
        options.camera,
        options.fit,
        recorded_depth=recorded is not None,
        most_holes=recorded.most_holes if recorded else 0.0,
        actions=options.actions,
        categories=CategoryConfig(difficulties, scenes),
    )
    steps = annotation_steps(choose_annotators(methods), config.camera, options.cpus, options.gpus)
    steps = (*steps, clip_step(config, tuple(step.name for step in steps), options.cpus))
    settings = source_options(options.option)
    episodes: EpisodeSource = open_source(source, path.absolute(), **settings)
    if options.selection is not None:
        episodes = select(episodes, options.selection)
    check_first(episodes, config)
    reading = content_key(json.dumps(settings, sort_keys=True))
    meta = {"config": to_dict(config) | {"methods": methods, "source": settings}}
    shares = SplitShares(options.test_share, options.validation_share, options.split_seed)
    return IngestPlan(episodes, steps, out, shares, reading, meta)


def make_runner(options: IngestOptions) -> "Runner":
    """Returns the runner of the work items: processes of this machine, or a Ray cluster.

    Raises:
        UserError: there are too many workers for this machine.
    """
    if options.runner == "ray":
        from rsjax.tools.ingest.ray_runner import run_on_ray

        if options.workers < 0:
            most = None
        else:
            most = max(1, options.workers)
        return partial(run_on_ray, address=options.ray_address, most=most)
    from rsjax.processes import count_workers
    from rsjax.tools.ingest.ingest import run_on_this_machine

    return partial(run_on_this_machine, workers=count_workers(options.workers))


def source_options(words: Sequence[str]) -> dict[str, Any]:
    """Reads settings of a source: ``fps=5`` as a number, ``held=[6]`` as a list, a value that is not JSON as text.

    Raises:
        ConfigError: a word is not of this form, or names a setting twice.
    """
    settings: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals):
            raise ConfigError(f"--option {word!r}: write NAME=VALUE, such as fps=5")
        require(name not in settings, f"--option {name} is given twice, the second time as {value}; give it once")
        try:
            settings[name] = json.loads(value)
        except (ValueError, RecursionError):
            settings[name] = value
    return settings
