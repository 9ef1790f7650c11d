"""What the two trained stages of a run train, on what, and how they are looked at."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from rsjax.config import LoopConfig
from rsjax.data.curriculum import LoaderFactory
from rsjax.data.order import Arrays
from rsjax.models.roboscape.world_model import branches
from rsjax.pipeline import transforms
from rsjax.pipeline.feeding import planned, token_transform
from rsjax.pipeline.run import Run
from rsjax.pipeline.validation import TokenizerHeldOut, WorldModelHeldOut
from rsjax.training.loop import Watch, fit
from rsjax.training.objectives import Objective, TokenizerObjective, WorldModelObjective
from rsjax.training.pretrained import start_tokenizer, start_world_model
from rsjax.training.state import TrainState

O = TypeVar("O", bound=Objective)  # noqa: E741


@dataclass(frozen=True)
class Job(Generic[O]):
    """A training stage, ready to begin or to be looked into. Fields are the arguments of :func:`fit`."""

    objective: O
    loop: LoopConfig
    feed: LoaderFactory
    directory: Path
    name: str
    to_batch: Callable[[Arrays], Any]
    start: Callable[[Any], Any] | None
    watch: Watch

    def fit(self, resume: bool) -> TrainState:
        """:func:`rsjax.training.loop.fit` with these."""
        return fit(
            self.objective,
            self.loop,
            self.feed,
            self.directory,
            name=self.name,
            to_batch=self.to_batch,
            start=self.start,
            resume=resume,
            watch=self.watch,
        )


def tokenizer_job(run: Run) -> Job[TokenizerObjective]:
    """Reads the run's clips.

    Raises:
        StoreError: there are none, or the stages of ``tokenizer_train`` do not fit them.
    """
    cfg, train = run.config, run.config.tokenizer_train
    transform = partial(
        transforms.tokenizer_images,
        count=train.frames_per_clip,
        depth_share=train.depth_share,
        scale=cfg.tokenizer.depth_scale,
        flip=train.flip,
    )
    directory = run.directory / "tokenizer"
    loop, feed = planned(train, run.open_clips(), lambda store: transform, directory)
    return Job(
        TokenizerObjective(cfg.tokenizer, train),
        loop,
        feed,
        directory,
        "tokenizer",
        transforms.image_batch,
        partial(start_tokenizer, cfg.tokenizer, Path(train.start_from)) if train.start_from else None,
        Watch(("images", train.batch_size * train.frames_per_clip), TokenizerHeldOut(run)),
    )


def world_model_job(run: Run) -> Job[WorldModelObjective]:
    """Reads the run's tokens. Errors as of :func:`tokenizer_job`."""
    cfg, train = run.config, run.config.train
    tokens = run.open_tokens()
    transform = partial(token_transform, tokens, cfg.model.integrate_actions)
    directory = run.directory / "world_model"
    loop, feed = planned(train, tokens, transform, directory)
    tokens_per_step = train.batch_size * cfg.clips.frames * cfg.model.grid**2 * len(branches(cfg.model))
    return Job(
        WorldModelObjective.create(cfg),
        loop,
        feed,
        directory,
        "world model",
        transforms.token_batch,
        partial(start_world_model, cfg.model, Path(train.start_from)) if train.start_from else None,
        Watch(("tokens", tokens_per_step), WorldModelHeldOut(run)),
    )
