"""The clips of a fine-tuning: a store as it is, or recordings that are ingested with defaults that fit them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from rsjax.config import require
from rsjax.data.store import MANIFEST
from rsjax.errors import UserError
from rsjax.progress import note
from rsjax.tools.finetune.delay import measure_delay
from rsjax.tools.ingest.actions import ActionConfig, ActionLayout, Compose, check_declared
from rsjax.tools.ingest.episode import Episode, EpisodeError, EpisodeRef, EpisodeSource
from rsjax.tools.ingest.formats import FORMATS, open_source
from rsjax.tools.ingest.options import IngestOptions, source_options
from rsjax.tools.ingest.packing import split_episodes
from rsjax.tools.ingest.windows import WindowConfig
from rsjax.tools.ingest.work_items import SplitShares

RATE = 5.0  # frames per second that clips have at most: those of tiny, and of most data sets of robots
LEAST_FRAMES = 4
LOOKED_AT = 20  # episodes whose length and rate decide; as many of the training split for the delay of commands
LENGTH_SHARE = 0.8  # of a short episode's frames, so that it gives more than one clip
MOST_CLIPS = 4000  # about; with more, clips overlap less


@dataclass(frozen=True)
class Recordings:
    """The recordings to fine-tune on.

    Attributes:
        source: a format of ``rsjax ingest``; "" if ``path`` is a store of clips.
        path: the data set, or the store.
    """

    source: str
    path: Path


@dataclass(frozen=True)
class Cutting:
    """The user's choices of how recordings become clips.

    Attributes:
        frames, rate: of a clip; 0: chosen by the recordings.
        camera, option: as of ``rsjax ingest``.
        depth: likewise.
        delay: recorded frames by which commands act later than the format says; -1: measured on training episodes
            (:mod:`rsjax.tools.finetune.delay`), or 0 if it is unknown whether actions add up.
        test_share, validation_share: shares of the episodes.
        split_seed: chooses which episodes they are.
        workers: processes; -1: one per core.
    """

    frames: int = 0
    rate: float = 0.0
    camera: str = ""
    option: tuple[str, ...] = ()
    depth: str = "recorded"
    delay: int = 0
    test_share: float = 0.2
    validation_share: float = 0.1
    split_seed: int = 0
    workers: int = -1

    def __post_init__(self) -> None:
        require(self.delay >= -1, f"--delay is {self.delay}; give a number of recorded frames, or -1 to measure it")


def find_recordings(word: str, cutting: Cutting) -> Recordings:
    """Reads ``SOURCE:PATH``, or the path of a store of clips.

    Raises:
        UserError: it is neither, nothing is there, or options on how to cut recordings were given for a store.
    """
    path = Path(word)
    if (path / MANIFEST).exists():
        changed = [f.name for f in fields(cutting) if getattr(cutting, f.name) != f.default]
        if changed:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise UserError(f"{flags}: say how recordings become clips, but {path} is a store of clips; leave them out")
        return Recordings("", path)
    source, colon, rest = word.partition(":")
    if not colon or not rest:
        raise UserError(
            f"--data is {word!r}; write SOURCE:PATH, such as lerobot:/data/pusht (sources: {', '.join(FORMATS)}), or "
            f"the path of a store that rsjax ingest made"
        )
    return Recordings(source, Path(rest))


def ingest_options(
    recordings: Recordings, cutting: Cutting, image_size: int, most_frames: int, out: Path
) -> IngestOptions:
    """Returns options of an ingest that suit the recordings.

    Clips have every n-th frame, so that the rate is 5 Hz or a little more or less, and as many frames as the model has
    positions, or fewer if episodes are short. If that is every frame, times do not count, since a recording that is a
    little slower than others lacks frames for their rate. Where a data set does not say whether actions add up, a
    clip's action is the recorded ones of its interval, one after another.

    Args:
        image_size: pixels a side.
        most_frames: frames that the model takes.

    Raises:
        UserError: the data set cannot be read, has no episode, or its episodes are too short.
    """
    source = open_source(recordings.source, recordings.path.absolute(), **source_options(cutting.option))
    refs = list(source.episodes())
    episodes, reason = readable_episodes(source, refs[:LOOKED_AT])
    require(bool(episodes), f"{recordings.path}: no episode can be read ({reason})")
    recorded = [episode.fps for episode in episodes]
    fps = float(np.median(recorded))
    every = max(1, round(fps / (cutting.rate or RATE)))
    rate = fps / every
    if every == 1 and max(recorded) < 1.5 * fps:
        rate = 0.0  # every frame
    lengths = sorted(len(episode.timestamps) // every for episode in episodes)
    short = lengths[len(lengths) // 4]
    frames = cutting.frames or min(most_frames, int(LENGTH_SHARE * short))
    require(
        LEAST_FRAMES <= frames <= most_frames,
        f"{recordings.path}: clips would have {frames} frames at {fps / every:.3g} Hz; the model takes {LEAST_FRAMES} "
        f"to {most_frames}: set --rate or --frames (a quarter of the episodes has {short} frames or fewer)",
    )
    total = len(refs) * float(np.mean(lengths))
    compose = how_to_compose(episodes[0], every)
    delay = max(0, cutting.delay)
    if cutting.delay == -1 and says_what_actions_are(episodes[0]):
        shares = SplitShares(cutting.test_share, cutting.validation_share, cutting.split_seed)
        training = split_episodes(refs, shares)["train"]
        measured = measure_delay(readable_episodes(source, training[:LOOKED_AT])[0], cutting.camera, every)
        note(str(measured))
        delay = measured.frames
    note(
        f"clips of {frames} frames at {fps / every:.3g} Hz, {image_size} pixels a side; actions between two frames: "
        f"{compose} (rsjax ingest has more options, and --data takes its store)"
    )
    if compose == "stack":
        note("actions are not combined: say --option kind=absolute, or kind=delta and 'held=[…]', to combine them")
    return IngestOptions(
        out=out,
        option=cutting.option,
        windows=WindowConfig(frames=frames, rate=rate, hop=max(1, round(total / MOST_CLIPS))),
        actions=ActionConfig(offset=delay, compose=compose),
        image_size=image_size,
        camera=cutting.camera,
        depth=cutting.depth,
        test_share=cutting.test_share,
        validation_share=cutting.validation_share,
        split_seed=cutting.split_seed,
        workers=cutting.workers,
    )


def readable_episodes(source: EpisodeSource, refs: Sequence[EpisodeRef]) -> tuple[list[Episode], str]:
    """Returns the episodes that can be read, and why the last of the others cannot."""
    episodes = []
    reason = "there is none"
    for ref in refs:
        try:
            episodes.append(source.read(ref))
        except EpisodeError as error:
            reason = str(error)
    return episodes, reason


def says_what_actions_are(episode: Episode) -> bool:
    """Returns whether an episode's data set declares what may be done to its actions besides copying them."""
    try:
        check_declared(ActionLayout.from_json(episode.meta.get("actions", {})), 1, ActionConfig(offset=1))
    except EpisodeError:
        return False
    return True


def how_to_compose(episode: Episode, every: int) -> Compose:
    """Returns how the actions of ``every`` recorded frames become one: joined, or stacked if it is unknown how."""
    config = ActionConfig()
    try:
        check_declared(ActionLayout.from_json(episode.meta.get("actions", {})), every, config)
    except EpisodeError:
        return "stack"
    return config.compose
