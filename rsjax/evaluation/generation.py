"""Generates the videos of an evaluation in batches, on all devices; each batch is kept, so that it can resume later.

Axes: B clips, T frames, H×W pixels, A action dimensions, R draws of actions.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from rsjax.clip import Video
from rsjax.data.clips import Clips
from rsjax.data.codec import Record, decode, encode
from rsjax.evaluation.protocols import Protocol
from rsjax.files import regular, write_file
from rsjax.models.base import TeacherForced
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress

OWN = "own"  # the kind of videos generated under the clips' own actions
SAMPLE = "sample"  # the kind of further samples under the own actions, of which only the scores are kept


@dataclass(frozen=True)
class ClipBatch:
    """Some clips under one draw of actions.

    Attributes:
        run: the repetition's number.
        kind: the kind of actions, :data:`OWN`, "other" or "uniform"; or :data:`SAMPLE`.
        draw: the number of the draw of actions, or of the sample.
        start: the first clip's row.
        clips: the number of clips; it can change with the devices and the settings.
    """

    run: int
    kind: str
    draw: int
    start: int
    clips: int

    @property
    def name(self) -> str:
        """The name of the batch's file."""
        return f"{self.run:03d}-{self.kind}-{self.draw:03d}-{self.start:06d}+{self.clips}.msgpack"


@dataclass(frozen=True)
class Generation:
    """The videos that one evaluation generates.

    Attributes:
        trained: its parameters are on all devices that take part (:func:`rsjax.devices.replicate`).
        protocol: with its horizon as a number.
        clips: cut to the protocol's frames.
        draws: by kind, the actions under which videos are generated, each (R, B, T, A).
        split_size: the number of clips in the whole split, which keeps the random draws of repetitions apart.
        score: takes rows and one sample's videos of these clips, and returns their scores by name, each (rows,). The
            best score over the samples counts.
        folder: where batches are kept; None: in memory.
    """

    trained: TrainedModel
    protocol: Protocol
    clips: Clips
    draws: Mapping[str, Float[np.ndarray, "R B T A"]]
    split_size: int
    score: Callable[[Int[np.ndarray, " n"], Video], Record]
    folder: Path | None = None

    def make(self, index: int = 0, count: int = 1) -> None:
        """Generates the batches that do not exist yet; with ``count`` processes, only the share of number ``index``."""
        rows = [(kind, draw) for kind, actions in self.draws.items() for draw in range(len(actions))]
        rows += [(SAMPLE, sample) for sample in range(1, self.protocol.samples)]
        batches: list[ClipBatch] = []
        for run in range(self.protocol.repetitions):
            for kind, draw in rows:
                batches += self._row(run, kind, draw)
        batches = batches[index::count]
        with Progress("evaluation", sum(batch.clips for batch in batches), "rollouts") as progress:
            done = 0
            for batch in batches:
                if self._read(batch) is None:
                    self._keep(batch, self._generate(batch))
                progress.update(done := done + batch.clips)

    def videos(self, run: int) -> dict[str, list[Video]]:
        """Returns one repetition's videos by kind: for each draw of actions, the videos of all clips."""
        videos: dict[str, list[Video]] = {kind: [] for kind in self.draws}
        for kind, actions in self.draws.items():
            for draw in range(len(actions)):
                records = [self._record(batch) for batch in self._row(run, kind, draw)]
                parts = [Video(record["rgb"], record["depth"], state=record.get("state")) for record in records]
                videos[kind].append(_joined(parts))
        return videos

    def samples(self, run: int) -> list[dict[str, np.ndarray]]:
        """Returns each further sample's scores of one repetition by name, in the order of the clips."""
        out = []
        for sample in range(1, self.protocol.samples):
            records = [self._record(batch) for batch in self._row(run, SAMPLE, sample)]
            out.append({name: np.concatenate([record[name] for record in records]) for name in records[0]})
        return out

    def _row(self, run: int, kind: str, draw: int) -> Iterator[ClipBatch]:
        count = len(self.clips.rgb)
        size = batch_size(self.trained, count)
        yield from (ClipBatch(run, kind, draw, start, min(size, count - start)) for start in range(0, count, size))

    @cached_property
    def _truth(self) -> Video:
        return self.clips.video

    @cached_property
    def _memory(self) -> dict[ClipBatch, Record]:
        return {}

    def _record(self, batch: ClipBatch) -> Record:
        record = self._read(batch)
        if record is None:  # the file was damaged or deleted in the meantime
            record = self._generate(batch)
            self._keep(batch, record)
        return record

    def _read(self, batch: ClipBatch) -> Record | None:
        if self.folder is None:
            return self._memory.get(batch)
        try:
            return decode(regular(self.folder / batch.name).read_bytes())
        except (OSError, ValueError):
            return None

    def _keep(self, batch: ClipBatch, record: Record) -> None:
        if self.folder is None:
            self._memory[batch] = record
        else:
            write_file(self.folder / batch.name, encode(record))

    def _generate(self, batch: ClipBatch) -> Record:
        """Generates a batch; the last batch is padded to the others' size, so that only one program is compiled."""
        sampled = batch.kind == SAMPLE
        rows = np.arange(batch.start, batch.start + batch.clips)
        size = batch_size(self.trained, len(self.clips.rgb))
        padded = np.minimum(np.arange(batch.start, batch.start + size), rows[-1])
        own = self.draws[OWN][0]
        actions = own if sampled else self.draws[batch.kind][batch.draw]
        repetition = batch.run * self.protocol.samples + (batch.draw if sampled else 0)
        index = self.clips.index[padded] + repetition * self.split_size
        with_depth = batch.kind == OWN
        generate = partial(
            self.trained.model.generate, self.trained.params, self.trained.assets, index=index, depth=with_depth
        )
        inputs = (self._truth[padded], own[padded], actions[padded])
        video = rolled_out(generate, self.protocol, *inputs)[: len(rows)]
        return self.score(rows, video) if sampled else {"rgb": video.rgb, "depth": video.depth, "state": video.state}


