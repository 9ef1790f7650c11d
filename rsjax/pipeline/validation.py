"""What is looked at while the tokenizer and the world model train, on the test split: scores and pictures.

Nothing here draws from a generator that training uses or changes anything that it reads.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.clip import Batch
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays, Transform
from rsjax.data.store import RecordSource, Store, StoreError
from rsjax.evaluation.depth import depth_scores
from rsjax.evaluation.pixels import psnr
from rsjax.evaluation.statistics import over_predicted_frames
from rsjax.pipeline.clips import Clips, readable, spread
from rsjax.pipeline.generator import Codec, Generator, Tokens, load_tokenizer
from rsjax.pipeline.run import Run
from rsjax.pipeline.transforms import TOKEN_ARRAYS, token_batch, token_clip
from rsjax.report.figures import ClipFigure, filmstrip
from rsjax.training.objectives import TokenizerObjective, WorldModelObjective
from rsjax.training.validation import HeldOut, held_out_loss


@dataclass(frozen=True)
class WorldModelHeldOut:
    """The objective over ``eval.loss_clips`` of the test split, and videos from first frames of ``eval.batch_size``.

    Reads the run's stores when it is called first.
    """

    run: Run

    def __call__(self, step: int, weights: Any) -> HeldOut:
        """Scores weights of the world model.

        Raises:
            StoreError: the run's stores are gone, or their test split has no readable clip.
        """
        cfg = self.run.config
        objective = WorldModelObjective.create(cfg)
        numbers = spread(self._tokens, cfg.eval.loss_clips)
        loss = held_out_loss(
            objective, weights, token_batches(self._tokens, self._transform, cfg.eval.batch_size, numbers)
        )
        scores, pictures = self._videos(step, weights)
        scalars = {f"held_out/{name}": value for name, value in (loss | scores).items()}
        return HeldOut(loss["loss"], scalars, pictures)

    def _videos(self, step: int, weights: Any) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        cfg, clips, given = self.run.config, self._clips, self.run.config.mask.prompt_frames
        generator = Generator(cfg, self._codec, weights)
        prompt = {name: grid[:, :given] for name, grid in self._tokens_of_clips.items()}
        made = generator.generate(prompt, clips.actions, cfg.sample, index=clips.index, has_depth=clips.has_depth)
        scores = {"psnr": float(over_predicted_frames(np.asarray(psnr(clips.rgb, made.rgb)), given).mean())}
        if made.depth is not None and clips.metric.any():
            truth, predicted = (depth[clips.metric, given:] for depth in (clips.depth, made.depth))
            scores["depth_absrel"] = float(depth_scores(truth, predicted, alignment="none").abs_rel.mean())
        pictures = {}
        for row, number in enumerate(clips.index[: cfg.eval.report_clips]):
            shows_depth = made.depth is not None and clips.has_depth[row]
            figure = ClipFigure(
                title=f"clip {number} at step {step}",
                truth=clips.rgb[row],
                prediction=made.rgb[row],
                true_depth=clips.depth[row] if shows_depth else None,
                predicted_depth=made.depth[row] if made.depth is not None and shows_depth else None,
                prompt_frames=given,
            )
            pictures[f"clip_{number:03d}"] = filmstrip(figure)
        return scores, pictures

    @cached_property
    def _tokens(self) -> RecordSource:
        return self.run.open_tokens().source("test")

    @cached_property
    def _transform(self) -> Transform:
        return partial(token_clip, self._codec.units, self.run.config.model.integrate_actions)

    @cached_property
    def _store(self) -> Store:
        return self.run.open_clips()

    @cached_property
    def _codec(self) -> Codec:
        return Codec(
            self.run.config, load_tokenizer(self.run.config, self.run.directory), Normalization.create(self._store)
        )

    @cached_property
    def _clips(self) -> Clips:
        return load_clips(self._store, self.run.config.eval.batch_size)

    @cached_property
    def _tokens_of_clips(self) -> Tokens:
        return self._clips.tokens(self._codec)


@dataclass(frozen=True)
class TokenizerHeldOut:
    """Frames and depth maps of ``eval.clips`` test clips, to tokens and back.

    Reads the run's store when it is called first.
    """

    run: Run

    def __call__(self, step: int, weights: Any) -> HeldOut:
        """Scores weights of the tokenizer's objective; the metric is the negative PSNR, as training mixes the two.

        Raises:
            StoreError: the run's store is gone, or its test split has no readable clip.
        """
        cfg, clips = self.run.config, self._clips
        params = TokenizerObjective(cfg.tokenizer, cfg.tokenizer_train).tokenizer_params(weights)
        codec = Codec(cfg, params, self._units)
        rgb = codec.decode_rgb(codec.encode_rgb(clips.rgb))
        shown = {number: [(clips.rgb[row], rgb[row])] for row, number in enumerate(clips.index)}
        of_rgb = _psnr(clips.rgb, rgb)
        metric, scalars = -of_rgb, {"held_out/psnr": of_rgb}
        if clips.has_depth.any() and self._units.depth_range:
            true = clips.depth[clips.has_depth]
            colors = depth_to_color(true, *self._units.depth_range, cfg.tokenizer.depth_scale).astype(np.uint8)
            depth = codec.decode_rgb(codec.encode_depth(true))
            for row, number in enumerate(clips.index[clips.has_depth]):
                shown[number].append((colors[row], depth[row]))
            scalars["held_out/psnr_depth"] = of_depth = _psnr(colors, depth)
            share = cfg.tokenizer_train.depth_share
            metric = -((1 - share) * of_rgb + share * of_depth)
        pictures = {
            f"clip_{number:03d}": _sheet(f"clip {number} at step {step}", shown[number])
            for number in clips.index[: cfg.eval.report_clips]
        }
        return HeldOut(metric, scalars, pictures)

    @cached_property
    def _store(self) -> Store:
        return self.run.open_clips()

    @cached_property
    def _units(self) -> Normalization:
        return Normalization.create(self._store)

    @cached_property
    def _clips(self) -> Clips:
        return load_clips(self._store, self.run.config.eval.clips)


def _psnr(truth: UInt8[np.ndarray, "B T H W 3"], seen: UInt8[np.ndarray, "B T H W 3"]) -> float:
    return float(np.mean(psnr(truth, seen)))


def _sheet(title: str, pairs: list[tuple[np.ndarray, np.ndarray]]) -> UInt8[np.ndarray, "h w 3"]:
    """Originals above reconstructions."""
    figures = (ClipFigure(title, truth, prediction=None, reconstruction=seen, prompt_frames=0) for truth, seen in pairs)
    return np.concatenate([filmstrip(figure) for figure in figures])


def load_clips(store: Store, count: int) -> Clips:
    """``count`` clips spread over the test split, without those of them that cannot be read.

    Raises:
        StoreError: none can be read.
    """
    source = store.source("test")
    found = list(readable(source, spread(source, count)))
    if not found:
        raise StoreError(f"{store.path}: its test split has no readable clip; delete it and make it again")
    return Clips.stacked([clip for _, clip in found], [number for number, _ in found])


def token_batches(
    source: RecordSource, transform: Transform, size: int, numbers: Iterable[int] | None = None
) -> Iterator[Batch]:
    """Token records as batches of one shape; a clip's place in its batch does not decide how it is masked.

    Args:
        numbers: the records that count; all if None.
    """
    rows: list[tuple[int, Arrays]] = []
    for number, record in readable(source, numbers):
        rows.append((number, transform(record, np.random.default_rng(0))))
        if len(rows) == size:
            yield _batch(rows, size)
            rows = []
    if rows:
        yield _batch(rows, size)


def _batch(rows: list[tuple[int, Arrays]], size: int) -> Batch:
    filled = rows + [rows[-1]] * (size - len(rows))
    arrays = {name: np.stack([row[name] for _, row in filled]) for name in TOKEN_ARRAYS}
    weight = (np.arange(size) < len(rows)).astype(np.float32)
    return token_batch(arrays | {"weight": weight, "index": np.array([number for number, _ in filled], np.int32)})
