"""The interface of world models, which everything outside ``rsjax/models`` uses.

A family consists of a subclass of :class:`rsjax.config.ModelConfig` (its settings) and a subclass of
:class:`WorldModel` (its implementation), which :func:`implements` connects.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.clip import Video
from rsjax.config import Config, ConfigError, ModelConfig
from rsjax.config.model import BASELINES
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.models.branch_states import Branching
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.trainable import Params, Trainable

B = TypeVar("B", contravariant=True)
W = TypeVar("W", bound="type[WorldModel[Any]]")


@dataclass(frozen=True)
class Assets:
    """Data that a world model needs besides its own parameters, fixed before its training.

    Attributes:
        normalization: of actions and depth, from the training split.
        tokenizer: parameters of the run's tokenizer or of the family's own autoencoder; None for a family without one.
    """

    normalization: Normalization
    tokenizer: Params | None


@dataclass(frozen=True)
class TeacherForced:
    """The scores of a model that predicts each frame's tokens from all true frames before it.

    Attributes:
        cross_entropy: mean over a frame's cells of -log p of their tokens in nats (the sum over vocabularies), by
            branch; p is predicted with the whole frame masked. NaN for clips without this branch.
        accuracy: the share of a frame's cells whose most probable token is the true one, likewise.
        features: the network's features of the masked frame, as the mean over its cells: what it knows of the frames
            before and the action into this one; None for a family that returns none.
        state: what the state heads read from them, as in :attr:`rsjax.clip.Video.state`; None without heads.
    """

    cross_entropy: dict[str, Float[np.ndarray, "B P"]]
    accuracy: dict[str, Float[np.ndarray, "B P"]]
    features: Float[np.ndarray, "B P C"] | None = None
    state: Float[np.ndarray, "B P 3"] | None = None


class Imagination(Protocol):
    """B clips that a model generates frame by frame while the actions come in; each begins when it is restarted."""

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " N"]) -> Video:
        """Restarts N of the clips.

        Args:
            which: True for the clips to restart.
            first: the first frame of each, (N, 1, …), with depth if the model generates it.
            index: decides their random draws, as for :meth:`WorldModel.generate`.

        Returns:
            These frames as the model sees them.
        """
        ...

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        """Generates the next frame of every clip, (B, 1, …), under actions in the recording's units."""
        ...


