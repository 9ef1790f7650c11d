"""Builds the inputs of a run's two training stages: model, loop, loader and initial weights."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rsjax.config import LoopConfig
from rsjax.data.curriculum import LoaderFactory, plan
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays, Transform
from rsjax.data.store import Store
from rsjax.models.base import create_autoencoder, create_model
from rsjax.progress import note
from rsjax.tools.pipeline.run import Run
from rsjax.trainable import Params, Trainable
from rsjax.training.checkpoint import load_weights
from rsjax.training.distributed import is_lead


@dataclass(frozen=True)
class Setup:
    """The arguments of :func:`rsjax.training.loop.fit` for a stage.

    Attributes:
        model: the model to train.
        loop: the stage's loop, with the ``steps`` and ``restarts`` of its curriculum.
        loader: makes the stage's loaders.
        to_batch: converts a loader's arrays to the model's batch.
        start: makes the initial parameters from fresh ones; None: training starts from fresh parameters.
    """

    model: Trainable[Any]
    loop: LoopConfig
    loader: LoaderFactory
    to_batch: Callable[[Arrays], Any]
    start: Callable[[Params], Params] | None


def tokenizer_setup(run: Run) -> Setup:
    """Returns the setup of the tokenizer's training, on the run's clips.

    Raises:
        StoreError: the clips are missing, or the curriculum of ``tokenizer_train`` does not fit them.
    """
    train, model = run.config.tokenizer_train, create_autoencoder(run.config)
    transform = model.transform()
    loop, loader = plan(
        run.config.loop("tokenizer"), run.open_clips(), lambda store: transform, run.directory / "tokenizer"
    )
    return Setup(model, loop, loader, model.batch, starting(model, train.start_from, "tokenizer"))


def world_model_setup(run: Run) -> Setup:
    """Returns the setup of the world model's training, on the prepared store. Errors as in :func:`tokenizer_setup`."""
    cfg, train, prepared = run.config, run.config.train, run.open_prepared()
    model = create_model(cfg)
    transform = model.transform(Normalization.create(prepared))

    def transform_of(store: Store) -> Transform:
        _note_depth(prepared, store)
        return transform

    loop, loader = plan(cfg.loop("world_model"), prepared, transform_of, run.directory / "world_model")
    return Setup(model, loop, loader, model.batch, starting(model, train.start_from, "world_model"))


def note_curriculum(loader: LoaderFactory) -> None:
    """Prints a line for each stage of the curriculum, in the lead process."""
    for line in loader.summary() if is_lead() else ():
        note(line)


def starting(model: Any, start_from: str, part: str) -> Callable[[Params], Params] | None:
    """Returns a function that makes initial parameters from a directory's weights; None if ``start_from`` is empty.

    Args:
        part: "tokenizer" or "world_model".

    Raises:
        UserError: the weights are missing or of another network; the message names the differing fields.
    """
    if not start_from:
        return None
    directory = Path(start_from)
    shapes = model.pretrained_shapes(directory)
    return partial(_start, model, directory, directory / part / "weights", shapes)


def _start(model: Any, directory: Path, weights: Path, shapes: Params, fresh: Params) -> Params:
    return model.start(fresh, load_weights(weights, shapes), directory)


def _note_depth(own: Store, other: Store) -> None:
    """Prints a note if the depth tokens of another store have another scale."""
    own_range, other_range = _depth_range(own), _depth_range(other)
    if other_range and own_range != other_range and is_lead():
        note(
            f"{other.path}: its depth covers {other_range}, this run's {own_range}; "
            f"the model does not see the difference"
        )


def _depth_range(store: Store) -> str:
    near_far = store.manifest.get("depth_range")
    return f"{near_far[0]:g} to {near_far[1]:g} {store.manifest.get('depth_unit') or 'metres'}" if near_far else ""
