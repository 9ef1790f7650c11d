"""Scores the tokenizer and the world model on held-out clips during training, with pictures.

These are the split "validation" of the run's store, or the split "test" if it has none. Validation affects training
only by an early stop (``train.early_stop``): it shares no random state with it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.clip import Video
from rsjax.data.clips import Clips, load_clips, readable, spread
from rsjax.data.loader import Arrays
from rsjax.data.normalization import Normalization
from rsjax.data.store import RecordSource, Store
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.evaluation.registry import Scene, Unavailable, metrics
from rsjax.evaluation.shown import REPORT_CLIPS
from rsjax.models.base import Assets, WorldModel, create_autoencoder, create_model
from rsjax.models.load_run import load_tokenizer
from rsjax.tokenizers.autoencoder import DepthCodec
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.report.figures import ClipFigure, filmstrip
from rsjax.trainable import Params
from rsjax.training.validation import Validation, validation_loss

LOSS_CLIPS = 1000  # spread evenly over the held-out split; more would only take time


@dataclass(frozen=True)
class WorldModelValidation:
    """Computes the loss over up to :data:`LOSS_CLIPS` held-out clips, and videos of ``eval.batch_size`` of them.

    The first call opens the run's stores. The best weights are those with the lowest loss or, for an early stop, with
    the highest PSNR where something moves in these videos.
    """

    run: Run

    def __call__(self, step: int, weights: Params) -> Validation:
        """Scores the world model with these weights.

        Raises:
            StoreError: the run's stores are missing, or their held-out split has no readable clip.
        """
        cfg = self.run.config
        numbers = spread(self._prepared, LOSS_CLIPS)
        batches = record_batches(self._model, self._assets.normalization, self._prepared, cfg.eval.batch_size, numbers)
        loss = validation_loss(self._model, weights, batches)
        clips = self._clips
        prompt = clips.video.frames(0, cfg.prompt_frames)
        made = self._model.generate(weights, self._assets, prompt, clips.actions, index=clips.index)
        scores = {}
        scene = Scene(clips.metric_video, made, cfg.prompt_frames)
        for metric in metrics().values():
            if metric.watch and metric.function is not None:
                with suppress(Unavailable):
                    scored = metric.function(scene)
                    scores[metric.name] = float(np.mean(scored[""] if isinstance(scored, dict) else scored))
        pictures = {}
        for row, number in enumerate(clips.index[:REPORT_CLIPS]):
            depth = made.depth[row] if made.depth is not None and clips.has_depth[row] else None
            figure = ClipFigure(
                title=f"clip {number} at step {step}",
                truth=clips.rgb[row],
                prediction=made.rgb[row],
                true_depth=None if depth is None else clips.depth[row],
                predicted_depth=depth,
                depth_unit="metres" if clips.metric[row] else "relative",
                prompt_frames=cfg.prompt_frames,
            )
            pictures[f"clip_{number:03d}"] = filmstrip(figure)
        scalars = {f"validation/{name}": value for name, value in (loss | scores).items()}
        decides = loss["loss"]
        if cfg.train.early_stop is not None:  # the loss rises long before the videos get worse
            decides = -scores.get("psnr_motion", scores["psnr"])
        return Validation(decides, scalars, pictures)

    @cached_property
    def _model(self) -> WorldModel[Any]:
        return create_model(self.run.config)

    @cached_property
    def _prepared(self) -> RecordSource:
        store = self.run.open_prepared()
        return store.source(held_out(store))

    @cached_property
    def _store(self) -> Store:
        return self.run.open_clips()

    @cached_property
    def _assets(self) -> Assets:
        return Assets(Normalization.create(self._store), load_tokenizer(self.run.config, self.run.directory))

    @cached_property
    def _clips(self) -> Clips:
        return load_clips(self._store, self.run.config.eval.batch_size, held_out(self._store))


def held_out(store: Store) -> str:
    """Returns the split that validations read: "validation", or "test" in a store without it."""
    if "validation" in store.splits:
        return "validation"
    return "test"


@dataclass(frozen=True)
class TokenizerValidation:
    """Scores the reconstruction of frames, and of depth maps if they are encoded, of ``eval.clips`` held-out clips.

    The first call opens the run's store.
    """

    run: Run

    def __call__(self, step: int, weights: Params) -> Validation:
        """Scores the tokenizer with these weights: the negative PSNR of frames and depth maps, mixed as in training.

        Raises:
            StoreError: the run's store is missing, or its held-out split has no readable clip.
        """
        cfg = self.run.config
        clips = self._clips
        autoencoder = create_autoencoder(cfg)
        codec = autoencoder.codec(autoencoder.tokenizer_params(weights), self._normalization)
        rgb = codec.decode(codec.encode(Video(clips.rgb)), np.zeros(len(clips.rgb), bool)).rgb
        shown = {number: [(clips.rgb[row], rgb[row])] for row, number in enumerate(clips.index)}
        of_rgb = _psnr(clips.rgb, rgb)
        metric = -of_rgb
        scalars = {"validation/psnr": of_rgb}
        pair = None
        if isinstance(codec, DepthCodec) and clips.has_depth.any() and self._normalization.depth_range:
            pair = codec.depth_pictures(clips.depth[clips.has_depth])
        if pair is not None:
            colors, depth = pair
            for row, number in enumerate(clips.index[clips.has_depth]):
                shown[number].append((colors[row], depth[row]))
            of_depth = _psnr(colors, depth)
            scalars["validation/psnr_depth"] = of_depth
            share = cfg.tokenizer_train.depth_share
            metric = -((1 - share) * of_rgb + share * of_depth)
        pictures = {}
        for number in clips.index[:REPORT_CLIPS]:
            strips = []  # originals above reconstructions
            for truth, decoded in shown[number]:
                title = f"clip {number} at step {step}"
                strips.append(filmstrip(ClipFigure(title, truth, None, reconstruction=decoded, prompt_frames=0)))
            pictures[f"clip_{number:03d}"] = np.concatenate(strips)
        return Validation(metric, scalars, pictures)

    @cached_property
    def _store(self) -> Store:
        return self.run.open_clips()

    @cached_property
    def _normalization(self) -> Normalization:
        return Normalization.create(self._store)

    @cached_property
    def _clips(self) -> Clips:
        return load_clips(self._store, self.run.config.eval.clips, held_out(self._store))


def _psnr(truth: UInt8[np.ndarray, "B T H W 3"], predicted: UInt8[np.ndarray, "B T H W 3"]) -> float:
    return float(np.mean(psnr(truth, predicted)))


def record_batches(
    model: WorldModel[Any], normalization: Normalization, source: RecordSource, size: int, numbers: Sequence[int]
) -> Iterator[Any]:
    """Yields records as batches of one shape; each clip's index is its number, which determines its masks.

    Args:
        source: a split of the prepared store.
        numbers: the records to read.
    """
    transform = model.transform(normalization)
    rows: list[tuple[int, Arrays]] = []
    for number, record in readable(source, numbers):
        rows.append((number, transform(record, np.random.default_rng(0))))
        if len(rows) == size:
            yield _batch(model, rows, size)
            rows = []
    if rows:
        yield _batch(model, rows, size)


def _batch(model: WorldModel[Any], rows: list[tuple[int, Arrays]], size: int) -> Any:
    filled = rows + [rows[-1]] * (size - len(rows))
    arrays = {name: np.stack([row[name] for _, row in filled]) for name in rows[0][1]}
    weight = (np.arange(size) < len(rows)).astype(np.float32)
    return model.batch(arrays | {"weight": weight, "index": np.array([number for number, _ in filled], np.int32)})
