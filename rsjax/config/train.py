"""Settings of the training loop and its optimizer."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class OptimizerConfig:
    """Linear warm-up, a cosine to ``final_share`` of the peak, and clipping by the global norm.

    ``muon`` orthogonalises the updates of the blocks' matrices (at AdamW's scale) and leaves the rest to AdamW with
    Nesterov momentum. The paper does not name its optimizer; the public Genie uses AdamW.
    """

    kind: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup_steps: int = 50
    final_share: float = 0.05
    beta1: float = 0.9
    beta2: float = 0.95
    weight_decay: float = 0.0
    grad_clip: float = 1.0


@dataclass(frozen=True)
class LoopConfig:
    """A training loop: what the tokenizer's and the world model's have in common."""

    steps: int = 1000
    batch_size: int = 8  # over all devices
    optimizer: OptimizerConfig = OptimizerConfig()
    ema: float = 0.0  # decay of the averaged weights that later stages use; 0: none are kept
    seed: int = 0
    log_every: int = runtime(20)
    checkpoint_every: int = runtime(200)
    # jit: one device. pmap: data parallel over all local ones. auto: over as many of them as divide the batch.
    placement: Literal["auto", "jit", "pmap"] = runtime("auto")

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoint_every"):
            value = getattr(self, name)
            require(value > 0, f"{name} of a training loop is {value}; it must be positive")