class WorldModel(Trainable[B], Protocol[B]):
    """A world model: a frozen dataclass of settings, without arrays.

    Subclasses must define ``init``, ``loss_terms``, ``transform`` and ``generate``; everything else has a default.
    """

    config: Any

    @classmethod
    def create(cls, config: Config) -> "WorldModel[Any]":
        """Returns the model that ``config.model`` describes, for clips of the shape ``config.clips``.

        By default, the only field of the dataclass is the whole configuration.
        """
        return cls(config)  # type: ignore[call-arg]

    @classmethod
    def autoencoder(cls, config: Config) -> Autoencoder[Any]:
        """Returns the autoencoder that the stage before the model's trains, for families with ``uses_tokenizer``.

        By default this is the tokenizer of ``config.tokenizer``; :mod:`rsjax.tokenizers.autoencoder` says how a family
        defines its own.
        """
        return TokenizerTraining.create(config)

    @classmethod
    def with_random_files(cls, config: Config, folder: Path) -> Config:
        """Returns the configuration with random files in ``folder`` in place of those that the settings name.

        Benchmarks and counts use it. By default a family reads no files.
        """
        return config

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weight λ of each active loss term by name, from ``config.model``."""
        return self.config.model.loss_weights

    def check_files(self) -> None:
        """Checks the files that the settings name, before anything is trained.

        Raises:
            UserError: one is missing or does not fit.
        """
        return

    def check_clips(self, clips: Store) -> None:
        """Checks the labels of clips that training reads, before anything is trained.

        Raises:
            UserError: the model cannot be trained on some of them.
        """
        return

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store | None:
        """Makes the store that training reads instead of clips (tokens, latents), unless it exists.

        Args:
            clips: the store of clips, all splits.
            folder: a directory of the run for the list of damaged clips, and for the output if the store is read-only.
            max_damaged: the share of a split's clips that may be damaged.

        Returns:
            A store with the splits of ``clips``; None if training reads the clips themselves.
        """
        return None

    def transform(self, normalization: Normalization) -> Transform:
        """Returns the function that converts a record of the prepared store to arrays of fixed shapes, to be stacked.

        It runs in the loader, perhaps in worker processes, so it must be picklable and use only numpy.
        """
        ...

    def batch(self, arrays: Arrays) -> Any:
        """Returns the batch for :meth:`loss_terms` from stacked arrays.

        In validation the arrays include ``weight`` (0 for padding) and ``index`` (each clip's number, which decides its
        masks); in training every clip has weight 1 and its row as index. By default, the batch is a dict of the arrays
        and these two.
        """
        size = len(next(iter(arrays.values())))
        return {"weight": np.ones(size, np.float32), "index": np.arange(size, dtype=np.int32)} | arrays

    def example(self, rng: np.random.Generator) -> Record:
        """Returns a random record like those of the prepared store, for benchmarks and shapes.

        Raises:
            UserError: the family does not implement it.
        """
        raise UserError(f"{type(self).__name__} has no example of a record, so it cannot be benchmarked or described")

    def generate(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "B T A"],
        *,
        index: Int[np.ndarray, " B"] | None = None,
        depth: bool = True,
    ) -> Video:
        """Generates the videos that follow the prompts under these actions.

        Args:
            prompt: the first P frames of each clip, with depth if it is known.
            actions: in the recording's units; row t leads into frame t, row 0 is ignored.
            index: each clip's number, which decides its random draws; 0, 1, … by default.
            depth: False if the caller does not need depth, which a family may then leave out.

        Returns:
            T frames of each clip; the first P are the prompt as the model sees it.
        """
        ...

    def plan(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "N T A"],
        depth: bool = True,
        last: int | None = None,
        past: Float[np.ndarray, "K A"] | None = None,
    ) -> Video:
        """Generates the videos that follow one prompt under N action sequences, with the same random draws.

        Args:
            prompt: one clip's first P frames.
            actions: as for :meth:`generate`.
            depth: as for :meth:`generate`.
            last: return only this many frames, the last ones; a family need not decode the others. What state heads
                read is of all frames, those of the prompt included.
            past: the actions that led from the beginning of the clip into the prompt's first frame, if that is a later
                one; a family need not read them.
        """
        repeated = prompt[np.zeros(len(actions), int)]
        alike = np.zeros(len(actions), int)
        video = self.generate(params, assets, repeated, actions, index=alike, depth=depth)
        return video if last is None else replace(video.frames(-last), state=video.state)

    def imagine(self, params: Params, assets: Assets, clips: int, depth: bool = True) -> Imagination:
        """Returns clips that are generated frame by frame; they equal those that :meth:`generate` makes at once.

        Args:
            clips: their number.
            depth: whether frames have depth, if the model generates it.

        Raises:
            UserError: the family does not implement it.
        """
        raise UserError(f"{type(self).__name__} cannot generate frame by frame, so it cannot be an environment")

    def branching(self, params: Params, assets: Assets, has_depth: bool, lanes: int = 1) -> Branching:
        """Returns an object that generates clips which can branch at any frame.

        Args:
            has_depth: whether first frames have depth.
            lanes: clips that one pass generates.

        Raises:
            UserError: the family does not implement it.
        """
        raise UserError(f"a model of family {self.config.model.family!r} cannot generate frame by frame")

    def reconstruct(self, assets: Assets, video: Video) -> Video | None:
        """Returns a video's reconstruction from the model's tokens or latents, the upper bound of its quality.

        None for a family that predicts pixels.
        """
        return None

    def teacher_forced(
        self, params: Params, assets: Assets, video: Video, actions: Float[np.ndarray, "B T A"], prompt_frames: int = 1
    ) -> TeacherForced | None:
        """Predicts each of the P = T - ``prompt_frames`` frames after the prompt from all true frames before it.

        None for a family that has no tokens, or does not implement it.

        Args:
            video: whole recorded clips.
            actions: as for :meth:`generate`.
        """
        return None

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of the world model's weights in a directory that training may start from.

        Raises:
            UserError: this family cannot start from other weights, or the directory's are of another network.
        """
        raise UserError(f"{directory}: train.start_from is set, but this family of models starts from no other weights")

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        """Returns the parameters that training begins with: the saved ones, completed by fresh ones.

        Args:
            fresh: their shapes, which stand for them in the result.
        """
        return saved

    def cache_shapes(self, frames: int) -> Any:
        """Returns the shapes of keys and values that a rollout of ``frames`` frames keeps; {} if it has no cache."""
        return {}

    def flops(self, frames: int) -> dict[str, int]:
        """Returns floating-point operations per clip, "forward" and "train"; empty if the family has no counts."""
        return {}


BUILT_IN = ("roboscape", "genie", *BASELINES)  # each is implemented in rsjax/models/NAME/model.py
MODELS: dict[type[ModelConfig], type[WorldModel[Any]]] = {}


def implements(settings: type[ModelConfig]) -> Callable[[W], W]:
    """Registers a subclass of :class:`WorldModel` as the implementation of a family's settings."""

    def register(kind: W) -> W:
        MODELS[settings] = kind
        return kind

    return register


def create_model(config: Config) -> WorldModel[Any]:
    """Returns the world model that a configuration describes.

    Raises:
        ConfigError: its family has no registered implementation.
    """
    return _implementation(config).create(config)


def create_autoencoder(config: Config) -> Autoencoder[Any]:
    """Returns the autoencoder of the stage "tokenizer"; the family must use one. Errors as in :func:`create_model`."""
    return _implementation(config).autoencoder(config)


def with_random_files(config: Config, folder: Path) -> Config:
    """Returns the configuration with random files in ``folder`` in place of those that its family reads."""
    return _implementation(config).with_random_files(config, folder)


def _implementation(config: Config) -> type[WorldModel[Any]]:
    if config.model.family in BUILT_IN:
        import_module(f"rsjax.models.{config.model.family}.model")
    kind = MODELS.get(type(config.model))
    if kind is None:
        raise ConfigError(f"model family {config.model.family!r} has settings but no implementation; import its module")
    return kind
