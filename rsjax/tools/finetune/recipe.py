"""Decides whether the tokenizer is kept, and makes the configuration of the run."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rsjax.clip import Video
from rsjax.config import (
    BackwardsConfig,
    Config,
    CurriculumStageConfig,
    EarlyStopConfig,
    KeepStillConfig,
    RuntimeConfig,
    TokenModelConfig,
    require,
)
from rsjax.data.clips import load_clips
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.evaluation.metrics.psnr_motion import moved
from rsjax.models.base import create_autoencoder
from rsjax.tools.convert import directory as converted
from rsjax.tools.finetune.start import StartingModel
from rsjax.tools.ingest.actions import described_kinds
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.pipeline.validation import held_out

MARGIN = 3.0  # dB by which the tokenizer's reconstruction must be better than the first frame repeated, to be kept
MEASURED_CLIPS = 32
FIXED_CAMERA = 0.5  # share of the pixels that may move by a clip's end if the camera stands still
VALIDATIONS = 8  # of each training, at most
LEAST_BETWEEN = 20  # steps from one to the next, since each generates videos
EPOCHS = 54  # of the world model
TOKENIZER_EPOCHS = 27
LEAST_STEPS = 100
MOST_STEPS = 1500
MOST_TOKENIZER_STEPS = 600
FEW_HELD_OUT = 30  # clips; fewer choose among weights by chance
FEW_CLIPS = 300  # of the training split; with fewer, clips of targets also run backwards
COPIES = 12  # moved copies of each clip, at least, where the model was trained with some: few clips last longer


@dataclass(frozen=True)
class Finetuning:
    """The settings of a fine-tuning.

    Attributes:
        steps: training steps of the world model at most; an early stop may end it before. -1: by the number of clips
            (:meth:`for_clips`); 0: none, which measures the model as it is, with ``tokenizer`` keep.
        tokenizer_steps: those of the tokenizer, if it is adapted; -1: likewise.
        tokenizer: measure: keep it if it reconstructs the new frames well (:func:`keeps_tokenizer`); or keep or adapt.
        learning_rate, tokenizer_learning_rate: peaks, as shares of those that the model was trained with.
        short_share: share of the world model's steps on the first half of each clip.
        patience: validations without a new best one that end a training; there are eight in a whole training, so that 8
            ends none early, and the weights are those of the best validation. 0: the world model's last weights count.
            -1: 8, or 0 with few held-out clips (:data:`FEW_HELD_OUT`).
        seed: of both trainings.
        keep_still: whether videos keep what stands still (:class:`rsjax.config.KeepStillConfig`); measure: if the
            camera stands still (:data:`FIXED_CAMERA`).
        backwards: whether half of the drawn clips run backwards (:class:`rsjax.config.BackwardsConfig`); measure: if
            there are few (:data:`FEW_CLIPS`) whose actions are targets; on: also of steps, if the data set says so.
    """

    steps: int = -1
    tokenizer_steps: int = -1
    tokenizer: Literal["measure", "keep", "adapt"] = "measure"
    learning_rate: float = 0.5
    tokenizer_learning_rate: float = 1.0
    short_share: float = 0.0
    patience: int = -1
    seed: int = 0
    keep_still: Literal["measure", "on", "off"] = "measure"
    backwards: Literal["measure", "on", "off"] = "measure"

    def __post_init__(self) -> None:
        require(self.steps >= -1, f"--steps is {self.steps}; give a number, or -1 for as many as suit the clips")
        require(
            self.tokenizer_steps == -1 or self.tokenizer_steps >= 1,
            f"--tokenizer-steps is {self.tokenizer_steps}; give a number above 0, or -1 for as many as suit the clips",
        )
        require(self.patience >= -1, f"--patience is {self.patience}; give a number of validations, 0, or -1")
        for name in ("learning_rate", "tokenizer_learning_rate"):
            value = getattr(self, name)
            require(value > 0, f"--{name.replace('_', '-')} is {value}; it is a share of the model's own, above 0")
        require(0 <= self.short_share < 1, f"--short-share is {self.short_share}; it is a share of the steps, below 1")

    def for_clips(self, config: Config, clips: int) -> "Finetuning":
        """Returns the settings with steps for this many training clips, where they are not given.

        Few clips are soon memorised, so each is drawn a number of times; the bounds are for few and many clips.
        """

        def steps(given: int, batch: int, epochs: int, most: int) -> int:
            if given >= 0:
                return given
            return min(most, max(LEAST_STEPS, round(epochs * clips / batch)))

        return replace(
            self,
            steps=steps(self.steps, config.train.batch_size, EPOCHS, MOST_STEPS),
            tokenizer_steps=steps(
                self.tokenizer_steps, config.tokenizer_train.batch_size, TOKENIZER_EPOCHS, MOST_TOKENIZER_STEPS
            ),
        )


@dataclass(frozen=True)
class ReconstructionScores:
    """The PSNR, in dB, of held-out frames of the recordings that a tokenizer reconstructs.

    Attributes:
        psnr: of the tokenizer.
        repeat_first: of the first frame repeated, which a world model has to beat.
    """

    psnr: float
    repeat_first: float

    @property
    def good(self) -> bool:
        """Whether a world model on these tokens could be clearly better than the first frame repeated."""
        return self.psnr >= self.repeat_first + MARGIN

    def __str__(self) -> str:
        made = f"reconstructs held-out frames with {self.psnr:.1f} dB"
        return f"{made}, the first frame repeated has {self.repeat_first:.1f}"


def measure_tokenizer(source: StartingModel, store: Store) -> ReconstructionScores:
    """Measures the tokenizer of a model on held-out clips of the recordings."""
    _, params = converted.load_tokenizer(source.directory)
    codec = create_autoencoder(source.config).codec(params, Normalization.create(store))
    rgb = load_clips(store, MEASURED_CLIPS, held_out(store)).rgb
    made = codec.decode(codec.encode(Video(rgb)), np.zeros(len(rgb), bool)).rgb
    repeated = np.repeat(rgb[:, :1], rgb.shape[1] - 1, axis=1)
    return ReconstructionScores(float(np.mean(psnr(rgb, made))), float(np.mean(psnr(rgb[:, 1:], repeated))))


def moving_share(store: Store) -> float:
    """Returns the share of the pixels that have moved by the end of held-out clips, as ``psnr_motion`` counts."""
    clips = load_clips(store, MEASURED_CLIPS, held_out(store))
    return float(np.mean([moved(rgb)[-1] for rgb in clips.rgb]))


def reversible(store: Store) -> BackwardsConfig | None:
    """Returns how the store's clips run backwards; None if one of their actions is neither a step nor a state."""
    states = []
    dimensions = described_kinds(store.manifest.get("action_dimensions") or [])
    for number, (kind, *more) in enumerate(dimensions):
        if kind in ("held", "absolute") and more in ([], ["of a quaternion"], ["an angle"]):
            states.append(number)
        elif kind != "delta" or more not in ([], ["an angle"]):
            return None
    if not dimensions:
        return None
    return BackwardsConfig(held=tuple(states))


