"""What is trained: the tokenizer or the world model, as hashable objects for :func:`rsjax.train.step.train_step`."""

from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import Array

from rsjax.config import Config, LossConfig, MaskConfig, ModelConfig, TokenizerConfig, TokenizerTrainConfig
from rsjax.model.world_model import WorldModel
from rsjax.objective.losses import Term
from rsjax.objective.world_model_terms import world_model_terms
from rsjax.tokenizer.loss import tokenizer_terms
from rsjax.tokenizer.magvit2 import Tokenizer


class Objective(Protocol):
    """Parameters and the terms of a loss. Implementations are frozen dataclasses, so jit can take them as static."""

    @property
    def weights(self) -> dict[str, float]:
        """The weight λ of each term, by name."""

    def init(self, key: Array) -> Any:
        """Fresh parameters."""

    def terms(self, params: Any, batch: Any, key: Array) -> dict[str, Term]:
        """Each term's (weighted sum, weight) on this device's part of a batch."""


@dataclass(frozen=True)
class TokenizerObjective:
    """Reconstruction of RGB frames and colourised depth maps. A batch is images 0–255, (B, H, W, 3)."""

    tokenizer: TokenizerConfig
    train: TokenizerTrainConfig

    @property
    def weights(self) -> dict[str, float]:
        return self.train.weights

    def init(self, key: Array) -> Any:
        return Tokenizer(self.tokenizer).init_params(key)

    def terms(self, params: Any, batch: Any, key: Array) -> dict[str, Term]:
        return tokenizer_terms(self.tokenizer, self.train, params, batch)


@dataclass(frozen=True)
class WorldModelObjective:
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

    def terms(self, params: Any, batch: Any, key: Array) -> dict[str, Term]:
        return world_model_terms(self.model, self.mask, self.loss, params, batch, key)
