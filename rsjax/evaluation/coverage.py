"""How far a video's states and actions are from the clips that a world model was trained on.

Frame t of a video is the vector x_t = [f_t / √C, a_t / √A]: f_t are the network's features of the frame before it sees
the frame, from the frames before and the action into it (:attr:`rsjax.models.base.TeacherForced.features`), a_t is that
action. Both are standardised over the bank, the frames of some training clips. With the k nearest frames of the bank,

    d_t = 1/k Σ_i ‖x_t - b_i‖,   D = 1/n Σ_t d_t over the n predicted frames.

For a training clip of the bank its own frames do not count, so it is as if held out. A video's coverage is D in units
of the median of the training clips' D: 1 is as far as a training clip usually is from the others. Its percentile is
the share of them that are nearer. Above the 99th, the model has not seen the like.

Axes: B videos, P predicted frames, C features, A numbers of an action, M frames of the bank.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from rsjax.artifact import is_finished, make_once
from rsjax.clip import Video
from rsjax.config import content_key
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.codec import decode, encode
from rsjax.data.store import Store
from rsjax.evaluation.generation import teacher_forced
from rsjax.evaluation.results import fingerprint
from rsjax.files import regular, write_file
from rsjax.model_directory import output_directory
from rsjax.models.trained import TrainedModel

FOLDER = "coverage"  # in the run directory
FILE = "bank.msgpack"
RECIPE = 1  # increase it when the same run gives another bank
CLIPS = 200  # training clips in the bank
NEAREST = 5  # k
UNSEEN = 0.99  # percentile above which the model has not seen the like
LEAST = 1e-3  # standard deviation of a number that hardly varies, so that it is not amplified
ROWS = 512  # frames whose distances are computed at once


@dataclass(frozen=True)
class Coverage:
    """The bank of a trained model, and how far its clips are from one another.

    Attributes:
        frames: x of the bank.
        clip: the number of each frame's clip in the bank.
        shift, scale: x is ([f, a] - shift) / scale.
        frame_distances: d of the bank's frames, sorted.
        clip_distances: D of the bank's clips, sorted.
    """

    frames: Float32[np.ndarray, "M K"]
    clip: Int[np.ndarray, " M"]
    shift: Float[np.ndarray, " K"]
    scale: Float[np.ndarray, " K"]
    frame_distances: Float[np.ndarray, " M"]
    clip_distances: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, features: Float[np.ndarray, "N P C"], actions: Float[np.ndarray, "N P A"]) -> "Coverage":
        """Makes the bank of at least two clips' features and actions."""
        rows = np.concatenate([features, actions], axis=-1).astype(np.float64)
        clips, frames, width = rows.shape
        rows = rows.reshape(-1, width)
        parts = np.repeat([features.shape[-1], actions.shape[-1]], [features.shape[-1], actions.shape[-1]])
        shift = rows.mean(0)
        scale = np.maximum(rows.std(0), LEAST) * np.sqrt(parts)
        bank = ((rows - shift) / scale).astype(np.float32)
        number = np.repeat(np.arange(clips), frames)
        distances = nearest(bank, bank, number[:, None] == number)
        of_clips = np.sort(distances.reshape(clips, frames).mean(1))
        return cls(bank, number, shift, scale, np.sort(distances), of_clips)

    def distances(
        self, features: Float[np.ndarray, "*B C"], actions: Float[np.ndarray, "*B A"]
    ) -> Float[np.ndarray, "*B"]:
        """Returns d of each frame."""
        rows = (np.concatenate([features, actions], axis=-1) - self.shift) / self.scale
        found = nearest(rows.reshape(-1, rows.shape[-1]).astype(np.float32), self.frames)
        return found.reshape(rows.shape[:-1])

    def of_frames(self, distances: Float[np.ndarray, "*B"]) -> tuple[np.ndarray, np.ndarray]:
        """Returns single frames' distances in units of the bank's median, and their percentiles, 0 to 1."""
        return _among(self.frame_distances, distances)

    def of_clips(self, distances: Float[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray]:
        """Returns coverage and percentile of videos with these D."""
        return _among(self.clip_distances, distances)


def _among(known: Float[np.ndarray, " N"], values: Float[np.ndarray, "*B"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns values in units of the median of the known ones, which are sorted, and the share that is lower."""
    return values / np.median(known), np.searchsorted(known, values, side="left") / len(known)


def nearest(
    rows: Float32[np.ndarray, "Q K"], bank: Float32[np.ndarray, "M K"], without: Any = None
) -> Float[np.ndarray, " Q"]:
    """Returns the mean distance of each row to its ``NEAREST`` rows of the bank.

    Args:
        without: (Q, M), True where a row of the bank does not count.
    """
    squares = np.square(bank, dtype=np.float64).sum(1)
    count = min(NEAREST, len(bank))
    if without is not None:
        count = min(count, int((~without).sum(1).min()))  # in a small bank
    means = []
    for start in range(0, len(rows), ROWS):
        part = rows[start : start + ROWS].astype(np.float64)
        distances = np.square(part).sum(1)[:, None] - 2 * part @ bank.T.astype(np.float64) + squares
        if without is not None:
            distances[without[start : start + ROWS]] = np.inf
        least = np.partition(distances, count - 1, axis=1)[:, :count]
        means.append(np.sqrt(np.maximum(least, 0)).mean(1))
    return np.concatenate(means)


def features_of(
    trained: TrainedModel, video: Video, actions: Float[np.ndarray, "B T A"], prompt_frames: int
) -> Float[np.ndarray, "B P C"] | None:
    """Returns f of every frame after the prompt; None for a family that returns no features."""
    scores = teacher_forced(trained, prompt_frames, video, actions)
    if scores is None:
        return None
    return scores.features


def clip_distances(
    trained: TrainedModel, coverage: Coverage, video: Video, actions: Float[np.ndarray, "B T A"], lengths: Sequence[int]
) -> Float[np.ndarray, " B"]:
    """Returns D of each video over its first ``lengths`` frames.

    Args:
        actions: row t led into frame t.
        lengths: at least one frame more than the prompt, or the first predicted frame counts alone.
    """
    first = trained.config.prompt_frames
    features = features_of(trained, video, actions, first)
    assert features is not None
    found = coverage.distances(features, actions[:, first:])
    return np.array([row[: max(1, length - first)].mean() for row, length in zip(found, lengths, strict=True)])


def make_coverage(trained: TrainedModel, store: Store, run: Path, clips: int = CLIPS) -> Coverage | None:
    """Returns the bank of a run's model, made once and kept in ``RUN/coverage``; None for a family without features.

    Args:
        store: the run's clips, whose train split the model learned from; without one, as in a saved model, there is no
            bank.
        clips: training clips in the bank, spread over the split.
    """
    if "train" not in store.splits:
        return None
    folder = output_directory(run, FOLDER)
    key = coverage_key(trained, store, clips)
    with make_once(folder, key, refuse=None, wait=True) as work:
        if not work.finished or (work.metadata.get("made", True) and _read(folder) is None):
            source = store.source("train")
            records = [record for _, record in readable(source, spread(source, clips))]
            batch = Clips.stacked(records, range(len(records)))
            first = trained.config.prompt_frames
            features = features_of(trained, batch.video, batch.actions, first)
            work.save(made=features is not None and len(records) > 1)
            if features is not None and len(records) > 1:
                made = Coverage.of(features, batch.actions[:, first:])
                write_file(folder / FILE, encode({field.name: getattr(made, field.name) for field in fields(made)}))
    return read_coverage(trained, store, run, clips)


def read_coverage(trained: TrainedModel, store: Store, run: Path, clips: int = CLIPS) -> Coverage | None:
    """Returns the bank that :func:`make_coverage` has made of this model; None if there is none, or it is damaged."""
    folder = output_directory(run, FOLDER)
    if not is_finished(folder, coverage_key(trained, store, clips)):
        return None
    return _read(folder)


def _read(folder: Path) -> Coverage | None:
    try:
        return Coverage(**decode(regular(folder / FILE).read_bytes()))
    except (OSError, ValueError, TypeError):
        return None


def coverage_key(trained: TrainedModel, store: Store, clips: int = CLIPS) -> str:
    """Returns the content key of a bank: weights, tokenizer, normalization, clips and settings."""
    assets = trained.assets
    weights = fingerprint((trained.params, assets.tokenizer))
    settings = (trained.config.model, trained.config.prompt_frames, str(assets.normalization))
    return content_key("coverage", RECIPE, weights, *settings, str(store.manifest.get("key")), clips, NEAREST)
