"""Settings of evaluation, and of a whole run."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rsjax.config.data import ClipShape, DataConfig
from rsjax.config.fields import check_numbers, require, require_range
from rsjax.config.model import ModelConfig, converted
from rsjax.config.sim import SimConfig
from rsjax.config.token_model import RoboScapeConfig, TokenModelConfig
from rsjax.config.tokenizer import TokenizerConfig, TokenizerTrainConfig
from rsjax.config.train import LoopConfig, RuntimeConfig, TrainConfig

WEIGHTS = "weights"  # the directory of metrics' files unless a run names another one
SIMULATOR = "simulator"  # the depth estimator that learns from the run's clips
SIMULATOR_STEPS = 2000  # its training steps


@dataclass(frozen=True)
class EvalConfig:
    """Settings of the evaluation on the test split."""

    clips: int = 20  # clips that are scored, spread evenly over the test split
    repetitions: int = 1  # how often each clip is generated, with different random draws
    batch_size: int = 10  # clips that are generated at once; lower it where memory runs out
    action_draws: int = 3  # random action sequences per clip and kind of ΔPSNR; fewer are faster and noisier
    localiser_steps: int = 500  # training steps of the network that finds cube and gripper in frames
    # A directory with files that are not part of this project: lpips_alex.safetensors and lpips_vgg.safetensors of
    # rsjax convert lpips, and i3d_torchscript.pt for FVD. Without its file, a metric is null. Only the
    # default directory may be missing; "": no files.
    weights: str = WEIGHTS
    # What estimates depth from frames: simulator, a small network that learns from the run's own clips (or, with fewer
    # or more steps, simulator:steps=500), or a network and its files, as in rsjax ingest --depth.
    depth_estimator: str = ""

    def __post_init__(self) -> None:
        require_range(
            self,
            "eval",
            1,
            math.inf,
            "repetitions",
            "batch_size",
            "action_draws",
        )
        require_range(self, "eval", 1, 100_000, "localiser_steps")
        require(
            not self.depth_estimator.startswith(SIMULATOR) or self.simulator_steps > 0,
            f"eval.depth_estimator is {self.depth_estimator!r}; write {SIMULATOR} or {SIMULATOR}:steps=500",
        )

    @property
    def simulator_steps(self) -> int:
        """Training steps of the estimator that learns from the run's clips; 0 if another or none is chosen."""
        if self.depth_estimator == SIMULATOR:
            return SIMULATOR_STEPS
        steps = self.depth_estimator.removeprefix(f"{SIMULATOR}:steps=")
        if steps == self.depth_estimator or not (steps.isascii() and steps.isdigit()):
            return 0
        return int(steps)

    def weights_file(self, name: str) -> str:
        """Returns the path of a metric's file in the directory ``weights``; "" if it is not there.

        Raises:
            ConfigError: the directory is missing, and not the default one.
        """
        if not self.weights:
            return ""
        directory = Path(self.weights)
        require(
            directory.is_dir() or self.weights == WEIGHTS,
            f"eval.weights is {directory}: no such directory; mend the path, or leave it empty",
        )
        if not (directory / name).exists():
            return ""
        return str(directory / name)


FULL_SIZE_EVAL = EvalConfig(clips=1200, repetitions=5)  # the authors' numbers, for every family's full-size presets


@dataclass(frozen=True)
class Config:
    """Everything that one run depends on. Built from a preset; never changed while it runs.

    Derived values are not settings: :attr:`clips` gives the sizes of images, frames and actions, and :attr:`grid` the
    token grid that follows from them and the tokenizer.
    """

    name: str  # of the preset; by default also that of the run's directory
    prompt_frames: int = 1  # frames that generation starts from; 1 in the paper
    sim: SimConfig = SimConfig()  # ignored if data names a store
    data: DataConfig | None = None  # a store of clips instead of simulated episodes; --store sets it
    tokenizer: TokenizerConfig = TokenizerConfig()  # ignored by a model without tokens or with its own autoencoder
    # The training of the tokenizer, or of the model's own autoencoder.
    tokenizer_train: TokenizerTrainConfig = TokenizerTrainConfig()
    model: ModelConfig = RoboScapeConfig()  # of the family that the preset or --model chooses
    train: TrainConfig = TrainConfig()  # the training of the world model
    runtime: RuntimeConfig = RuntimeConfig()  # of both trainings; changes no result
    eval: EvalConfig = EvalConfig()  # the evaluation on the test split, after training

    def __post_init__(self) -> None:
        check_numbers(self)
        clips = self.clips
        require(
            1 <= self.prompt_frames < clips.frames,
            f"prompt_frames is {self.prompt_frames} of {clips.frames} frames; at least one frame must be given and "
            f"one left to predict",
        )
        test_clips = "sim.test_episodes" if self.data is None else "data.test_clips"
        require(
            min(self.eval.clips, clips.test_clips) >= 2,
            f"eval.clips is {self.eval.clips} of {test_clips} {clips.test_clips}; both must be at least 2, "
            f"so that a clip can be generated under another one's actions",
        )
        if self.model.uses_tokenizer and self.autoencoder is self.tokenizer:
            self.tokenizer.grid(clips.image_size)
        self.model.check(clips)
        lengths = [stage.frames for stage in self.train.curriculum if stage.frames]
        shortened = max(lengths, default=0)
        require(
            min(lengths, default=clips.frames) > self.prompt_frames,
            f"a stage of train.curriculum takes {min(lengths, default=0)} frames of a clip, of which the first "
            f"{self.prompt_frames} are given (prompt_frames); it needs one more to predict",
        )
        require(
            shortened <= clips.frames and (not shortened or isinstance(self.model, TokenModelConfig)),
            f"a stage of train.curriculum takes {shortened} of {clips.frames} frames of a clip, and only families of "
            f"tokens take fewer than all (this is {self.model.family}); lower its frames, or leave them out",
        )
        require(
            not self.second_view or isinstance(self.model, TokenModelConfig),
            f"sim.second_view is {self.sim.second_view}, but models of the family {self.model.family} read one view; "
            f"switch it off",
        )

    def loop(self, stage: Literal["tokenizer", "world_model"]) -> LoopConfig:
        """Returns the settings of a stage's training loop."""
        train = self.tokenizer_train if stage == "tokenizer" else self.train
        return LoopConfig.create(train, self.runtime)

    def with_family(self, name: str) -> "Config":
        """Returns this configuration with a model of another family, which keeps the fields that both have.

        Raises:
            ConfigError: the family is unknown.
        """
        return replace(self, model=converted(self.model, name))

    @property
    def clips(self) -> ClipShape:
        """The shape of the clips that the run learns from."""
        return self.sim.clips if self.data is None else self.data.clips

    @property
    def second_view(self) -> bool:
        """Whether the model learns from a second view of the clips."""
        return self.data is None and self.sim.second_view != "off"

    @property
    def one_start(self) -> bool:
        """Whether all training clips begin where an episode does, with the robot in one place, as far as is known."""
        components = [each for stage in self.train.curriculum for each in stage.components]
        backwards = isinstance(self.model, TokenModelConfig) and self.model.backwards is not None
        own = self.data is None and not any(each.store for each in components)
        return own and self.sim.one_start and not backwards

    @property
    def autoencoder(self) -> Any:
        """Settings of the network that maps frames to tokens or latents: the model's own, or ``tokenizer``."""
        own = self.model.own_autoencoder
        return self.tokenizer if own is None else own

    @property
    def grid(self) -> int:
        """Token cells along each side of a frame."""
        return self.tokenizer.grid(self.clips.image_size)
