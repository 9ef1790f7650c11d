"""Settings of the training loop and its optimizer."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class OptimizerConfig:
    """Linear warm-up, then a cosine or steps down, and clipping by the global norm.

    ``muon`` orthogonalises the updates of the blocks' matrices (at AdamW's scale) and leaves the rest to AdamW with
    Nesterov momentum. The paper does not name its optimizer; the public Genie uses AdamW.
    """

    kind: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup_steps: int = 50
    schedule: Literal["cosine", "steps"] = "cosine"
    final_share: float = 0.05  # cosine: where it ends, as a share of the peak
    drop_at: tuple[float, ...] = ()  # steps: shares of the run after which the rate falls to a tenth
    beta1: float = 0.9
    beta2: float = 0.95
    weight_decay: float = 0.0
    grad_clip: float = 1.0  # 0: none

    def __post_init__(self) -> None:
        require(
            all(0 < share < 1 for share in self.drop_at),
            f"optimizer.drop_at is {self.drop_at}; its entries are shares of the run, between 0 and 1",
        )


@dataclass(frozen=True)
class LoopConfig:
    """A training loop: what the tokenizer's and the world model's have in common."""

    steps: int = 1000
    batch_size: int = 8  # over all devices
    optimizer: OptimizerConfig = OptimizerConfig()
    ema: float = 0.0  # decay of the averaged weights that later stages use; 0: none are kept
    seed: int = 0
    # A directory of python -m rsjax.convert, or another run's: its weights are begun with. With them steps may be 0,
    # which takes them as they are. The path counts, not what lies there.
    start_from: str = ""
    log_every: int = runtime(20)
    checkpoint_every: int = runtime(200)
    # jit: one device. pmap: data parallel over all local ones. auto: over as many of them as divide the batch.
    placement: Literal["auto", "jit", "pmap"] = runtime("auto")

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoint_every"):
            value = getattr(self, name)
            least = 0 if name == "steps" and self.start_from else 1
            require(value >= least, f"{name} of a training loop is {value}; it must be at least {least}")
