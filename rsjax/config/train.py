"""Settings of the training loop and its optimizer."""

import math
from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal

from rsjax.config.fields import require, require_range, runtime


@dataclass(frozen=True)
class ScheduleConfig:
    """The learning rate: linear warm-up to the peak, then a schedule down to a share of it."""

    learning_rate: float = 1e-4  # the peak
    warmup_steps: int = 50  # more where the loss jumps early
    # cosine and linear decay from the peak to final_share of it; wsd (warm-up, stable, decay) decays only in the last
    # fifth of the run.
    schedule: Literal["cosine", "linear", "wsd"] = "cosine"
    final_share: float = 0.05  # of the peak, at the end; 0 anneals to nothing

    def __post_init__(self) -> None:
        require_range(self, "optimizer", 0, math.inf, "learning_rate", "warmup_steps")
        require_range(self, "optimizer", 0, 1, "final_share")


@dataclass(frozen=True)
class AdamW(ScheduleConfig):
    """AdamW, as in the public Genie; the paper names no optimizer. Gradients are clipped by the global norm."""

    kind: ClassVar[str] = "adamw"

    # The public Genie uses linear. steps divides the peak by 10 at each share of the run in drop_at; without any it
    # stays constant.
    schedule: Literal["cosine", "linear", "wsd", "steps"] = "cosine"  # type: ignore[assignment]
    drop_at: tuple[float, ...] = ()  # with steps: shares of the run, such as 0.5 0.75
    betas: tuple[float, float] = (0.9, 0.95)  # decay of the averages of gradients and of their squares
    weight_decay: float = 0.0  # decoupled from the gradient; against overfitting in many epochs
    grad_clip: float = 1.0  # 0: none

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range(self, "optimizer", 0, math.inf, "weight_decay", "grad_clip")
        require(
            all(0 < share < 1 for share in self.drop_at),
            f"optimizer.drop_at is {self.drop_at}; its entries are shares of the run, between 0 and 1",
        )
        require(
            len(self.betas) == 2 and all(0 <= beta <= 1 for beta in self.betas),
            f"optimizer.betas are {self.betas}; they are two numbers, each 0 … 1",
        )


@dataclass(frozen=True)
class Muon(ScheduleConfig):
    """Muon for the blocks' matrices and for convolutions, which learn more in few steps than with AdamW.

    It orthogonalises their updates, at AdamW's scale. AdamW with Nesterov momentum updates the rest.
    """

    kind: ClassVar[str] = "muon"
    # As AdamW's defaults.
    drop_at: ClassVar[tuple[float, ...]] = ()
    betas: ClassVar[tuple[float, float]] = (0.9, 0.95)
    weight_decay: ClassVar[float] = 0.0
    grad_clip: ClassVar[float] = 1.0


OptimizerConfig = AdamW | Muon


@dataclass(frozen=True)
class ComponentConfig:
    """A component of a data mixture: the clips of one store that match a filter.

    Patterns are shell patterns (``pick*``); a clip matches if one of ``tasks``, one of ``difficulties`` and one of
    ``scenes`` match.
    """

    tasks: tuple[str, ...] = ("*",)  # of the clips, in words
    difficulties: tuple[str, ...] = ("*",)  # labels of the store, such as simple and difficult
    scenes: tuple[str, ...] = ("*",)  # likewise, such as kitchen
    # A token store of the same tokenizer; empty: this run's own. A run knows it by its path: give other clips another.
    store: str = ""
    weight: float = 1.0  # share of the clips drawn, relative to the other components
    clips: int = 0  # use only this many of these clips, the first ones; 0: all
    # Depth and tracks to learn from: own, the clips' own; or for the world model on this run's own clips, tracks by
    # Lucas–Kanade, depth by a network trained on other clips, or both (rsjax.tools.pipeline.estimated_annotations).
    annotations: Literal["own", "estimated_tracks", "estimated_depth", "estimated"] = "own"

    def __post_init__(self) -> None:
        require(
            self.annotations == "own" or not self.store,
            f"a component of a data mixture has annotations {self.annotations} and a store; annotations are estimated "
            f"for the run's own clips alone, so leave one of them out",
        )
        require(self.weight > 0, f"a component of a data mixture has weight {self.weight}; it must be above 0")
        require(self.clips >= 0, f"a component of a data mixture has {self.clips} clips; 0 means all of them")


@dataclass(frozen=True)
class CurriculumStageConfig:
    """One stage of a curriculum.

    The paper's authors train 2 epochs on simple tasks, then 3 on difficult ones. They mention no restart of the
    learning rate.
    """

    # The mixture that this stage draws from; one of all clips by default.
    components: tuple[ComponentConfig, ...] = (ComponentConfig(),)
    epochs: float = 1.0  # the stage draws this many times the number of its components' clips
    # The learning rate schedule starts again with this stage; it ends at the next restart or the end of the run.
    restart: bool = False
    # Train on this many of each clip's frames, the first ones, which is cheaper; 0: all. Only families of tokens.
    frames: int = 0

    def __post_init__(self) -> None:
        require(self.epochs > 0, f"a curriculum's stage has {self.epochs} epochs; it must have more than 0")
        require(
            self.frames == 0 or self.frames >= 2,
            f"a curriculum's stage has {self.frames} frames; a clip has at least 2, and 0 means all of them",
        )
        require(
            bool(self.components),
            "a curriculum's stage has no components, so no data; leave components out for all of it",
        )