def of_targets(store: Store) -> bool:
    """Returns whether all actions of the store are targets or states, whose sum means nothing."""
    dimensions = described_kinds(store.manifest.get("action_dimensions") or [])
    return bool(dimensions) and all(kind in ("held", "absolute") for kind, *_ in dimensions)


def finetuned(
    source: StartingModel, store: Store, start: str, settings: Finetuning, adapts: bool, still: bool = False
) -> Config:
    """Returns the configuration of the run.

    Args:
        start: the directory of the weights to start from.
        adapts: whether the tokenizer is trained.
        still: whether videos keep what stands still.
    """
    config = on_store(source.config, store.path)
    model = config.model
    assert isinstance(model, TokenModelConfig)
    after = model.departures.self_conditioning_after
    if model.departures.self_conditioning:
        after = min(after, settings.steps // 4)
    shifts = model.departures.shifts
    if shifts:
        shifts = max(shifts, COPIES)
    integrates = model.departures.integrate_actions and not of_targets(store)
    departures = replace(model.departures, self_conditioning_after=after, shifts=shifts, integrate_actions=integrates)
    kept = None
    if still:
        kept = KeepStillConfig()
    clips = len(store.source("train"))
    backwards = None
    few = clips < FEW_CLIPS and of_targets(store)
    if settings.backwards == "on" or (settings.backwards == "measure" and few):
        backwards = reversible(store)
    model = replace(
        model,
        max_frames=source.architecture.frames,
        departures=departures,
        state_heads=None,
        backwards=backwards,
        sample=replace(model.sample, keep_still=kept),
    )
    own = config.tokenizer_train
    patience = settings.patience
    if patience == -1:
        patience = VALIDATIONS
        if len(store.source(held_out(store))) < FEW_HELD_OUT:
            patience = 0
    chooses = None
    if patience:
        chooses = early_stop(patience, settings.steps)
    tokenizer_steps = 0
    if adapts:
        tokenizer_steps = settings.tokenizer_steps
    loop = config.train
    short = round(settings.short_share * settings.steps)
    stages = []
    if short:
        frames = max(2, config.clips.frames // 2)
        stages.append(CurriculumStageConfig(epochs=short * loop.batch_size / clips, frames=frames))
    if settings.steps:
        stages.append(CurriculumStageConfig(epochs=(settings.steps - short) * loop.batch_size / clips))
    return replace(
        config,
        model=model,
        tokenizer_train=replace(
            own,
            start_from=start,
            steps=tokenizer_steps,
            curriculum=(),
            optimizer=slower(own.optimizer, settings.tokenizer_learning_rate, tokenizer_steps),
            flip=True,  # few recordings are soon memorised
            seed=settings.seed,
            early_stop=early_stop(patience or VALIDATIONS, tokenizer_steps),
        ),
        train=replace(
            loop,
            start_from=start,
            steps=settings.steps,
            curriculum=tuple(stages),
            optimizer=slower(loop.optimizer, settings.learning_rate, settings.steps),
            seed=settings.seed,
            early_stop=chooses,
        ),
        runtime=replace(
            RuntimeConfig(),
            checkpoint_every=max(1, settings.steps // VALIDATIONS),
            eval_every=max(LEAST_BETWEEN, settings.steps // VALIDATIONS),
            workers=config.runtime.workers,
        ),
    )


def early_stop(patience: int, steps: int) -> EarlyStopConfig:
    """Returns when a training of this many steps validates and stops."""
    return EarlyStopConfig(every=max(LEAST_BETWEEN, steps // VALIDATIONS), patience=patience)


def slower(optimizer: Any, share: float, steps: int) -> Any:
    """Returns the optimizer with a share of its learning rate, and a warm-up that fits a short training."""
    warmup = min(optimizer.warmup_steps, steps // 10)
    return replace(optimizer, learning_rate=share * optimizer.learning_rate, warmup_steps=warmup)
