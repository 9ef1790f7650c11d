"""Settings of the training loop and its optimizer."""

import math
from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, require_range, runtime


@dataclass(frozen=True)
class OptimizerConfig:
    """The optimizer: linear warm-up, then a learning rate schedule; clipping by the global norm.

    ``muon`` orthogonalises the updates of the blocks' matrices and of convolutions (at AdamW's scale) and leaves the
    rest to AdamW with Nesterov momentum. The paper does not name its optimizer; the public Genie uses AdamW.
    """

    kind: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup_steps: int = 50
    # cosine and linear decay from the peak to final_share of it; wsd (warm-up, stable, decay) decays only in the last
    # decay_share of the run; steps divides by 10 at each share in drop_at. The public Genie uses linear.
    schedule: Literal["cosine", "linear", "wsd", "steps"] = "cosine"
    final_share: float = 0.05  # the end of cosine, linear and wsd, as a share of the peak
    decay_share: float = 0.2  # wsd: the share of the run that decays
    drop_at: tuple[float, ...] = ()  # steps: shares of the run at which the rate is divided by 10
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
        amounts = ("learning_rate", "warmup_steps", "weight_decay", "grad_clip")
        require_range(self, "optimizer", 0, math.inf, *amounts)
        require_range(self, "optimizer", 0, 1, "final_share", "beta1", "beta2")


@dataclass(frozen=True)
class ComponentConfig:
    """A component of a data mixture: the clips of one store that match a filter.

    Patterns are shell patterns (``pick*``); a clip matches if one of ``tasks``, one of ``difficulties`` and one of
    ``scenes`` match.
    """

    tasks: tuple[str, ...] = ("*",)
    difficulties: tuple[str, ...] = ("*",)  # labels of the store, such as simple and difficult
    scenes: tuple[str, ...] = ("*",)  # likewise, such as kitchen
    store: str = ""  # a token store of the same tokenizer; empty: this run's own
    weight: float = 1.0  # share of the clips drawn, relative to the other components
    clips: int = 0  # use only this many of these clips, the first ones; 0: all

    def __post_init__(self) -> None:
        require(self.weight > 0, f"a component of a data mixture has weight {self.weight}; it must be above 0")
        require(self.clips >= 0, f"a component of a data mixture has {self.clips} clips; 0 means all of them")


@dataclass(frozen=True)
class CurriculumStageConfig:
    """One stage of a curriculum.

    The paper's authors train 2 epochs on simple tasks, then 3 on difficult ones. They mention no restart of the
    learning rate.
    """

    components: tuple[ComponentConfig, ...] = (ComponentConfig(),)
    epochs: float = 1.0  # the stage draws this many times the number of its components' clips
    # The learning rate schedule starts again with this stage; it ends at the next restart or the end of the run.
    restart: bool = False

    def __post_init__(self) -> None:
        require(self.epochs > 0, f"a curriculum's stage has {self.epochs} epochs; it must have more than 0")
        require(
            bool(self.components),
            "a curriculum's stage has no components, so no data; leave components out for all of it",
        )


@dataclass(frozen=True)
class LoopConfig:
    """Settings of a training loop, shared by the tokenizer's and the world model's."""

    steps: int = 1000
    batch_size: int = 8  # over all devices
    optimizer: OptimizerConfig = OptimizerConfig()
    ema: float = 0.0  # decay of the averaged weights that later stages use; 0: no averaging
    seed: int = 0
    # A run directory, or one made by python -m experiments.convert, whose weights training starts from. With it, steps
    # may be 0, which uses the weights unchanged. The content key covers the path, not the files.
    start_from: str = ""
    # A curriculum, stage after stage, whose epochs determine the number of steps (``steps`` is ignored; commands refuse
    # a change of it). Empty: all clips of this run for ``steps`` steps. rsjax/config/curriculum.py says how a stage is
    # written on the command line.
    curriculum: tuple[CurriculumStageConfig, ...] = ()
    restarts: tuple[int, ...] = ()  # steps at which the learning rate schedule starts again; set by stages
    # How many steps with a loss or gradient that is not finite are skipped before training stops.
    skip_budget: int = runtime(10)
    log_every: int = runtime(20)
    checkpoint_every: int = runtime(200)
    keep_last: int = runtime(2)  # keep this many of the newest checkpoints …
    keep_every: int = runtime(0)  # … those at multiples of this many steps (0: none) …
    keep_best: bool = runtime(True)  # … and the one with the best validation loss, if eval_every is on
    eval_every: int = runtime(0)  # steps between validations, with pictures; 0: none
    accumulate: int = runtime(1)  # parts of a batch computed one after another: less memory, same step
    # jit: one device. pmap: data parallel. mesh: jit over a mesh of data × fsdp devices, with parameters and optimizer
    # state split into ``fsdp`` parts. pmap and mesh use all devices of all hosts. auto: pmap over as many local devices
    # as divide the batch; mesh with several hosts.
    sharding: Literal["auto", "jit", "pmap", "mesh"] = runtime("auto")
    fsdp: int = runtime(1)
    workers: int = runtime(0)  # processes that read and prepare batches; 0: threads
    max_damaged: float = runtime(0.01)  # share of the records that may be damaged
    wandb: str = runtime("")  # Weights & Biases project; empty: TensorBoard only
    profile: int = runtime(0)  # number of steps to trace after each start, into ``profile`` in the stage's directory

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoint_every", "keep_last", "accumulate", "fsdp"):
            value = getattr(self, name)
            least = 0 if name == "steps" and self.start_from else 1
            require(value >= least, f"{name} of a training loop is {value}; it must be at least {least}")
        for name in ("skip_budget", "keep_every", "eval_every", "workers", "profile"):
            require(getattr(self, name) >= 0, f"{name} of a training loop is {getattr(self, name)}; it is at least 0")
        for name in ("ema", "max_damaged"):
            require(0 <= getattr(self, name) <= 1, f"{name} of a training loop is {getattr(self, name)}; it is 0 … 1")
        require(self.steps < 2**31, f"steps of a training loop are {self.steps}; their counter ends at {2**31 - 1}")
        require(
            list(self.restarts) == sorted(set(self.restarts)) and all(step > 0 for step in self.restarts),
            f"restarts of a training loop are {self.restarts}; they are steps above 0, in their order",
        )
        require(
            max(self.restarts, default=-1) < self.steps,
            f"restarts of a training loop are {self.restarts}; they lie before its end, steps = {self.steps}",
        )
        require(
            self.batch_size % self.accumulate == 0,
            f"batch_size {self.batch_size} does not divide into accumulate = {self.accumulate} parts; change one",
        )
        require(
            self.fsdp == 1 or self.sharding == "mesh",
            f"fsdp is {self.fsdp}, which needs sharding mesh; sharding is {self.sharding}",
        )
