"""What is trained: the tokenizer or the world model, as hashable objects for :func:`rsjax.training.step.train_step`."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rsjax.config import Config, LossConfig, MaskConfig, ModelConfig, TokenizerConfig, TokenizerTrainConfig, require
from rsjax.models.roboscape.losses import Term
from rsjax.models.roboscape.terms import world_model_terms
from rsjax.models.roboscape.world_model import WorldModel
from rsjax.tokenizers.adversarial import initial_averages, updated_averages
from rsjax.tokenizers.discriminator import MIN_SIZE, Discriminator
from rsjax.tokenizers.loss import tokenizer_terms
from rsjax.tokenizers.lpips import load_lpips, min_size
from rsjax.tokenizers.magvit2 import Tokenizer


class Surroundings(NamedTuple):
    """What a loss may depend on beside parameters, batch and key.

    Attributes:
        step: steps done before this one.
        extra: what the objective carries from step to step.
        axis_name: of pmap, over which the batch is cut; None where XLA sees the whole batch.
    """

    step: Int[Array, ""]
    extra: Any
    axis_name: str | None


class Objective(Protocol):
    """Parameters and the terms of a loss. Implementations are frozen dataclasses, so jit can take them as static."""

    @property
    def weights(self) -> dict[str, float]:
        """The weight λ of each term, by name."""

    def init(self, key: Array) -> Any:
        """Fresh parameters."""

    def init_extra(self) -> Any:
        """What is carried from step to step beside the parameters; None where nothing is."""
        return None

    def terms(self, params: Any, batch: Any, key: Array, around: Surroundings) -> dict[str, Term]:
        """Each term's (weighted sum, weight) on this device's part of a batch."""

    def next_extra(self, extra: Any, means: dict[str, Float[Array, ""]]) -> Any:
        """``extra`` after a step, from its terms' means over all devices."""
        return extra


@dataclass(frozen=True)
class TokenizerObjective(Objective):
    """Reconstruction of RGB frames and colourised depth maps. A batch is images 0–255, (B, H, W, 3).

    Parameters are the tokenizer's; with an adversarial term {"generator": the tokenizer's, "discriminator": …}.
    """

    tokenizer: TokenizerConfig
    train: TokenizerTrainConfig

    def __post_init__(self) -> None:
        require(
            not self.train.adversarial or self.tokenizer.image_size >= MIN_SIZE,
            f"tokenizer.image_size is {self.tokenizer.image_size}; the discriminator needs at least {MIN_SIZE}, "
            f"or tokenizer_train.adversarial 0",
        )

    @property
    def weights(self) -> dict[str, float]:
        return self.train.weights

    def init(self, key: Array) -> Any:
        generator = Tokenizer(self.tokenizer).init_params(key)
        if not self.train.adversarial:
            return generator
        return {"generator": generator, "discriminator": Discriminator().init_params(jax.random.fold_in(key, 1))}

    def init_extra(self) -> Any:
        """LeCAM's averages, and LPIPS's weights: not in the compiled step, where they would be 59 MB of constants.

        Raises:
            LpipsError: ``train.lpips_weights`` names no sound file.
            ConfigError: images are too small for its network.
        """
        extra: dict[str, Any] = {}
        if "perceptual" in self.weights:
            weights = load_lpips(self.train.lpips_weights)
            require(
                self.tokenizer.image_size >= min_size(weights),
                f"tokenizer.image_size is {self.tokenizer.image_size}; the LPIPS network of "
                f"{self.train.lpips_weights} needs at least {min_size(weights)}, or tokenizer_train.perceptual 0",
            )
            extra["lpips"] = jax.tree.map(jnp.array, weights)
        if "lecam" in self.weights:
            extra["lecam"] = initial_averages()
        return extra or None

    def terms(self, params: Any, batch: Any, key: Array, around: Surroundings) -> dict[str, Term]:
        return tokenizer_terms(self.tokenizer, self.train, params, batch, *around)

    def next_extra(self, extra: Any, means: dict[str, Float[Array, ""]]) -> Any:
        if "lecam" not in self.weights:
            return extra
        logits = (means["real_logit"], means["fake_logit"])
        return extra | {"lecam": updated_averages(extra["lecam"], *logits, decay=self.train.lecam_decay)}

    def tokenizer_params(self, params: Any) -> Any:
        """The tokenizer's own parameters, without the discriminator's."""
        return params["generator"] if self.train.adversarial else params


@dataclass(frozen=True)
class WorldModelObjective(Objective):
    """The physics-informed objective of the paper (Eq. 8). A batch is a :class:`rsjax.clip.Batch`."""

    model: ModelConfig
    mask: MaskConfig
    loss: LossConfig

    @classmethod
    def create(cls, config: Config) -> "WorldModelObjective":
        return cls(config.model, config.mask, config.loss)

    @property
    def weights(self) -> dict[str, float]:
        return self.loss.terms(self.model.depth)

    def init(self, key: Array) -> Any:
        return WorldModel(self.model).init_params(key)

    def terms(self, params: Any, batch: Any, key: Array, around: Surroundings) -> dict[str, Term]:
        return world_model_terms(self.model, self.mask, self.loss, params, batch, key)
