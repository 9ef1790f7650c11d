"""Settings of the training loop and its optimizer."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class OptimizerConfig:
    """Linear warm-up, then a schedule of the learning rate; clipping by the global norm.

    ``muon`` orthogonalises the updates of the blocks' matrices (at AdamW's scale) and leaves the rest to AdamW with
    Nesterov momentum. The paper does not name its optimizer; the public Genie uses AdamW.
    """

    kind: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup_steps: int = 50
    # cosine and linear fall from the peak to final_share of it, wsd (warm-up, stable, decay) only in the last
    # decay_share of the run; steps falls to a tenth after each share of drop_at. The public Genie's is linear.
    schedule: Literal["cosine", "linear", "wsd", "steps"] = "cosine"
    final_share: float = 0.05  # where cosine, linear and wsd end, as a share of the peak
    decay_share: float = 0.2  # wsd
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
        require(
            0 < self.decay_share <= 1,
            f"optimizer.decay_share is {self.decay_share}; it is a share of the run, above 0 and at most 1",
        )


@dataclass(frozen=True)
class PartConfig:
    """A part of a data mixture: the clips of one store that a filter lets through.

    Patterns are a shell's (``pick*``); a clip passes where one of ``tasks`` and one of ``difficulties`` match.
    """

    tasks: tuple[str, ...] = ("*",)
    difficulties: tuple[str, ...] = ("*",)  # simple, difficult; as the store has them
    store: str = ""  # a token store of the same tokenizer; none: this run's own
    weight: float = 1.0  # share of the clips drawn, relative to the other parts'

    def __post_init__(self) -> None:
        require(self.weight > 0, f"a data mixture's part has weight {self.weight}; it must be above 0")


@dataclass(frozen=True)
class StageConfig:
    """One stage of a curriculum (paper §3.1: 2 epochs of simple tasks, then 3 of difficult ones)."""

    parts: tuple[PartConfig, ...] = (PartConfig(),)
    epochs: float = 1.0  # as many clips are drawn as the parts have, this many times
    # The learning rate's schedule starts again here, and ends where the next restart or the run does.
    restart: bool = False

    def __post_init__(self) -> None:
        require(self.epochs > 0, f"a curriculum's stage has {self.epochs} epochs; it must have more than 0")
        require(bool(self.parts), "a curriculum's stage has no parts, so no data; leave parts out for all of it")


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
    # Stages of the data, one after another; then steps follow from their epochs and ``steps`` is not read. None: all
    # clips of this run, for ``steps`` steps. rsjax/config/stages.py has their words on the command line.
    stages: tuple[StageConfig, ...] = ()
    restarts: tuple[int, ...] = ()  # steps at which the learning rate's schedule starts again; stages set it
    # Steps whose loss or gradient is not finite are left out, at most this many in all; then training stops.
    skip_budget: int = runtime(10)
    log_every: int = runtime(20)
    checkpoint_every: int = runtime(200)
    keep_last: int = runtime(2)  # checkpoints kept: the newest …
    keep_every: int = runtime(0)  # … every one at a multiple of this many steps (0: none for that) …
    keep_best: bool = runtime(True)  # … and the one with the best held-out loss, where eval_every is on
    eval_every: int = runtime(0)  # steps between evaluations on held-out clips, with pictures; 0: none
    accumulate: int = runtime(1)  # parts of a batch that are computed one after another: less memory, the same step
    # jit: one device. pmap: data parallel. mesh: jit over a mesh of data × fsdp devices, parameters and optimizer cut
    # into ``fsdp`` parts. All but jit span all devices of all hosts. auto: pmap over as many local devices as divide
    # the batch, over a mesh where there are several hosts.
    placement: Literal["auto", "jit", "pmap", "mesh"] = runtime("auto")
    fsdp: int = runtime(1)
    workers: int = runtime(0)  # processes that read and prepare batches; 0: threads of this one
    max_damaged: float = runtime(0.01)  # share of the records that training goes on without
    wandb: str = runtime("")  # the Weights & Biases project that is logged to as well; none: TensorBoard alone
    profile: int = runtime(0)  # trace so many steps, once per start, into ``profile`` in the stage's directory

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoint_every", "keep_last", "accumulate", "fsdp"):
            value = getattr(self, name)
            least = 0 if name == "steps" and self.start_from else 1
            require(value >= least, f"{name} of a training loop is {value}; it must be at least {least}")
        for name in ("skip_budget", "keep_every", "eval_every", "workers", "profile"):
            require(getattr(self, name) >= 0, f"{name} of a training loop is {getattr(self, name)}; it is at least 0")
        require(
            list(self.restarts) == sorted(set(self.restarts)) and all(step > 0 for step in self.restarts),
            f"restarts of a training loop are {self.restarts}; they are steps above 0, in their order",
        )
        require(
            self.batch_size % self.accumulate == 0,
            f"batch_size {self.batch_size} does not divide into accumulate = {self.accumulate} parts; change one",
        )
        require(
            self.fsdp == 1 or self.placement == "mesh",
            f"fsdp is {self.fsdp}, which needs placement mesh; placement is {self.placement}",
        )