@dataclass(frozen=True)
class EarlyStopConfig:
    """Ends a training that no longer improves on held-out clips; its weights are those of the best validation.

    With a curriculum it ends in the last stage, whose validations alone count for the patience.
    Held-out clips are the split "validation" of the run's store, or the split "test" if there is none.
    """

    every: int = 100  # steps between validations
    patience: int = 3  # validations in a row without a new best one that end the training

    def __post_init__(self) -> None:
        require_range(self, "early_stop", 1, 2**31 - 1, "every", "patience")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training that decide its result, shared by the tokenizer's and the world model's."""

    section: ClassVar[str] = "train"  # of a configuration, for messages

    steps: int = 1000  # ignored with a curriculum
    batch_size: int = 8  # clips of a step, over all devices
    optimizer: AdamW | Muon = AdamW()  # muon learns more in few steps (see Muon)
    ema: float = 0.0  # decay of the averaged weights that later stages use; 0: no averaging
    seed: int = 0  # of the initial weights and of all draws; compare results over several
    # A run directory, or one made by rsjax convert, whose weights training starts from. With it, steps
    # may be 0, which uses the weights unchanged. The content key covers the path, not the files.
    start_from: str = ""
    # A curriculum, stage after stage, whose epochs determine the number of steps (``steps`` is ignored; commands refuse
    # a change of it). Empty: all clips of this run for ``steps`` steps. On the command line: a file of JSON.
    curriculum: tuple[CurriculumStageConfig, ...] = ()
    # On: validates as it says, in place of runtime.eval_every, and uses the best weights, not the last ones.
    early_stop: EarlyStopConfig | None = None
    accumulate: int = runtime(1)  # parts of a batch computed one after another; raise it where memory runs out

    def __post_init__(self) -> None:
        require_range(self, self.section, int(not self.start_from), 2**31 - 1, "steps")
        require_range(self, self.section, 1, math.inf, "batch_size", "accumulate")
        require_range(self, self.section, 0, 1, "ema")
        require(
            self.batch_size % self.accumulate == 0,
            f"batch_size {self.batch_size} does not divide into accumulate = {self.accumulate} parts; change one",
        )


@dataclass(frozen=True)
class RuntimeConfig:
    """How the trainings of a run are computed, logged and saved; nothing here changes their results."""

    log_every: int = runtime(20)  # steps between lines of the log
    checkpoint_every: int = runtime(200)  # steps between checkpoints, which an interruption may cost
    eval_every: int = runtime(0)  # steps between validations, with pictures; 0: none
    # jit: one device. pmap: data parallel. mesh: jit over a mesh of data × fsdp devices, with parameters and optimizer
    # state split into ``fsdp`` parts. pmap and mesh use all devices of all hosts. auto: pmap over as many local devices
    # as divide the batch; mesh with several hosts.
    sharding: Literal["auto", "jit", "pmap", "mesh"] = runtime("auto")
    fsdp: int = runtime(1)  # parts of the state, with sharding mesh; raise it where the state does not fit a device
    # Processes that simulate episodes, or read and prepare batches. 0: one per core to simulate, and threads to read.
    workers: int = runtime(0)
    max_damaged: float = runtime(0.01)  # share of the records that may be damaged before training stops
    wandb: str = runtime("")  # Weights & Biases project; empty: TensorBoard only
    profile: int = runtime(0)  # number of steps to trace after each start, into ``profile`` in the stage's directory

    def __post_init__(self) -> None:
        require_range(self, "runtime", 1, math.inf, "log_every", "checkpoint_every", "fsdp")
        require_range(self, "runtime", 0, math.inf, "eval_every", "workers", "profile")
        require_range(self, "runtime", 0, 1, "max_damaged")
        require(
            self.fsdp == 1 or self.sharding == "mesh",
            f"runtime.fsdp is {self.fsdp}, which needs runtime.sharding mesh; it is {self.sharding}",
        )


@dataclass(frozen=True)
class LoopConfig(RuntimeConfig, TrainConfig):
    """Everything that one training loop needs; ``Config.loop`` joins the settings of a stage with those of the run.

    Attributes:
        restarts: steps at which the learning rate schedule starts again; the curriculum's stages set them.
        last_stage: the step at which the curriculum's last stage begins; an early stop ends no stage before it.
        skip_budget: how many steps with a loss or gradient that is not finite are skipped before training stops.
        keep_last, keep_every, keep_best: the checkpoints that stay: the newest ones, those at multiples of so many
            steps (0: none), and the one with the best validation loss, if there are validations.
    """

    restarts: tuple[int, ...] = ()
    last_stage: int = field(default=0, repr=False, metadata={"runtime": True})  # follows from the curriculum
    skip_budget: int = runtime(10)
    keep_last: int = runtime(2)
    keep_every: int = runtime(0)
    keep_best: bool = runtime(True)

    @property
    def validate_every(self) -> int:
        """Steps between validations; 0: none."""
        if self.early_stop is None:
            return self.eval_every
        return self.early_stop.every

    @classmethod
    def create(cls, train: TrainConfig, runtime: RuntimeConfig = RuntimeConfig()) -> "LoopConfig":
        """Joins the settings of a stage's training with those of the run."""
        return cls(**{each.name: getattr(train, each.name) for each in fields(TrainConfig)}, **vars(runtime))

    def __post_init__(self) -> None:
        RuntimeConfig.__post_init__(self)
        TrainConfig.__post_init__(self)
        require_range(self, "loop", 1, math.inf, "keep_last")
        require(
            self.early_stop is None or self.keep_best,
            "early_stop is on but keep_best is off, so that the best weights would be deleted; switch keep_best on",
        )
        require_range(self, "loop", 0, math.inf, "skip_budget", "keep_every")
        require(
            list(self.restarts) == sorted(set(self.restarts)) and all(step > 0 for step in self.restarts),
            f"restarts of a training loop are {self.restarts}; they are steps above 0, in their order",
        )
        require(
            max(self.restarts, default=-1) < self.steps,
            f"restarts of a training loop are {self.restarts}; they lie before its end, steps = {self.steps}",
        )
