"""Makes copies of a run's clips whose training depth or tracks are estimated from their frames, as the paper's are.

A simulator's depth and tracks are exact; those of recordings come from methods that err. With these copies a model
learns from annotations with errors, on the same clips, and is scored on exact ones: only the train split changes.

- Tracks: Lucas–Kanade follows the points that a clip's own tracks start from.
- Depth: the network of :mod:`rsjax.evaluation.depth_network`. It would hardly err on clips that it has learned from, so
  there are two, each trained on one half of the training clips and used on the other.

A component of ``train.curriculum`` chooses such a copy by its ``annotations``.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from rsjax.config import ComponentConfig, LoopConfig, content_key
from rsjax.data.clips import readable, spread
from rsjax.data.codec import Record
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store, StoreError, complete_key, open_store, write_store
from rsjax.evaluation.depth_network import BATCH, DepthNetwork, train_depth_network
from rsjax.files import disk_guard, making
from rsjax.models.base import Assets, create_model
from rsjax.models.load_run import load_tokenizer
from rsjax.progress import Progress, note
from rsjax.tools.ingest.annotators.tracks import LucasKanade
from rsjax.tools.pipeline.run import Run

CLIPS = 500  # of a half, from which its network learns at most
PASSES = 6  # over the frames of these clips
RECIPE = 1  # raise when the same clips give other annotations
ERRORS = "annotation_errors"  # entry of the manifest: means over the clips of :func:`errors`
_OWN_ENTRIES = ("format", "kind", "splits")  # of a manifest, which the copy does not take over


def with_estimates(run: Run, loop: LoopConfig) -> LoopConfig:
    """Returns the world model's loop, whose components with estimated annotations name the stores that have them.

    Makes the stores that are missing. Errors as in :func:`estimated_clips`.
    """

    def named(component: ComponentConfig) -> ComponentConfig:
        if component.annotations == "own":
            return component
        clips = estimated_clips(run, component.annotations)
        assets = Assets(Normalization.create(run.open_clips()), load_tokenizer(run.config, run.directory))
        folder = run.directory / "world_model" / component.annotations
        with disk_guard(folder):
            folder.mkdir(parents=True, exist_ok=True)
        store = create_model(run.config).prepare(clips, assets, folder, run.config.runtime.max_damaged) or clips
        return replace(component, annotations="own", store=str(store.path))

    stages = [replace(stage, components=tuple(map(named, stage.components))) for stage in loop.curriculum]
    return replace(loop, curriculum=tuple(stages))


def estimated_clips(run: Run, annotations: str) -> Store:
    """Returns the copy of the run's clips with these estimates; makes it once for all runs on the same clips.

    Args:
        annotations: "estimated_tracks", "estimated_depth", or "estimated" for both.

    Raises:
        StoreError: half of the training clips have no depth in metres from which a network could learn.
    """
    base = run.open_clips()
    if annotations == "estimated":
        base = estimated_clips(run, "estimated_depth")
    key = content_key("estimated annotations", RECIPE, str(base.manifest.get("key")), annotations, CLIPS, PASSES)
    out = run.data_directory / f"{run.clips.name}-{annotations}-{key}"
    train = base.source("train")
    means = dict(base.manifest.get(ERRORS, {}))

    def estimated(estimate: Callable[[int, Record], Record]) -> Iterator[Record]:
        rows: dict[str, list[float]] = {}
        with Progress(annotations.replace("_", " "), len(train), "clips") as progress:
            for number, clip in readable(train):
                changed = estimate(number, clip)
                for name, error in errors(clip, changed).items():
                    rows.setdefault(name, []).append(error)
                progress.update(number + 1)
                yield clip | changed
        means.update({name: float(np.mean(column)) for name, column in rows.items()})

    with making(out, wait=True):
        if complete_key(out) == key:
            return open_store(out)
        estimate: Callable[[int, Record], Record] = lambda _, clip: followed(clip)  # noqa: E731
        if annotations == "estimated_depth":
            estimate = _depth_of_halves(base)
        meta = {name: value for name, value in base.manifest.items() if name not in _OWN_ENTRIES}
        meta |= {"key": key, "annotations": annotations, ERRORS: means}  # means are known when the manifest is written
        splits = {name: (clip for _, clip in readable(base.source(name))) for name in base.splits}
        write_store(out, "clips", {**splits, "train": estimated(estimate)}, meta)
        note(f"{out.name}: {', '.join(f'{name} {value:.3f}' for name, value in means.items())}")
    return open_store(out)


def _depth_of_halves(clips: Store) -> Callable[[int, Record], Record]:
    """Returns a function that estimates the depth of a training clip by the network that learned from the other half.

    Pixels without depth, and clips without, stay without it.
    """
    count = len(clips.source("train"))
    half = count // 2
    of_first = _network(clips, range(half, count))
    of_second = _network(clips, range(half))

    def estimate(number: int, clip: Record) -> Record:
        if clip["depth"] is None:
            return {}
        network = of_second
        if number < half:
            network = of_first
        maps = network(clip["rgb"]).maps
        return {"depth": np.where(clip["depth"] > 0, maps, 0).astype(np.float32)}

    return estimate


def _network(clips: Store, numbers: range) -> DepthNetwork:
    """Returns a network that has learned depth from these training clips, or from ``CLIPS`` of them."""
    chosen = [numbers[place] for place in spread(numbers, CLIPS)]
    known = [clip for _, clip in readable(clips.source("train"), chosen) if clip["depth"] is not None]
    known = [clip for clip in known if clip["provenance"].get("depth_unit", "metres") == "metres"]
    if not known:
        raise StoreError(
            f"{clips.path}: {len(numbers)} of its training clips, one half, have no depth in metres from which that of "
            f"the other half could be estimated; train with annotations own or estimated_tracks"
        )
    frames = sum(len(clip["rgb"]) for clip in known)
    return train_depth_network(known, math.ceil(PASSES * frames / BATCH))


def followed(clip: Record) -> Record:
    """Returns ``tracks`` and ``visible`` of a clip as Lucas–Kanade follows its points from frame 0."""
    tracks = clip["tracks"].copy()
    visible = clip["visible"].copy()
    begun = np.flatnonzero(visible[:, 0])
    tracks[begun], visible[begun] = LucasKanade().follow(clip["rgb"], tracks[begun, 0])
    return {"tracks": tracks, "visible": visible}


def errors(clip: Record, estimates: Record) -> dict[str, float]:
    """Returns how far estimates are from a clip's own depth or tracks.

    Returns:
        Of depth: ``depth``, the mean of |d̂ - d| / d. Of tracks: ``tracks``, the mean distance of a point from its own
        track in pixels, over the later frames in which both show it, and ``visibility``, the share of points and later
        frames in which only one of them shows it. Points that frame 0 does not show do not count.
    """
    by_name = {}
    if "depth" in estimates:
        known = clip["depth"] > 0
        by_name["depth"] = float(np.mean(np.abs(estimates["depth"][known] / clip["depth"][known] - 1)))
    begun = clip["visible"][:, 0]
    if "tracks" in estimates and begun.any():
        own = clip["visible"][begun, 1:]
        made = estimates["visible"][begun, 1:]
        distance = np.linalg.norm(estimates["tracks"] - clip["tracks"], axis=-1)[begun, 1:] * clip["rgb"].shape[2]
        by_name["tracks"] = float(np.sum(distance, where=own & made) / max(1, np.sum(own & made)))
        by_name["visibility"] = float(np.mean(own != made))
    return by_name