def batch_size(trained: TrainedModel, count: int) -> int:
    """Returns the clips per batch: the run's number or all ``count``, rounded up to a multiple of the local devices."""
    devices = jax.local_device_count()
    return -(-min(trained.config.eval.batch_size, count) // devices) * devices


def teacher_forced(
    trained: TrainedModel, prompt_frames: int, video: Video, actions: Float[np.ndarray, "B T A"]
) -> TeacherForced | None:
    """Predicts every frame's tokens from the true frames before it; returns None if the model cannot do this.

    This costs less than one of the several rollouts of each clip, so the result is neither kept nor divided among
    processes.
    """
    parts = list[TeacherForced]()
    count = len(video)
    size = batch_size(trained, count)
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)  # the last batch is padded to full size
        inputs = (trained.params, trained.assets, video[rows], actions[rows])
        part = trained.model.teacher_forced(*inputs, prompt_frames)
        if part is None:
            return None
        parts.append(part)

    def joined(name: str) -> Any:
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *[getattr(part, name) for part in parts])

    return TeacherForced(**{field.name: joined(field.name) for field in fields(TeacherForced)})


def rolled_out(
    generate: Callable[..., Video],
    protocol: Protocol,
    truth: Video,
    own: Float[np.ndarray, "B T A"],
    actions: Float[np.ndarray, "B T A"],
) -> Video:
    """Returns the generated videos; each frame is predicted from the generated frames before it, or the recorded ones.

    Args:
        own: the clips' own actions, which led to the recorded frames that generation starts from.
        actions: the actions that lead to the generated frames.
    """
    prompt = protocol.prompt_frames
    frames = actions.shape[1]

    def after(past: int, until: int) -> Video:
        return generate(truth.frames(0, past), np.concatenate([own[:, :past], actions[:, past:until]], axis=1))

    if not protocol.teacher_forced:
        return after(prompt, frames)
    steps = [after(past, past + 1) for past in range(prompt, frames)]
    return _joined([steps[0], *(step.frames(-1) for step in steps[1:])], axis=1)


def with_baselines(trained: TrainedModel, clips: Clips, prediction: Video, prompt_frames: int) -> dict[str, Video]:
    """Returns the prediction and both baselines by the suffix that names their scores.

    "_repeat_first" repeats the last prompt frame; "_tokenizer" is the reconstruction of the recorded frames, for models
    that have one.
    """
    frames = clips.rgb.shape[1]
    last = clips.metric_video.frames(prompt_frames - 1, prompt_frames)
    still = Video(np.repeat(last.rgb, frames, 1))
    if last.depth is not None:
        still = replace(still, depth=np.repeat(last.depth, frames, 1))
    shown = {"": prediction, "_repeat_first": still}
    reconstruction = trained.model.reconstruct(trained.assets, clips.video)
    if reconstruction is not None:
        shown["_tokenizer"] = reconstruction
    return shown


def _joined(parts: list[Video], axis: int = 0) -> Video:
    """Joins videos of several batches, or parts of one video; a part without depth gets NaN if another has depth."""
    rgb = np.concatenate([part.rgb for part in parts], axis)
    states = [part.state for part in parts if part.state is not None]
    joined = Video(rgb, state=np.concatenate(states, axis) if states else None)
    if all(part.depth is None for part in parts):
        return joined
    unknown = [np.full(part.rgb.shape[:-1], np.nan, np.float32) if part.depth is None else part.depth for part in parts]
    return replace(joined, depth=np.concatenate(unknown, axis))
