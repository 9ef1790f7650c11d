"""The last step: cuts an episode into clips of one length and size, one at a time.

It reads the records of those annotation steps (:mod:`rsjax.tools.ingest.annotate`) that were run.

Axes: N recorded frames, T frames of a clip, N₀ tracks of a clip, S×S a clip's pixels.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rsjax.clip import UNKNOWN
from rsjax.config import ConfigError, content_key, require, to_dict
from rsjax.data.normalization import Statistics
from rsjax.tools.ingest.actions import (
    ActionConfig,
    ActionLayout,
    check_declared,
    describe_dimensions,
    flat_names,
    sampled_actions,
)
from rsjax.tools.ingest.annotate import Annotated, FrameRecords, StoredDepths, camera_of
from rsjax.tools.ingest.annotators.categories import CategoryConfig
from rsjax.tools.ingest.annotators.depth import FilledDepths
from rsjax.tools.ingest.annotators.protocols import Tracked
from rsjax.tools.ingest.annotators.tracks import window_tracks
from rsjax.tools.ingest.episode import Episode, EpisodeError, EpisodeSource, Segment
from rsjax.tools.ingest.pictures import Fit, Placement
from rsjax.tools.ingest.windows import (
    Span,
    WindowConfig,
    WindowIndex,
    check_rate,
    cut_spans,
    index_windows,
    judge,
    segment_at,
    starts_by_reason,
    tally,
)
from rsjax.tools.ingest.work_items import Inputs, Records, Step

CLIPS = "clips"  # the step's name
_UNEVEN = 1e-3  # seconds by which frame intervals may differ from the frame rate's; beyond it, times are stored


@dataclass(frozen=True)
class ClipConfig:
    """The settings by which clips are cut."""

    windows: WindowConfig = field(default_factory=WindowConfig)  # which frames make a clip
    image_size: int = 64  # pixels
    tracks: int = 256  # N₀
    camera: str = ""  # "": the episode's first
    fit: Fit = "crop"  # how pictures that are not square become squares
    recorded_depth: bool = True  # use the data set's own depth
    most_holes: float = 0.5  # share of a recorded depth map; holes are filled from the nearest measured pixel
    actions: ActionConfig = field(default_factory=ActionConfig)  # how recorded actions become those of clips
    categories: CategoryConfig = field(default_factory=CategoryConfig)  # words for difficulties and scenes

    def __post_init__(self) -> None:
        require(8 <= self.image_size <= 4096, f"--image-size is {self.image_size}; choose one from 8 to 4096")
        require(1 <= self.tracks <= 65536, f"--points is {self.tracks}; choose a number from 1 to 65536")
        require(0 <= self.most_holes <= 1, f"most_holes is {self.most_holes}; it is a share of the pixels, 0 to 1")


def check_first(source: EpisodeSource, config: ClipConfig) -> None:
    """Checks, before anything is annotated, that the meaning of the first readable episode's actions is declared.

    Raises:
        ConfigError: the meaning is not declared, and clips cannot be made without it.
    """
    for ref in source.episodes():
        try:
            episode = source.read(ref)
            step = check_rate(episode.fps, config.windows)
        except EpisodeError:
            continue  # it is quarantined later
        try:
            check_declared(ActionLayout.from_json(episode.meta.get("actions", {})), round(step), config.actions)
        except EpisodeError as error:
            raise ConfigError(str(error)) from error
        return


def clip_step(config: ClipConfig, needs: tuple[str, ...] = (), cpus: float = 1.0) -> Step:
    """Returns the step that cuts clips, after the annotation steps that it needs."""
    return Step(CLIPS, partial(_cut_episode, config), content_key(to_dict(config)), needs, version=5, cpus=cpus)


def _cut_episode(config: ClipConfig, episode: Episode, inputs: Inputs) -> Records:
    return (yield from cut(Annotated.load(episode, inputs), config))


def cut(annotated: Annotated, config: ClipConfig) -> Records:
    """Cuts an episode into clips and yields them as records of :class:`rsjax.clip.Clip`; ``depth`` may be None.

    Returns:
        ``windows`` (how many are kept, and how many are left out for each reason), ``left_out`` (first frames of the
        windows left out, by reason), ``fit`` (how the pictures became square, in words; "" if they were), ``short``
        (how many ``spans`` are too short for a window, the ``longest`` of all in recorded frames, how many a ``window``
        takes, and the ``cure``, in words), ``actions`` (statistics of the clips' actions), ``action_dim``,
        ``dimensions`` (a line for each), ``depth`` (its range), ``depth_unit`` ("metres" or "relative"; both None
        without depth), ``success`` (the number of clips that end in success; None if the data set does not record it).

    Raises:
        EpisodeError: there is no such camera, or pictures, depth or annotations cannot be read or do not fit.
    """
    episode = annotated.episode
    windows = config.windows
    camera = camera_of(episode, config.camera)
    spans = cut_spans(len(episode.timestamps), annotated.shots, annotated.segments, windows)
    index = index_windows(episode.timestamps, episode.fps, spans, windows)
    motion = annotated.motion
    if motion is not None and len(motion) != len(episode.timestamps):
        count = len(episode.timestamps)
        raise EpisodeError(f"motion: {len(motion)} values for {count} frames; annotate it again")
    reasons = judge(index, episode.timestamps, motion, annotated.key_frames, windows)
    step = check_rate(episode.fps, windows)
    whole = abs(step - round(step)) < 0.01 * step  # otherwise sampled_actions says what to do
    stacked = 0  # rows that each action stacks
    if config.actions.compose == "stack" and whole:
        stacked = round(step)
    layout = ActionLayout.from_json(episode.meta.get("actions", {}))
    recorded = episode.actions.shape[1]
    names = flat_names(episode.meta.get("action_names"), recorded) or [""] * recorded
    pictures = _Fitted(episode.cameras[camera].read, config)
    depths, unit = _depths(annotated, camera, config, pictures)
    stored = None
    if annotated.tracks is not None:
        stored = FrameRecords(annotated.tracks)
    statistics: Statistics | None = None
    near = np.inf
    far = 0.0
    succeeded = 0
    for number in np.flatnonzero(np.array(reasons) == "").tolist():
        frames = index.frames[number]
        if stacked and (np.diff(frames) != stacked).any():
            reasons[number] = "uneven"
            continue
        rgb = pictures.read(frames.tolist())
        tracks = _tracks(stored, frames, config.tracks, pictures.placement)
        if tracks is None:
            reasons[number] = "no track"
            continue
        depth = None
        if depths is not None:
            depth = depths.read(frames.tolist())
        actions = sampled_actions(episode.actions, frames, config.actions, layout)
        rows = Statistics.of(actions[1:])
        if statistics:
            statistics = statistics.merged(rows)
        else:
            statistics = rows
        if depth is not None:
            near = min(near, float(depth[depth > 0].min()))
            far = max(far, float(depth.max()))
        success = np.asarray(episode.meta.get("success", False), bool)  # one value per frame, or one for the episode
        if success.ndim:
            success = success[frames]
        else:
            success = np.full(len(frames), bool(success))
        succeeded += bool(success[-1])
        yield {
            "rgb": rgb,
            "depth": depth,
            "actions": actions,
            "tracks": tracks.points,
            "visible": tracks.visible,
            "success": success,
            **_words(annotated, config, camera, frames, unit),
        }
    summary = {
        "windows": tally(reasons),
        "left_out": starts_by_reason(index, reasons),
        "fit": pictures.placement.words if pictures.placement else "",
        "short": _short(index, spans, episode.fps, windows, annotated.shots),
        "actions": None,
        "action_dim": None,
        "dimensions": [],
        "depth": None,
        "depth_unit": None,
        "success": succeeded if "success" in episode.meta else None,
    }
    if statistics:
        width = len(statistics.mean)
        dimensions = describe_dimensions(layout, names, config.actions, width)
        summary |= {"actions": statistics.to_json(), "action_dim": width, "dimensions": dimensions}
    if far > 0:
        summary |= {"depth": [near, far], "depth_unit": unit}
    return summary


def _short(
    index: WindowIndex, spans: list[Span], fps: float, windows: WindowConfig, shots: Sequence[Span]
) -> dict[str, Any]:
    faster = ""
    if 0 < windows.rate < fps:
        faster = "raise --windows.rate or "
    at = ""
    if windows.rate:
        at = f" at {windows.rate:g} Hz"
    span = round((windows.frames - 1) * check_rate(fps, windows)) + 1
    uncut = len(shots) > 1 and shots[-1][1] >= span
    whole = ""
    if uncut:
        whole = "the video was cut between shots, so --shots none if it was not edited, or "
    return {
        "spans": index.short,
        "longest": max((end - first for first, end in spans), default=0),
        "window": f"{windows.frames} frames{at} take {span} of {fps:g} fps",
        "cure": f"{whole}{faster}lower --windows.frames",
    }


def _words(
    annotated: Annotated, config: ClipConfig, camera: str, frames: Int[np.ndarray, " T"], unit: str
) -> dict[str, Any]:
    """Returns a clip's ``task`` and ``provenance``."""
    episode = annotated.episode
    segment = segment_at(annotated.segments, frames) or Segment(0, 1, "")
    task = annotated.task or segment.text
    provenance = {
        "source": episode.meta.get("source", ""),
        "episode": episode.id,
        "origin": episode.meta.get("origin", {}),
        "fingerprint": episode.fingerprint,
        "camera": camera,
        "fit": config.fit,
        "fps": float(episode.fps),
        "frames": frames.tolist(),
        "segment": segment.text,
        "skill": segment.skill,
        "difficulty": config.categories.difficulty(task, segment.text, segment.skill),
        "scene": config.categories.scene(annotated.scene),
        "depth_unit": unit,
    }
    times = episode.timestamps[frames]
    if not np.allclose(np.diff(times), np.diff(frames) / episode.fps, atol=_UNEVEN):
        provenance["times"] = times.tolist()  # seconds; other clips' times follow from frames and fps
    if "reward" in episode.meta:
        provenance["reward"] = [episode.meta["reward"][frame] for frame in frames.tolist()]
    if annotated.motion is not None:
        provenance["motion"] = float(np.mean(annotated.motion[frames[0] + 1 : frames[-1] + 1]))
    return {"task": task or UNKNOWN, "provenance": provenance}


def _tracks(
    stored: FrameRecords | None, frames: Int[np.ndarray, " T"], count: int, placement: Placement | None
) -> Tracked | None:
    """Returns tracks of ``count`` of the points that are visible in a clip's first frame; None if there are none.

    Without a tracks step, the tracks are zeros that are never visible.
    """
    if stored is None:
        return Tracked(np.zeros((count, len(frames), 2), np.float32), np.zeros((count, len(frames)), bool))
    record = stored.with_frames(int(frames[0]), int(frames[-1]))
    if record is None or placement is None:
        return None
    columns = frames - record["first"]
    tracked = Tracked(*placement.tracks(record["points"][:, columns], record["visible"][:, columns]))
    if tracked.visible[:, 0].any():
        return window_tracks(tracked, np.arange(len(frames)), count)
    return None


def _depths(annotated: Annotated, camera: str, config: ClipConfig, pictures: "_Fitted") -> "tuple[_Fitted | None, str]":
    """Returns the depth maps and their unit; None and "" if there are none. Measured maps are preferred."""
    episode = annotated.episode
    if camera in episode.depth and config.recorded_depth:
        where = f"episode {episode.id}: depth of {camera}"
        filled = FilledDepths(episode.depth[camera], config.most_holes, where)
        return _Fitted(filled.read, config, pictures), "metres"
    if annotated.depth is not None and len(annotated.depth):
        estimated = StoredDepths(annotated.depth, episode)
        return _Fitted(estimated.read, config, pictures), estimated.unit
    return None, ""


class _Fitted:
    """Pictures or depth maps in the size of clips; each is read once for all overlapping windows that need it.

    Args:
        read: reads recorded pictures or maps.
        pictures: for depth maps, the pictures whose placement they follow; these are read first.
    """

    def __init__(
        self,
        read: Callable[[list[int]], Iterable[np.ndarray]],
        config: ClipConfig,
        pictures: "_Fitted | None" = None,
    ) -> None:
        self._read = read
        self._config = config
        self._pictures = pictures
        self.placement: Placement | None = None
        self._kept: dict[int, np.ndarray] = {}

    def read(self, frames: list[int]) -> Float[np.ndarray, "T S S *C"]:
        """Returns these frames. The first frame must not decrease from call to call: earlier frames are dropped."""
        missing = [frame for frame in frames if frame not in self._kept]
        new: Iterable[np.ndarray] = ()
        if missing:
            new = self._read(missing)
        kept = {frame: picture for frame, picture in self._kept.items() if frame >= frames[0]}
        leading = self._pictures or self  # not an attribute: a reference to itself would keep its pictures in memory
        for frame, picture in zip(missing, new, strict=True):
            if leading.placement is None:
                height, width = picture.shape[:2]
                leading.placement = Placement.create(self._config.fit, height, width, self._config.image_size)
            kept[frame] = leading.placement.picture(picture)
        self._kept = kept
        return np.stack([self._kept[frame] for frame in frames])
