"""The interface of networks that map frames to tokens or latents and back; the stage "tokenizer" trains them.

The MAGVIT-2 tokenizer implements it (:class:`rsjax.tokenizers.training.TokenizerTraining`). A family of world models
may implement it with its own autoencoder. Such a family

- has in its settings ``uses_tokenizer = True`` and a property ``own_autoencoder``, which returns the network's settings
  (a nested dataclass, such as its field ``autoencoder``). Steps, batch, optimizer, frames per clip and the weights of
  common loss terms come from ``Config.tokenizer_train``, as for every tokenizer;
- overrides :meth:`rsjax.models.base.WorldModel.autoencoder` to return a subclass of :class:`Autoencoder`;
- makes the records that its model trains on in ``prepare``, by :func:`rsjax.tokenizers.tokenize.prepare_store`, and
  reads the trained parameters as ``assets.tokenizer``.

For public weights that stay frozen, the stage has no steps: ``tokenizer_train.start_from`` names their directory and
``tokenizer_train.steps`` is 0. Resuming, logging, replaying, validation, describe and bench need no further code.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rsjax.clip import Video
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.trainable import Params, Trainable

B = TypeVar("B", contravariant=True)


class VideoCodec(Protocol):
    """A trained autoencoder that takes and returns numpy arrays."""

    def encode(self, video: Video) -> dict[str, Any]:
        """Returns the video's tokens or latents, arrays (B, …) by name."""
        ...

    def decode(self, tokens: dict[str, Any], has_depth: Bool[np.ndarray, " B"]) -> Video:
        """Inverts :meth:`encode`, with depth for the clips that have it if the codec encodes depth."""
        ...


@runtime_checkable
class DepthCodec(Protocol):
    """A codec that can encode depth maps, as pictures."""

    def depth_pictures(
        self, depth: Float[np.ndarray, "B T H W"]
    ) -> tuple[UInt8[np.ndarray, "B T H W 3"], UInt8[np.ndarray, "B T H W 3"]] | None:
        """Returns depth maps as pictures, and these encoded and decoded; None if it does not encode depth."""
        ...


class Autoencoder(Trainable[B], Protocol[B]):
    """An autoencoder that the stage "tokenizer" trains: a frozen dataclass of settings, without arrays."""

    def transform(self) -> Transform:
        """Returns the function that converts a clip's record to arrays of fixed shapes, in the loader.

        It must be picklable and use only numpy.
        """
        ...

    def batch(self, arrays: Arrays) -> Any:
        """Returns the batch for ``loss_terms`` from a loader's stacked arrays, with one or several rows per clip.

        A row's random draws must follow from the array ``index``, the clip's place in the batch over all processes.
        """
        ...

    def tokenizer_params(self, params: Params) -> Params:
        """Returns the parameters that later stages use, without those that only the loss needs (a discriminator's)."""
        return params

    def codec(self, params: Params, normalization: Normalization) -> VideoCodec:
        """Returns the trained codec with these :meth:`tokenizer_params`."""
        ...

    @lru_cache(maxsize=8)  # noqa: B019 - an autoencoder is a value; tracing a large one takes seconds
    def shapes(self) -> Params:
        """Returns the shapes of :meth:`tokenizer_params`, without allocating them."""
        return jax.eval_shape(lambda: self.tokenizer_params(self.init(jax.random.key(0))))

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of the weights ``directory/tokenizer/weights``, which training may start from.

        Raises:
            UserError: this autoencoder cannot start from other weights, or they are of another network.
        """
        raise UserError(f"{directory}: tokenizer_train.start_from is set, but this autoencoder starts from no weights")

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        """Returns the parameters that training begins with: the saved ones, completed by fresh ones.

        Args:
            fresh: their shapes, which stand for them in the result.
        """
        return saved

    def notes(self) -> list[str]:
        """Returns what a user should know before training, one line for each message."""
        return []

    def flops(self) -> dict[str, int]:
        """Returns floating-point operations of one pass, "encoder" and "decoder"; empty if there are no counts.

        The counts are for one frame; where frames are encoded together, they are for a training clip, divided by its
        ``tokenizer_train.frames_per_clip``.
        """
        return {}
