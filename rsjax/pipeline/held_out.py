"""What is looked at while the tokenizer and the world model train, on the test split: scores and pictures.

Nothing here draws from a generator that training uses or changes anything that it reads.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rsjax.clip import Batch
from rsjax.data.loader import RecordSource
from rsjax.data.store import Record, Store, StoreError, open_store
from rsjax.metrics.depth import depth_scores
from rsjax.metrics.pixels import psnr
from rsjax.metrics.statistics import over_predicted_frames
from rsjax.pipeline.run import Run
from rsjax.progress import note
from rsjax.report.figures import ClipFigure, filmstrip
from rsjax.sample.generator import Codec, Generator, Units, load_tokenizer
from rsjax.tokenizer.depth_color import depth_to_color
from rsjax.train.held_out import HeldOut, held_out_loss
from rsjax.train.objectives import TokenizerObjective, WorldModelObjective

_BATCH_FIELDS = ("rgb", "depth", "actions", "tracks", "visible")


@dataclass(frozen=True)
class WorldModelHeldOut:
    """The objective over the whole test split, and videos from the first frames of its first ``eval.batch_size`` clips.

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
        loss = held_out_loss(objective, weights, token_batches(self._tokens, cfg.eval.batch_size))
        scores, pictures = self._videos(step, weights)
        scalars = {f"held_out/{name}": value for name, value in (loss | scores).items()}
        return HeldOut(loss["loss"], scalars, pictures)

    def _videos(self, step: int, weights: Any) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        cfg, clips, given = self.run.config, self._clips, self.run.config.mask.prompt_frames
        generator = Generator(cfg, self._codec, weights)
        prompt = {name: grid[:, :given] for name, grid in clips.tokens.items()}
        made = generator.generate(prompt, clips.actions, cfg.sample, index=clips.index)
        scores = {"psnr": float(over_predicted_frames(np.asarray(psnr(clips.rgb, made.rgb)), given).mean())}
        if made.depth is not None:
            depth = depth_scores(clips.depth[:, given:], made.depth[:, given:], alignment="none")
            scores["depth_absrel"] = float(depth.abs_rel.mean())
        pictures = {}
        for row, number in enumerate(clips.index[: cfg.eval.report_clips]):
            figure = ClipFigure(
                title=f"clip {number} at step {step}",
                truth=clips.rgb[row],
                prediction=made.rgb[row],
                true_depth=None if made.depth is None else clips.depth[row],
                predicted_depth=None if made.depth is None else made.depth[row],
                prompt_frames=given,
            )
            pictures[f"clip_{number:03d}"] = filmstrip(figure)
        return scores, pictures

    @cached_property
    def _tokens(self) -> RecordSource:
        return open_store(self.run.output("tokens")).source("test")

    @cached_property
    def _codec(self) -> Codec:
        tokenizer = load_tokenizer(self.run.config, self.run.directory)
        return Codec(self.run.config, tokenizer, Units.create(open_store(self.run.clips)))

    @cached_property
    def _clips(self) -> "_Clips":
        return _Clips.load(open_store(self.run.clips), self.run.config.eval.batch_size, self._codec)


@dataclass(frozen=True)
class TokenizerHeldOut:
    """Frames and depth maps of the first ``eval.clips`` test clips, to tokens and back.

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
        colors = depth_to_color(clips.depth, *self._units.depth_range, cfg.tokenizer.depth_scale).astype(np.uint8)
        rgb = codec.decode_rgb(codec.encode_rgb(clips.rgb))
        depth = codec.decode_rgb(codec.encode_depth(clips.depth))
        of_rgb, of_depth = float(np.mean(psnr(clips.rgb, rgb))), float(np.mean(psnr(colors, depth)))
        share = cfg.tokenizer_train.depth_share
        pictures = {}
        for row, number in enumerate(clips.index[: cfg.eval.report_clips]):
            title = f"clip {number} at step {step}"
            sheets = [
                filmstrip(
                    ClipFigure(title, truth=truth[row], prediction=None, reconstruction=seen[row], prompt_frames=0)
                )
                for truth, seen in ((clips.rgb, rgb), (colors, depth))
            ]
            pictures[f"clip_{number:03d}"] = np.concatenate(sheets)
        scalars = {"held_out/psnr": of_rgb, "held_out/psnr_depth": of_depth}
        return HeldOut(-((1 - share) * of_rgb + share * of_depth), scalars, pictures)

    @cached_property
    def _store(self) -> Store:
        return open_store(self.run.clips)

    @cached_property
    def _units(self) -> Units:
        return Units.create(self._store)

    @cached_property
    def _clips(self) -> "_Clips":
        return _Clips.load(self._store, self.run.config.eval.clips)


@dataclass(frozen=True)
class _Clips:
    """Held-out clips, stacked, with their numbers in the split."""

    index: np.ndarray
    rgb: np.ndarray
    depth: np.ndarray
    actions: np.ndarray
    tokens: dict[str, np.ndarray]

    @classmethod
    def load(cls, store: Store, count: int, codec: Codec | None = None) -> "_Clips":
        """The first ``count`` readable clips of the test split, tokenized where there is a codec."""
        source = store.source("test")
        found = [pair for pair, _ in zip(readable(source), range(count), strict=False)]
        if not found:
            raise StoreError(f"{store.path}: its test split has no readable clip; delete it and make it again")
        fields = {name: np.stack([clip[name] for _, clip in found]) for name in ("rgb", "depth", "actions")}
        tokens = {}
        if codec is not None:
            tokens = {"rgb": codec.encode_rgb(fields["rgb"]), "depth": codec.encode_depth(fields["depth"])}
        return cls(np.array([number for number, _ in found]), **fields, tokens=tokens)


def readable(source: RecordSource, tell: Callable[[str], None] = note) -> Iterator[tuple[int, Record]]:
    """The records of a split that can be read, with their numbers; the others are told. Training need not end here."""
    for number in range(len(source)):
        try:
            record = source[number]
        except StoreError as error:
            tell(f"{error}; it is left out of the held-out scores")
            continue
        yield number, record


def token_batches(source: RecordSource, size: int) -> Iterator[Batch]:
    """Token records as batches of one shape; a clip's place in its batch does not decide how it is masked."""
    rows: list[tuple[int, Record]] = []
    for row in readable(source):
        rows.append(row)
        if len(rows) == size:
            yield _batch(rows, size)
            rows = []
    if rows:
        yield _batch(rows, size)


def _batch(rows: list[tuple[int, Record]], size: int) -> Batch:
    filled = rows + [rows[-1]] * (size - len(rows))
    return Batch(
        **{name: np.stack([record[name] for _, record in filled]) for name in _BATCH_FIELDS},
        weight=(np.arange(size) < len(rows)).astype(np.float32),
        index=np.array([number for number, _ in filled], np.int32),
    )
